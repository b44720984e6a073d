"""Somebody who would like to connect: stranger.py ROUTER CA [CERTIFICATE KEY]. Prints whether the router lets them."""
import json
import sys

import zenoh

router, ca, *own = sys.argv[1:]
tls = {"root_ca_certificate": ca}
if own:
    tls |= {"connect_certificate": own[0], "connect_private_key": own[1], "enable_mtls": True}
config = zenoh.Config.from_json5(json.dumps({
    "mode": "client",
    "connect": {"endpoints": [router], "timeout_ms": 5000},
    "scouting": {"multicast": {"enabled": False}},
    "transport": {"link": {"tls": tls}},
}))
try:
    with zenoh.open(config) as session:
        print("let in" if list(session.info.routers_zid()) else "refused")
except zenoh.ZError:
    print("refused")
