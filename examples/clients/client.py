"""A ZTL client in Python, with nothing but pyzmq: asks for a task and waits for its end.

    pip install pyzmq
    python3 client.py tcp://localhost:12345 /robot robot:base:forward

prints how it ended, `COMPLETED: arrived`; the exit status is 0 only for COMPLETED.
"""

import base64, sys, time, zmq

STATES = "INITIATED ACCEPTED REJECTED FAILED ABORTED COMPLETED".split()
endpoint, scope, task = sys.argv[1:]
server = zmq.Context().socket(zmq.REQ)
# Nothing waits for a server that is not there; a late answer is not taken for the next one.
for option in zmq.IMMEDIATE, zmq.REQ_RELAXED, zmq.REQ_CORRELATE:
    server.setsockopt(option, 1)
server.linger, server.sndtimeo, server.rcvtimeo = 0, 2000, 2000
server.connect(endpoint)


def ask(code, id, payload):
    server.send_string(f"{scope};{code};{id};{payload}")
    _scope, state, id, text = server.recv_string().split(";", 3)
    return int(state), int(id), text


try:
    state, id, text = ask(1, -1, base64.b64encode(task.encode()).decode())
except zmq.Again:  # Never sent again: the first may have been acted on.
    print("UNKNOWN: no answer, the task may run")
    sys.exit(1)
while state <= 1:
    time.sleep(0.1)
    try:
        state, _id, text = ask(2, id, "status update")
    except zmq.Again:
        pass  # No answer is not an end.
# A server that was started anew does not know what became of it.
lost = id > 0 and text.startswith("Invalid ID")
print(f"{'UNKNOWN' if lost else STATES[state]}: {text}")
sys.exit(state != 5)
