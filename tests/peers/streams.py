"""Publishes or subscribes with plain pyzmq, under Python 2.7 and 3: see README.md."""
import binascii
import sys

import zmq


def unhex(word):
    return binascii.unhexlify(word.encode("ascii"))


def show(frame):
    return binascii.hexlify(frame).decode("ascii")


context = zmq.Context()
if sys.argv[1] == "publisher":
    socket = context.socket(zmq.PUB)
    socket.bind("tcp://*:" + sys.argv[2])
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in iter(sys.stdin.readline, ""):
        socket.send_multipart([unhex(word) for word in line.rstrip("\n").split(" ")])
else:
    socket = context.socket(zmq.SUB)
    socket.connect("tcp://127.0.0.1:" + sys.argv[2])
    socket.setsockopt(zmq.SUBSCRIBE, sys.argv[3].encode("utf-8"))
    while True:
        sys.stdout.write(" ".join(show(frame) for frame in socket.recv_multipart()) + "\n")
        sys.stdout.flush()
