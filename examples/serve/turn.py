# Turns the base, like a script of an old robot: Python 2 or 3, prints its progress, stops on Ctrl-C.
from __future__ import print_function
import json, os, sys, time

if os.path.exists("brake"):
    print("the brake is on", file=sys.stderr)
    sys.exit(2)

goal = float(sys.argv[1])
at = 0.0
try:
    while at != goal:
        print("@ %.0f degrees" % at)
        time.sleep(0.05)
        at = min(at + 20, goal) if goal > at else max(at - 20, goal)
except KeyboardInterrupt:
    print("stopped at %.0f degrees" % at)
    sys.exit(1)
print(json.dumps({"turned": at}))
