"""Stands in for the nodes of a robot, with rospy and actionlib. Lines on stdin command it; it ends with its stdin.

robot.py action NAME TOPIC...   serves actionlib/Test under each topic; the goal says what it does
robot.py topics NAME            publishes, subscribes, serves a service
"""

import os
import sys
import threading
import time

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger, TriggerResponse


def say(*words):
    print(*words, flush=True)


class Action:
    """Goals: 1 succeeds, 2 aborts, 3 is rejected, 4 gives feedback and runs until it is cancelled or told,
    5 waits and is recalled, 6 loses its result, 7 is never seen;
    1000 and more give as many feedbacks, one a millisecond, and run as 4 does."""

    def __init__(self, topic):
        self.held = {}
        self.server = actionlib.ActionServer(topic, TestAction, self.on_goal, self.on_cancel, auto_start=False)
        self.publish_result = self.server.publish_result
        receive = self.server.internal_goal_callback
        self.server.internal_goal_callback = lambda goal: goal.goal.goal == 7 or receive(goal)
        self.server.start()

    def on_goal(self, handle):
        goal = handle.get_goal().goal
        say("goal", goal)
        result = TestResult(result=goal * 10)
        self.server.publish_result = (lambda *_: None) if goal == 6 else self.publish_result
        if goal == 3:
            handle.set_rejected(result, "no")
            return
        if goal in (4, 5) or goal >= 1000:
            # First, since a command may follow as soon as it is accepted.
            self.held[handle.get_goal_id().id] = handle
        if goal != 5:
            handle.set_accepted("yes")
        if goal == 4:
            handle.publish_feedback(TestFeedback(feedback=5))
        if goal in (1, 6):
            handle.set_succeeded(result, "done")
        elif goal == 2:
            handle.set_aborted(result, "broken")
        elif goal >= 1000:
            threading.Thread(target=self.feed, args=(handle, goal), daemon=True).start()

    def feed(self, handle, count):
        start = time.monotonic()
        for number in range(count):
            handle.publish_feedback(TestFeedback(feedback=number))
            # The rate is what is tested.
            time.sleep(max(0, start + (number + 1) * 0.001 - time.monotonic()))

    def on_cancel(self, handle):
        say("cancel", handle.get_goal_id().id)
        self.held.pop(handle.get_goal_id().id, None)
        handle.set_canceled(TestResult(result=-1), "stopped")

    def command(self, word):
        for handle in list(self.held.values()):
            if word == "finish":
                handle.set_succeeded(TestResult(result=7), "told")
            elif word == "preempt":
                handle.set_canceled(TestResult(result=8), "by another")
        self.held.clear()


class Topics:
    """Publishes what it is told under /NAME/out, prints the first words of what it receives under /NAME/in."""

    def __init__(self, name):
        self.out = rospy.Publisher(f"/{name}/out", String, queue_size=100, latch=True)
        rospy.Subscriber(f"/{name}/in", String, lambda message: say("heard", message.data.split()[0]))
        rospy.Subscriber(f"/{name}/number", Int32, lambda message: say("number", message.data))
        rospy.Service(f"/{name}/trigger", Trigger, lambda _: TriggerResponse(True, "pulled"))
        rospy.Service(f"/{name}/broken", Trigger, self.broken)
        self.clock = None

    def broken(self, _):
        raise rospy.ServiceException("it is broken")

    def command(self, word, *words):
        if word == "flood":
            threading.Thread(target=self.flood, daemon=True).start()
        elif word == "clock":
            self.clock = self.clock or rospy.Publisher("/clock", Clock, queue_size=1, latch=True)
            self.clock.publish(Clock(rospy.Time(int(words[0]))))
        else:
            self.out.publish(String(" ".join([word, *words])))

    def flood(self):
        message = String("x" * 100_000)
        while True:
            self.out.publish(message)


def main():
    kind, name, *rest = sys.argv[1:]
    rospy.init_node(name, disable_signals=True, disable_rosout=True)
    node = [Action(topic) for topic in rest][0] if kind == "action" else Topics(name)
    say("ready")
    for line in sys.stdin:
        node.command(*line.split())
    os._exit(0)


main()
