"""The original's RemoteTask, driven line by line, under Python 2.7 and 3: see README.md."""
import binascii
import sys

import zmq
from ztl.core.client import RemoteTask
from ztl.core.protocol import Task

# How long a request waits for its answer, in seconds: on a busy machine, the original's 2 s may be too short.
PATIENCE = 60


def text(word):
    decoded = binascii.unhexlify(word.encode("ascii")).decode("utf-8")
    # Python 2: the original takes its `str`.
    return decoded if sys.version_info[0] > 2 else decoded.encode("utf-8")


def set_timeout(seconds):
    remote.timeout = int(1000 * seconds)
    if remote.socket is not None:
        remote.socket.setsockopt(zmq.RCVTIMEO, remote.timeout)
        remote.socket.setsockopt(zmq.SNDTIMEO, remote.timeout)


host, port, scope = sys.argv[-3:]
remote = RemoteTask(host, int(port), scope, timeout=1000 * PATIENCE)
# Not `for line in sys.stdin`: Python 2 reads ahead.
for line in iter(sys.stdin.readline, ""):
    words = line.rstrip("\n").split(" ")
    verb, words = words[0], words[1:]
    if verb == "trigger":
        number, reply = remote.trigger(Task.encode(*map(text, words)))
    elif verb == "status":
        number, reply = remote.status(int(words[0]))
    elif verb == "abort":
        number, reply = remote.abort(int(words[0]))
    elif verb == "wait":
        limit = float(words[1])
        # Without an answer, it ends at its limit.
        set_timeout(limit if limit >= 2 else PATIENCE)
        number, reply = remote.wait(int(words[0]), timeout=limit)
        set_timeout(PATIENCE)
    reply = reply if isinstance(reply, type(u"")) else str(reply)
    shown = binascii.hexlify(reply.encode("utf-8")).decode("ascii")
    sys.stdout.write("%d %s\n" % (number, shown))
    sys.stdout.flush()
