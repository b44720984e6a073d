//! The files of real robots in `examples/serve/ros1`, played against stand-ins with the same names and types.

use std::path::Path;

use ztl_std::State::{Aborted, Completed};
use ztl_std::{RemoteTask, Subscriber};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, connect_to, end, reserve_port, start, until, ztl,
};

use crate::rig::{Master, wait};
use crate::serve::run;

/// A robot, and `ztl serve` with its file.
struct Robot {
    node: Process,
    server: Server,
    scope: &'static str,
    publish: u16,
    _scratch: Scratch,
    _master: Master,
}

impl Robot {
    /// Has its file checked and served.
    #[track_caller]
    fn new(name: &str, scope: &'static str) -> Self {
        let package = Path::new(env!("CARGO_MANIFEST_DIR"));
        // Names are absolute: each robot has a master of its own.
        let master = Master::start();
        let mut python = master.debian_python();
        python.arg(package.join("ros1/robots.py")).arg(name);
        python.arg(package.join("../ztl-ros1/src/message/carried.txt"));
        let node = Process::start(&mut python);
        node.wait_for("ready");

        let example = package.join(format!("../examples/serve/ros1/{name}.yaml"));
        let text = std::fs::read_to_string(example).expect("an example");
        let here = format!("http://127.0.0.1:{}\", host: 127.0.0.1", master.port);
        let text = text.replace("http://localhost:11311\"", &here);
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text).expect("to write");
        let publish = reserve_port();
        let serve = || {
            let mut command = ztl();
            command.arg("serve").arg(&path).args(["-p", "0"]);
            command.args(["--publish", &publish.to_string()]);
            command
        };
        let checked = Process::run(serve().arg("--check"));
        assert_eq!(checked.code, Some(0), "{checked:?}");
        assert!(!checked.stderr.contains("warning"), "{checked:?}");
        let server = Server::start(&mut serve());
        Self {
            node,
            server,
            scope,
            publish,
            _scratch: scratch,
            _master: master,
        }
    }

    fn remote(&self) -> RemoteTask {
        connect_to(&self.server.endpoint(), self.scope)
    }

    /// Runs `handler:component:goal`, which completes, and waits until the robot prints this.
    #[track_caller]
    fn does(&self, task: &str, printed: &str) -> String {
        let parts: Vec<&str> = task.splitn(3, ':').collect();
        let [handler, component, goal] = parts[..] else {
            panic!("{task}");
        };
        let (state, text) = run(|| self.remote(), handler, component, goal).expect(task);
        assert_eq!(state, Completed, "{task}: {text}");
        self.prints(printed);
        text
    }

    /// Waits until the robot has printed this line.
    #[track_caller]
    fn prints(&self, line: &str) {
        wait(line, || {
            self.node.stdout().lines().any(|printed| printed == line)
        });
    }

    /// The base drives and stops, goes to a place, and stops on the way to another.
    #[track_caller]
    fn base_moves(&mut self) {
        // A busy machine may pause for longer than the file's dead-man time.
        until("a drive without a pause", PATIENCE, || {
            let goal = "{speed: 0.2, seconds: 0.3}";
            let (state, text) = run(|| self.remote(), "base", "drive", goal).expect(goal);
            if text.contains("longer than dead-man") {
                return None;
            }
            assert_eq!(state, Completed, "{text}");
            Some(())
        });
        self.prints("twist 0.2 0.0");
        self.prints("twist 0.0 0.0");

        let mut remote = self.remote();
        let place = "{x: 1, y: 2, yaw: 3.14159265}";
        let task = start(&mut remote, "base", "goto", place);
        self.prints("go map 1.0 2.0 1.0 0.0");
        self.node.write_line("arrive");
        let (state, text) = end(&mut remote, task);
        assert_eq!(state, Completed, "{text}");

        let place = "{x: 5, y: 0, yaw: 0}";
        let task = start(&mut remote, "base", "goto", place);
        remote.abort(task).expect("an answer");
        let (state, text) = end(&mut remote, task);
        assert_eq!(state, Aborted, "{text}");
    }

    /// The next value of a stream.
    #[track_caller]
    fn next(&self, stream: &str) -> String {
        let endpoint = format!("tcp://127.0.0.1:{}", self.publish);
        let topic = format!("{}/{stream}", self.scope);
        let mut subscriber = Subscriber::connect(&endpoint, &topic).expect("a file");
        let heard = subscriber.next_within(PATIENCE).expect("it can wait");
        let value = heard.expect("a message").value().expect("plain data");
        value.value().repr().to_string()
    }
}

