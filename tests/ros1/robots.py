"""Stands in for a whole robot, with rospy: its actions, topics and joints by their real names. It ends with its stdin.

robots.py ROBOT DEFINITIONS   ROBOT is fetch, care-o-bot-4 or turtlebot3; DEFINITIONS is a file with definitions of messages

The types that Debian does not have are made from DEFINITIONS by genpy, ROS's own generator. The line `arrive` on stdin ends
a motion of the base.
"""

import os
import re
import sys

# The node that drives the base of each robot. rospy takes its namespace when it is imported.
NODES = {"fetch": "/cmd_vel_mux", "care-o-bot-4": "/base/twist_mux", "turtlebot3": "/turtlebot3_core"}
NAMESPACE, NODE = NODES[sys.argv[1]].rsplit("/", 1)
os.environ["ROS_NAMESPACE"] = NAMESPACE or "/"

import actionlib
import rospy
from genpy.dynamic import generate_dynamic
from geometry_msgs.msg import Twist
from sensor_msgs.msg import BatteryState, CompressedImage, JointState
from std_msgs.msg import Bool


def say(*words):
    print(*words, flush=True)


class Definitions:
    PARTS = ("Goal", "Result", "Feedback")

    def __init__(self, path):
        with open(path) as file:
            sections = file.read().split("\n== ")[1:]
        self.texts = {}
        for section in sections:
            title, _, text = section.partition("\n")
            kind, name = title.split(" ")
            if kind == "msg":
                self.texts[name] = text.strip("\n") + "\n"
            elif kind == "action":
                self.add_action(name, text)

    def add_action(self, name, text):
        """The seven messages of an action, as actionlib's genaction makes them."""
        head = "Header header\n"
        status = "actionlib_msgs/GoalStatus status\n"
        package, _, short = name.partition("/")
        for part, text in zip(self.PARTS, re.split("^---$", text + "\n", flags=re.M)):
            self.texts[name + part] = text.strip("\n") + "\n"
            more = "actionlib_msgs/GoalID goal_id\n" if part == "Goal" else status
            self.texts[f"{name}Action{part}"] = f"{head}{more}{short}{part} {part.lower()}\n"
        parts = (f"{short}Action{part} action_{part.lower()}\n" for part in self.PARTS)
        self.texts[f"{name}Action"] = "".join(parts)

    def needs(self, name):
        """The names of the types of its fields."""
        for line in self.texts[name].splitlines():
            kind = line.split(" ")[0].split("[")[0]
            for full in (kind, f"{name.partition('/')[0]}/{kind}", f"std_msgs/{kind}" if kind == "Header" else kind):
                if full in self.texts:
                    yield full
                    break

    def type(self, name):
        """The class of a message type, with all its parts."""
        names = [name]
        for known in names:
            names += [need for need in self.needs(known) if need not in names]
        texts = [self.texts[name]] + [f"MSG: {part}\n{self.texts[part]}" for part in names[1:]]
        return generate_dynamic(name, ("=" * 80 + "\n").join(texts))[name]


class Robot:
    def __init__(self, definitions):
        self.definitions = definitions
        self.joints = {}
        self.states = rospy.Publisher("/joint_states", JointState, queue_size=1, latch=True)
        self.held = []
        self.actions = []

    def serve(self, name, type, on_goal, on_cancel=None):
        server = actionlib.ActionServer(
            name, self.definitions.type(type), on_goal, on_cancel or (lambda _: None), auto_start=False
        )
        server.start()
        self.actions.append(server)

    def trajectories(self, name):
        """A controller whose joints are at once where the last point wants them."""
        names = f"{name}/follow_joint_trajectory"
        self.serve(names, "control_msgs/FollowJointTrajectoryAction", lambda handle: self.move(names, handle))

    def move(self, name, handle):
        trajectory = handle.get_goal().trajectory
        point = trajectory.points[-1]
        say(name, *trajectory.joint_names, *point.positions, "in", point.time_from_start.to_sec())
        handle.set_accepted()
        self.joints.update(zip(trajectory.joint_names, point.positions))
        self.states.publish(JointState(name=list(self.joints), position=list(self.joints.values())))
        handle.set_succeeded()

    def base(self, topic):
        rospy.Subscriber(topic, Twist, lambda twist: say("twist", twist.linear.x, twist.angular.z))
        self.serve("/move_base", "move_base_msgs/MoveBaseAction", self.go, self.stay)

    def go(self, handle):
        pose = handle.get_goal().target_pose
        self.held.append(handle)
        handle.set_accepted()
        place, turn = pose.pose.position, pose.pose.orientation
        say("go", pose.header.frame_id, place.x, place.y, round(turn.z, 3), round(turn.w, 3))

    def stay(self, handle):
        self.held.remove(handle)
        handle.set_canceled()

    def command(self, word):
        if word == "arrive":
            self.held.pop().set_succeeded()

    def publish(self, topic, message):
        rospy.Publisher(topic, type(message), queue_size=1, latch=True).publish(message)


class Fetch(Robot):
    def __init__(self, definitions):
        super().__init__(definitions)
        self.base("/cmd_vel")
        for name in ("arm_with_torso", "arm", "torso"):
            self.trajectories(f"/{name}_controller")
        self.serve("/head_controller/point_head", "control_msgs/PointHeadAction", self.look)
        self.serve("/gripper_controller/gripper_action", "control_msgs/GripperCommandAction", self.grip)
        self.publish("/head_camera/rgb/image_raw/compressed", CompressedImage(format="jpeg", data=b"\xff\xd8\xff\xd9"))

    def look(self, handle):
        goal = handle.get_goal()
        point = goal.target.point
        say("look", goal.target.header.frame_id, point.x, point.y, point.z, goal.min_duration.to_sec())
        handle.set_accepted()
        handle.set_succeeded()

    def grip(self, handle):
        command = handle.get_goal().command
        say("grip", command.position, command.max_effort)
        handle.set_accepted()
        result = self.actions[-1].ActionResultType()
        result.position = command.position
        handle.set_succeeded(result)


class CareOBot(Robot):
    def __init__(self, definitions):
        super().__init__(definitions)
        self.base("/base/twist_mux/command_script")
        for name in ("arm_left", "gripper_left", "torso", "sensorring"):
            self.trajectories(f"/{name}/joint_trajectory_controller")


class TurtleBot(Robot):
    def __init__(self, definitions):
        super().__init__(definitions)
        self.base("/cmd_vel")
        rospy.Subscriber("/motor_power", Bool, lambda power: say("power", power.data))
        self.publish("/battery_state", BatteryState(percentage=0.5, present=True))
        self.joints = {"wheel_left_joint": 0.0, "wheel_right_joint": 0.0}
        self.states.publish(JointState(name=list(self.joints), position=list(self.joints.values())))


ROBOTS = {"fetch": Fetch, "care-o-bot-4": CareOBot, "turtlebot3": TurtleBot}


def main():
    rospy.init_node(NODE, disable_signals=True, disable_rosout=True)
    robot = ROBOTS[sys.argv[1]](Definitions(sys.argv[2]))
    say("ready")
    for line in sys.stdin:
        robot.command(line.strip())
    os._exit(0)


main()
