"""The unmodified roslibpy as a client: roslibpy_client.py URL."""

import os
import sys
import threading

import roslibpy
from roslibpy import ActionClient, Goal, Ros, Service, Topic

LIMIT = 20
ros = Ros(sys.argv[1])
ros.run(LIMIT)


class Run:
    """A goal, and how it ends."""

    def __init__(self, component, goal):
        self.progress, self.ended, self.done = [], None, threading.Event()
        self.client = ActionClient(ros, "/test/" + component, "ztl_msgs/action/Task")
        self.id = self.client.send_goal(Goal({"goal": goal}), self.end, self.progress.append, self.end)

    def end(self, result):
        self.ended = result
        self.done.set()

    def values(self):
        assert self.done.wait(LIMIT), "no result"
        return self.ended["values"]


told = Run("test/echo", "hi").values()
assert (told["state"], told["text"]) == ("COMPLETED", "hi") and told["id"] > 0, told
first, second = Run("test/sleep", "60"), Run("test/sleep", "61")
second.client.cancel_goal(second.id)
assert second.values()["state"] in ("ABORTED", "NOT_STARTED"), second.ended

seen, found = threading.Event(), []


def look(message):
    for task in message["tasks"]:
        if task["task"] == "test:sleep:60" and task["runs"]:
            found.append(task)
            seen.set()


Topic(ros, "/ztl/tasks", "ztl_msgs/msg/Tasks").subscribe(look)
assert seen.wait(LIMIT), "the task is not listed"
first.client.cancel_goal(first.id)
assert first.values()["state"] == "ABORTED", first.ended
assert first.ended["status"].value == 5, first.ended
robots = Service(ros, "/ztl/robots", "ztl_msgs/srv/Any").call(roslibpy.ServiceRequest({}), timeout=LIMIT)
assert robots["robots"][0]["name"] == "ours", robots
stopped = Service(ros, "/ztl/stop", "ztl_msgs/srv/Any").call(roslibpy.ServiceRequest({}), timeout=LIMIT)
assert stopped["robots"][0]["confirmed"] is True, stopped
print("passed", flush=True)
# Its reactor cannot be ended by itself.
os._exit(0)
