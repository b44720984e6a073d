"""A router of Zenoh in another program than ours: router.py ADDRESS."""
import json
import sys
import threading

import zenoh

config = zenoh.Config.from_json5(json.dumps({
    "mode": "router",
    "listen": {"endpoints": [sys.argv[1]]},
    "scouting": {"multicast": {"enabled": False}},
}))
with zenoh.open(config):
    print("Routing", flush=True)
    threading.Event().wait()
