"""A robot that says more than it is asked for: talkative.py ROUTER ROBOT.

When it is first asked for a topic, it sends a state of /test/secret with the value 7, unless it was asked for that; then a state of /test/pose. Once it is asked
for /test/secret, its value is 8.
"""
import json
import pickle
import sys
import time

import zenoh

router, robot = sys.argv[1:]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router]},
    "scouting": {"multicast": {"enabled": False}},
}))
AGENT, SESSION = "a" * 32, "5" * 32
base = f"ztl/{robot}/{AGENT}"
number = 0


def info(query):
    said = {"ztl_fleet": 1, "name": robot, "agent": AGENT, "boot": 7, "clock_ms": int(time.monotonic() * 1000), "since": 1}
    said |= {"streams": True, "ready": True, "scopes": ["/test"]}
    query.reply(query.key_expr, json.dumps(said))


def send(topic, value, to):
    global number
    number += 1
    head = {"session": SESSION, "number": number, "topic": topic, "scope": "/test", "state": True}
    session.put(f"{base}/streams/{to}", json.dumps(head).encode() + b"\n" + pickle.dumps(value, 2))


def streams(query):
    want = json.loads(query.payload.to_bytes())
    if want.get("session") == SESSION and want["topics"]:
        if number == 0:
            send("/test/secret", 7, want["id"])
        send("/test/pose", 1, want["id"])
        print("sent what nobody asked for", flush=True)
        if any("/test/secret".startswith(topic) for topic in want["topics"]):
            send("/test/secret", 8, want["id"])
    query.reply(query.key_expr, json.dumps({"session": SESSION, "sent": number, "window": 1 << 20}))


with zenoh.open(config) as session:
    offered = [session.declare_queryable(f"{base}/{what}", answer, complete=True) for what, answer in [("info", info), ("streams", streams)]]
    token = session.liveliness().declare_token(f"{base}/alive")
    print("Talking", flush=True)
    sys.stdin.read()
