"""Stands in for the nodes of a robot, with rospy and actionlib. Lines on stdin command it; it ends with its stdin.

robot.py action NAME TOPIC...   serves actionlib/Test under each topic; the goal says what it does
robot.py topics NAME            publishes, subscribes, serves a service
robot.py proxy NAME REAL TOPIC  passes on the messages of the action REAL under TOPIC, but loses each result
"""

import os
import sys
import threading
import time

import actionlib
import rospy
from actionlib.msg import (
    TestAction, TestActionFeedback, TestActionGoal, TestActionResult, TestFeedback, TestResult,
)
from actionlib_msgs.msg import GoalID, GoalStatusArray
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger, TriggerResponse


def say(*words):
    print(*words, flush=True)


class Action:
    """Goals: 1 succeeds, 2 aborts, 3 is rejected, 4 gives feedback and runs until it is cancelled or told,
    5 waits and is recalled, 7 is never seen, 8 ignores cancels and runs until it is told;
    1000 and more give as many feedbacks, one a millisecond, and run as 4 does."""

    def __init__(self, topic):
        self.held = {}
        self.server = actionlib.ActionServer(topic, TestAction, self.on_goal, self.on_cancel, auto_start=False)
        receive = self.server.internal_goal_callback
        self.server.internal_goal_callback = lambda goal: goal.goal.goal == 7 or receive(goal)
        self.server.start()

    def on_goal(self, handle):
        goal = handle.get_goal().goal
        say("goal", goal)
        result = TestResult(result=goal * 10)
        if goal == 3:
            handle.set_rejected(result, "no")
            return
        if goal in (4, 5, 8) or goal >= 1000:
            # First, since a command may follow as soon as it is accepted.
            self.held[handle.get_goal_id().id] = handle
        if goal != 5:
            handle.set_accepted("yes")
        if goal == 4:
            handle.publish_feedback(TestFeedback(feedback=5))
        if goal == 1:
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
        if handle.get_goal().goal == 8:
            return
        self.held.pop(handle.get_goal_id().id, None)
        handle.set_canceled(TestResult(result=-1), "stopped")

    def command(self, word):
        for handle in list(self.held.values()):
            if word == "finish":
                handle.set_succeeded(TestResult(result=7), "told")
            elif word == "preempt":
                handle.set_canceled(TestResult(result=8), "by another")
        self.held.clear()


class Proxy:
    def __init__(self, real, topic):
        for part in ("goal", "cancel"):
            self.forward(f"/{topic}/{part}", f"/{real}/{part}")
        for part in ("status", "feedback"):
            self.forward(f"/{real}/{part}", f"/{topic}/{part}")
        # The type is known without a message.
        self.result = rospy.Publisher(f"/{topic}/result", TestActionResult, queue_size=10)
        rospy.Subscriber(f"/{real}/result", TestActionResult, lambda result: say("lost", result.result.result))

    def forward(self, source, target):
        kind = {
            "goal": TestActionGoal, "cancel": GoalID, "status": GoalStatusArray, "feedback": TestActionFeedback,
        }[source.rsplit("/", 1)[1]]
        to = rospy.Publisher(target, kind, queue_size=100)
        rospy.Subscriber(source, kind, to.publish)


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
    if kind == "action":
        node = [Action(topic) for topic in rest][0]
    elif kind == "proxy":
        node = Proxy(*rest)
    else:
        node = Topics(name)
    say("ready")
    for line in sys.stdin:
        node.command(*line.split())
    os._exit(0)


main()
