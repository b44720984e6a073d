"""Somebody hostile who may connect: hostile.py ROUTER ROBOT AGENT.

Claims the robot's name and many others, floods the fleet with answers for its agent, and records what is sent to it. Prints each question that the claimed agent
gets; at a line on stdin, sends the recorded requests again.
"""
import json
import sys

import zenoh

router, robot, agent = sys.argv[1:]
FORGED = "f" * 32
recorded = []
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router]},
    "scouting": {"multicast": {"enabled": False}},
}))


def lure(query):
    if not str(query.key_expr).endswith("/claim"):
        print("asked", query.key_expr, flush=True)
    query.reply(query.key_expr, "{}")


def answer_for_the_robot(query):
    payload = query.payload.to_bytes()
    recorded.append(payload)
    if len(recorded) == 1:
        print("Recording", flush=True)
    for lie in 20 * [b"/test;5;1;done", payload, payload[32:], bytes(100)]:
        query.reply(query.key_expr, lie)
    query.reply_err("not started: a lie")


with zenoh.open(config) as session:
    claims = [FORGED] + [f"{number:032x}" for number in range(500)]
    tokens = [session.liveliness().declare_token(f"ztl/{robot}/{claim}/alive") for claim in claims]
    tokens += [session.liveliness().declare_token(f"ztl/robot-{number}/{FORGED}/alive") for number in range(500)]
    forged = session.declare_queryable(f"ztl/{robot}/{FORGED}/**", lure)
    other = session.declare_queryable(f"ztl/{robot}/{agent}/sealed", answer_for_the_robot, complete=True)
    print("Hostile", flush=True)
    for line in sys.stdin:
        other.undeclare()
        copies = list(recorded)
        for payload in copies:
            list(session.get(f"ztl/{robot}/{agent}/sealed", payload=payload, timeout=5))
        print("replayed", len(copies), flush=True)
        other = session.declare_queryable(f"ztl/{robot}/{agent}/sealed", answer_for_the_robot, complete=True)
