//! What `ztl serve FILE --check` finds on a robot that runs.

use std::path::Path;

use ztl_tests::lab::{Ended, Process, Scratch, ztl};

use crate::rig::{Master, unique};
use crate::serve::Robot;

/// Checks these lines after `ros1`; definitions are those below `packages` first.
#[track_caller]
fn check(scratch: &Scratch, lines: &str) -> Ended {
    let path = scratch.path("robot.yaml");
    let port = Master::shared().port;
    let text = format!("ros1: {{master: 'http://127.0.0.1:{port}', host: 127.0.0.1}}\n{lines}");
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    command.env("ROS_PACKAGE_PATH", scratch.path("packages"));
    command.arg("serve").arg(&path);
    let ended = Process::run(command.args(["--check", "-p", "0", "--publish", "0"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    ended
}

/// Asserts that these are the warnings.
#[track_caller]
fn warns(ended: &Ended, expected: &[&str]) {
    for part in expected {
        assert!(ended.stderr.contains(part), "{part}: {}", ended.stderr);
    }
    let count = ended.stderr.matches("warning: ").count();
    assert_eq!(count, expected.len(), "{}", ended.stderr);
}

pub(crate) fn define(scratch: &Scratch, file: &str, definition: &str) {
    let path = Path::new(&scratch.path("packages")).join(file);
    let package = path.parent().and_then(Path::parent).expect("a package");
    std::fs::create_dir_all(path.parent().expect("a directory")).expect("to make");
    std::fs::write(package.join("package.xml"), "<package/>").expect("to write");
    std::fs::write(&path, definition).expect("to write");
}

#[test]
fn a_definition_that_only_receivers_know_is_compared() {
    let master = Master::shared();
    let (action, robot) = (unique("defined"), unique("typed"));
    let _action = master.action(&action, &action);
    let _robot = master.robot(&["topics", &robot]);
    let scratch = Scratch::new();
    let test = "int64 goal\n---\nint32 result\n---\nint32 feedback\n";
    define(&scratch, "actionlib/action/Test.action", test);
    define(&scratch, "std_msgs/msg/Int32.msg", "int64 data\n");
    let lines = format!(
        "scopes: {{/test: {{p: {{
    count: {{ros1-action: /{action}, type: actionlib/TestAction}},
    set: {{ros1-publish: /{robot}/number, type: std_msgs/Int32}},
    right: {{ros1-publish: /{robot}/in, type: std_msgs/String}}}}}}}}"
    );
    let ended = check(&scratch, &lines);
    let goal = format!(
        "robot.yaml:3:26: warning: /{action} has another definition of the type: /{action}/goal is actionlib/TestActionGoal with MD5 sum "
    );
    let number = format!(
        "robot.yaml:4:25: warning: /{robot} has another definition of the type: /{robot}/number is std_msgs/Int32 with MD5 sum "
    );
    warns(&ended, &[&goal, &number]);
}

#[test]
fn another_server_of_ours_hides_no_mistake() {
    let typos = "scopes: {/test: {p: {
            drive: {ros1-publish: /NAME/cmdvel, type: geometry_msgs/Twist},
            count: {ros1-action: /NAME/test, type: actionlib/TestAction}}}}
streams: {/test: {joints: {ros1-topic: /NAME/joint_stats, type: sensor_msgs/JointState}}}";
    let robot = Robot::new(typos);
    let name = &robot.name;
    // It has registered these.
    for topic in ["cmdvel", "test/goal"] {
        crate::rig::publisher_of(&Master::shared().node(), &format!("/{name}/{topic}"));
    }
    let ended = check(&Scratch::new(), &typos.replace("NAME", name));
    let topic =
        format!("the master knows no topic /{name}/cmdvel; did you mean '/{name}/cmd_vel'?");
    let action = format!("the master knows no action /{name}/test; ");
    let joints = format!("the master knows no topic /{name}/joint_stats; ");
    warns(&ended, &[&topic, &action, &joints]);
}

#[test]
fn topics_of_the_wrong_direction_nodes_that_hang_and_parameters_that_are_not_set_are_told() {
    let robot = Robot::new("scopes: {/test: {p: {none: {ros1-parameter: /none}}}}");
    let name = &robot.name;
    let lines = format!(
        "scopes: {{/test: {{p: {{
    limits: {{ros1-parameter: /{name}/limit}},
    battery: {{ros1-publish: /{name}/battery, type: sensor_msgs/BatteryState}},
    base: {{ros1-publish: /{name}/cmd_vel, type: geometry_msgs/Twist, subscriber: /base}},
    right: {{ros1-publish: /{name}/cmd_vel, type: geometry_msgs/Twist, subscriber: /{name}}},
    light: {{ros1-service: /{name}/light, type: std_srvs/SetBool}}}}}}}}
streams: {{/test: {{drive: {{ros1-topic: /{name}/cmd_vel, type: geometry_msgs/Twist}}}}}}"
    );
    let scratch = Scratch::new();
    let limit = format!("3:30: warning: the parameter /{name}/limit is not set; ");
    let battery =
        format!("4:29: warning: no node subscribes to /{name}/battery, which /{name} publishes; ");
    let base = format!(
        "5:26: warning: /base does not subscribe to /{name}/cmd_vel; there are: /{name}; write subscriber: /{name}"
    );
    let drive =
        format!("8:39: warning: no node publishes /{name}/cmd_vel, to which /{name} subscribes; ");
    let always = [&limit[..], &battery, &base, &drive];
    warns(&check(&scratch, &lines), &always);
    robot.node.signal("STOP");
    let base = format!(
        "6:27: warning: the subscriber of /{name}/cmd_vel, /{name}, cannot be reached: no answer from "
    );
    let light = format!(
        "7:27: warning: the server of /{name}/light, /{name}, cannot be reached: no answer from "
    );
    warns(
        &check(&scratch, &lines),
        &[&always[..], &[&base, &light]].concat(),
    );
}
