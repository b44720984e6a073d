"""Stands in for the topics of a robot's base and arm, with rospy. It ends with its stdin.

stand_in.py NAME   takes /NAME/cmd_vel and prints it; moves two joints by /NAME/command, and publishes /NAME/joint_states
"""

import os
import sys
import threading
import time

import rospy
from geometry_msgs.msg import Twist
from sensor_msgs.msg import BatteryState, CompressedImage, JointState
from std_srvs.srv import SetBool, SetBoolResponse
from trajectory_msgs.msg import JointTrajectory

# How fast the joints move, in rad/s.
SPEED = 2.0
STEP = 0.01


def say(*words):
    print(*words, flush=True)


class Arm:
    def __init__(self, name):
        self.places = {"shoulder": 0.0, "elbow": 0.0}
        self.targets = dict(self.places)
        self.states = rospy.Publisher(f"/{name}/joint_states", JointState, queue_size=10)
        rospy.Subscriber(f"/{name}/command", JointTrajectory, self.on_trajectory)
        threading.Thread(target=self.move, daemon=True).start()

    def on_trajectory(self, trajectory):
        if not trajectory.points:
            say("stop")
            self.targets = dict(self.places)
            return
        point = trajectory.points[-1]
        say("trajectory", *trajectory.joint_names, *point.positions, point.time_from_start.to_sec())
        self.targets.update(zip(trajectory.joint_names, point.positions))

    def move(self):
        while True:
            for joint, place in self.places.items():
                way = self.targets[joint] - place
                self.places[joint] += max(-SPEED * STEP, min(SPEED * STEP, way))
            # One message for each joint, as of two drivers.
            for joint, place in self.places.items():
                self.states.publish(JointState(name=[joint], position=[place]))
            # The arm moves in real time.
            time.sleep(STEP)


def on_light(request):
    return SetBoolResponse(request.data, "on" if request.data else "the lamp is broken")


def main():
    name = sys.argv[1]
    rospy.init_node(name, disable_signals=True, disable_rosout=True)
    rospy.Subscriber(f"/{name}/cmd_vel", Twist, lambda twist: say("twist", twist.linear.x, twist.angular.z))
    rospy.Service(f"/{name}/light", SetBool, on_light)
    battery = rospy.Publisher(f"/{name}/battery", BatteryState, queue_size=1, latch=True)
    battery.publish(BatteryState(percentage=0.5, voltage=float("nan"), present=True))
    camera = rospy.Publisher(f"/{name}/camera", CompressedImage, queue_size=1, latch=True)
    camera.publish(CompressedImage(format="jpeg", data=b"\xff\xd8 not quite \xff\xd9"))
    rospy.set_param(f"/{name}/limits", {"speed": 0.5, "joints": ["shoulder", "elbow"]})
    Arm(name)
    say("ready")
    for _ in sys.stdin:
        pass
    os._exit(0)


main()
