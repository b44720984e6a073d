"""A ZTL client in Python, with no package but pyzmq: starts a task and waits for its final state.

    pip install pyzmq
    python3 client.py tcp://localhost:12345 /robot robot:base:forward

prints the outcome, `COMPLETED: arrived`; the exit status is 0 only for COMPLETED.
"""

import base64, sys, time, zmq

STATES = "INITIATED ACCEPTED REJECTED FAILED ABORTED COMPLETED".split()
endpoint, scope, task = sys.argv[1:]
server = zmq.Context().socket(zmq.REQ)
# Do not queue requests for an absent server; do not take a late reply for the next one.
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
except zmq.Again:  # Never resend: the first may have started the task.
    print("UNKNOWN: no answer, the task may run")
    sys.exit(1)
while state <= 1:
    time.sleep(0.1)
    try:
        state, _id, text = ask(2, id, "status update")
    except zmq.Again:
        pass  # No reply is not a final state.
# A restarted server does not know the outcome.
lost = id > 0 and text.startswith("Invalid ID")
print(f"{'UNKNOWN' if lost else STATES[state]}: {text}")
sys.exit(state != 5)
