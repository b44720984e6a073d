"""A client of a fleet that has nothing but Zenoh: lists robots, starts a task and repeats the query, waits for its end.

client.py ROUTER ROBOT SCOPE TASK: prints what it is told, line by line.
"""
import base64
import json
import sys
import time
import uuid

import zenoh

router, robot, scope, task = sys.argv[1:]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router]},
    "scouting": {"multicast": {"enabled": False}},
}))


def ask(selector, payload=b""):
    replies = list(session.get(selector, payload=payload, timeout=5))
    assert len(replies) == 1, selector
    reply = replies[0]
    return (reply.ok or reply.err).payload.to_bytes().decode()


with zenoh.open(config) as session:
    alive = session.liveliness().get("ztl/*/*/alive", timeout=5)
    agents = dict(str(reply.ok.key_expr).split("/")[1:3] for reply in alive)
    print("robots", *sorted(agents), flush=True)
    base = f"ztl/{robot}/{agents[robot]}"
    info = json.loads(ask(f"{base}/info"))
    until = info["clock_ms"] + 5000
    rules = f"client={uuid.uuid4().hex};number=1;boot={info['boot']};until={until}"
    init = f"{scope};1;-1;{base64.b64encode(task.encode()).decode()}".encode()
    first = ask(f"{base}/request?{rules}", init)
    print("first", first, flush=True)
    print("again", ask(f"{base}/request?{rules}", init) == first, flush=True)
    other = rules.replace("number=1", "number=2")
    stale = other.replace(f"boot={info['boot']}", "boot=1")
    print("stale", ask(f"{base}/request?{stale}", init).split(" ")[0], flush=True)
    late = other.replace(f"until={until}", "until=1")
    print("late", ask(f"{base}/request?{late}", init).split(" ")[0], flush=True)
    number = first.split(";")[2]
    # With them, the robot knows that its client is there.
    asks = rules.replace("number=1", "number=3")
    state = "1"
    while state in "01":
        state, _, text = ask(f"{base}/request?{asks}", f"{scope};2;{number};".encode()).split(";", 3)[1:]
        time.sleep(0.1)
    print("end", state, text, flush=True)