#[test]
fn a_fetch_moves_looks_grips_and_drives() {
    let mut robot = Robot::new("fetch", "/fetch");
    robot.does(
        "arm:pose:tucked",
        "/arm_with_torso_controller/follow_joint_trajectory torso_lift_joint shoulder_pan_joint shoulder_lift_joint \
         upperarm_roll_joint elbow_flex_joint forearm_roll_joint wrist_flex_joint wrist_roll_joint \
         0.05 1.32 1.4 -0.2 1.72 0.0 1.66 0.0 in 6.0",
    );
    robot.does(
        "arm:move:{positions: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]}",
        "/arm_controller/follow_joint_trajectory shoulder_pan_joint shoulder_lift_joint upperarm_roll_joint \
         elbow_flex_joint forearm_roll_joint wrist_flex_joint wrist_roll_joint 0.1 0.2 0.3 0.4 0.5 0.6 0.7 in 6.0",
    );
    let line = "/torso_controller/follow_joint_trajectory torso_lift_joint 0.4 in 5.0";
    robot.does("torso:lift:up", line);
    let look = "head:look:{x: 1, y: 0.5, z: 0.25}";
    robot.does(look, "look base_link 1.0 0.5 0.25 1.0");
    assert_eq!(robot.does("gripper:grip:0.05", "grip 0.05 60.0"), "0.05");
    robot.base_moves();
    assert!(robot.next("joints").contains("torso_lift_joint"));
    assert_eq!(robot.next("camera"), r"b'\xff\xd8\xff\xd9'");
}

#[test]
fn a_care_o_bot_moves_its_arm_gripper_torso_and_head_and_drives() {
    let mut robot = Robot::new("care-o-bot-4", "/cob");
    robot.does(
        "arm-left:pose:folded",
        "/arm_left/joint_trajectory_controller/follow_joint_trajectory arm_left_1_joint arm_left_2_joint arm_left_3_joint \
         arm_left_4_joint arm_left_5_joint arm_left_6_joint arm_left_7_joint 0.9599 1.5708 -0.12 1.0 1.38 0.75 -1.36 in 8.0",
    );
    robot.does(
        "gripper-left:pose:open",
        "/gripper_left/joint_trajectory_controller/follow_joint_trajectory gripper_left_finger_1_joint \
         gripper_left_finger_2_joint 0.85 -1.4 in 4.0",
    );
    robot.does(
        "torso:pose:back",
        "/torso/joint_trajectory_controller/follow_joint_trajectory torso_2_joint torso_3_joint 3.14 -1.57 in 10.0",
    );
    robot.does(
        "sensorring:pose:left",
        "/sensorring/joint_trajectory_controller/follow_joint_trajectory sensorring_joint 1.57 in 4.0",
    );
    robot.base_moves();
    assert!(robot.next("joints").contains("sensorring_joint"));
}

#[test]
fn a_turtlebot_drives_and_switches_its_motors() {
    let mut robot = Robot::new("turtlebot3", "/turtlebot");
    robot.does("motors:power:True", "power True");
    robot.base_moves();
    assert!(robot.next("battery").contains("'percentage': 0.5"));
    assert!(robot.next("joints").contains("wheel_left_joint"));
}
