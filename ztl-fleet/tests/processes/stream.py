"""Reads streams of a robot with nothing but Zenoh: stream.py ROUTER ROBOT TOPIC COUNT.

Prints COUNT messages whose topics begin with TOPIC, and how many were missed.
"""
import json
import pickle
import queue
import sys
import uuid

import zenoh

router, robot, topic, count = sys.argv[1:]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router]},
    "scouting": {"multicast": {"enabled": False}},
}))
own = uuid.uuid4().hex
session_id, heard = None, 0


def ask():
    """Once a second, or nothing comes any more after 5 s."""
    global session_id, heard
    want = {"id": own, "session": session_id, "topics": [topic], "heard": heard}
    told = []
    # An agent on a busy machine may be too late.
    while not told:
        replies = session.get(f"{base}/streams", payload=json.dumps(want), timeout=2)
        told = [reply.ok for reply in replies if reply.ok]
    granted = json.loads(told[0].payload.to_bytes())
    if granted["session"] != session_id:
        session_id, heard = granted["session"], 0
        ask()


with zenoh.open(config) as session:
    alive = []
    while not alive:
        replies = session.liveliness().get(f"ztl/{robot}/*/alive", timeout=5)
        alive = [reply.ok for reply in replies if reply.ok]
    base = str(alive[0].key_expr).removesuffix("/alive")
    arrived = queue.Queue()
    subscriber = session.declare_subscriber(f"{base}/streams/{own}", lambda sample: arrived.put(sample.payload.to_bytes()))
    left = int(count)
    while left > 0:
        ask()
        try:
            head, body = arrived.get(timeout=1).split(b"\n", 1)
        except queue.Empty:
            continue
        head = json.loads(head)
        if head["session"] != session_id or head["number"] <= heard:
            continue
        missed, heard = head["number"] - heard - 1, head["number"]
        # Unpickling runs what the publisher wrote: only for publishers that you trust.
        print(head["topic"], pickle.loads(body), "state" if head["state"] else "event", "missed", missed, flush=True)
        left -= 1
