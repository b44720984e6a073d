"""Somebody hostile who may connect: hostile_stream.py ROUTER ROBOT.

Records all messages of the robot's streams. At a line on stdin, sends them again, and others of its own making.
"""
import json
import sys

import zenoh

router, robot = sys.argv[1:]
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router]},
    "scouting": {"multicast": {"enabled": False}},
}))
recorded = []
forging = False


def record(sample):
    if forging:
        return
    recorded.append((str(sample.key_expr), sample.payload.to_bytes()))
    print("recorded", len(recorded), flush=True)


with zenoh.open(config) as session:
    subscriber = session.declare_subscriber(f"ztl/{robot}/*/streams/*", record)
    print("Hostile", flush=True)
    for line in sys.stdin:
        forging = True
        for key, payload in list(recorded):
            head = {"session": "0" * 32, "number": 1000, "topic": "/test/number", "scope": "/test", "state": False}
            lie = json.dumps(head).encode() + b"\nN."
            changed = payload[:-1] + bytes([payload[-1] ^ 1])
            for sent in [payload, lie, b"ztl-fleet stream 1\n" + lie, changed, payload[:30], b""]:
                session.put(key, sent, congestion_control=zenoh.CongestionControl.BLOCK)
        # What is sent after it arrives after it.
        list(session.get(f"ztl/{robot}/*/claim?agent={'f' * 32}", timeout=5))
        print("replayed", line.strip(), flush=True)
        forging = False
