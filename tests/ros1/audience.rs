//! Who must receive what a task publishes, and the reasons why nobody does.

use ztl_tests::lab::{PATIENCE, Scratch, Server, connect, reserve_port, until, ztl};

use crate::rig::{Master, listen, publisher_of, unique};
use crate::serve::{Robot, run_once};

/// `ztl serve` with a file.
struct Served {
    server: Server,
    _scratch: Scratch,
}

impl Served {
    /// Serves these components of the handler `p`, as a node of this host.
    #[track_caller]
    fn new(port: u16, host: &str, components: &str) -> Self {
        let scratch = Scratch::new();
        let path = scratch.path("robot.yaml");
        let text = format!(
            "ros1: {{master: 'http://127.0.0.1:{port}', host: {host}}}\nscopes: {{/test: {{p: {{{components}}}}}}}"
        );
        std::fs::write(&path, text).expect("to write");
        let mut command = ztl();
        command.arg("serve").arg(&path).args(["-p", "0"]);
        Self {
            server: Server::start(&mut command),
            _scratch: scratch,
        }
    }

    /// Runs a component until it is rejected for a reason with these parts. A busy machine may find out less at first.
    #[track_caller]
    fn is_rejected(&self, component: &str, goal: &str, parts: &[&str]) {
        let mut last = None;
        let is_it = |reason: &String| parts.iter().all(|part| reason.contains(part));
        until(&format!("{component} {parts:?}"), PATIENCE, || {
            let mut remote = connect(&self.server.endpoint());
            let ended = run_once(&mut remote, "p", component, goal);
            println!("{ended:?}");
            last = ended.err();
            last.as_ref().is_some_and(is_it).then_some(())
        });
    }
}

#[test]
fn a_master_that_is_off_is_the_reason_why_nothing_is_published() {
    let port = reserve_port();
    let served = Served::new(
        port,
        "127.0.0.1",
        "drive: {ros1-publish: /cmd_vel, type: std_msgs/String, message: {}},
         pose: {ros1-trajectory: /command, joints: [a], poses: {home: [0]}}",
    );
    let reason = format!("the ROS master http://127.0.0.1:{port} does not answer: ");
    served.is_rejected("drive", "", &[&reason]);
    served.is_rejected("pose", "home", &[&reason]);
}

#[test]
fn a_node_with_another_definition_is_the_reason_why_nothing_is_published() {
    let master = Master::shared();
    let name = unique("typed");
    let _robot = master.robot(&["topics", &name]);
    let served = Served::new(
        master.port,
        "127.0.0.1",
        &format!("set: {{ros1-publish: /{name}/number, type: std_msgs/String, message: {{}}}}"),
    );
    let ours = "is std_msgs/String with MD5 sum 992ce8a1687cec8c8bd883ec73ca41d1";
    let theirs = "not std_msgs/Int32 with da5909fbe378aeaf85e547e830cc1bb7";
    served.is_rejected(
        "set",
        "",
        &[&format!("/{name} has another definition"), ours, theirs],
    );
}

#[test]
fn a_host_name_that_cannot_be_resolved_is_the_reason_why_nothing_is_published() {
    let master = Master::shared();
    let lost = unique("lost");
    let _lost = master.robot_at("no-such-robot.invalid", &["topics", &lost]);
    let set = format!("set: {{ros1-publish: /{lost}/in, type: std_msgs/String, message: {{}}}}");
    let served = Served::new(master.port, "127.0.0.1", &set);
    let subscribes = format!("/{lost} subscribes to /{lost}/in, but cannot be reached: ");
    let parts = [&subscribes, "'no-such-robot.invalid'", "ROS_HOSTNAME"];
    served.is_rejected("set", "", &parts);

    let blind = unique("blind");
    let _blind = master.robot(&["topics", &blind]);
    let set = format!("set: {{ros1-publish: /{blind}/in, type: std_msgs/String, message: {{}}}}");
    let served = Served::new(master.port, "no-such-ztl.invalid", &set);
    let subscribes = format!("/{blind} subscribes to /{blind}/in, but has not connected: ");
    let parts = [&subscribes, "'no-such-ztl.invalid'", "ROS_HOSTNAME"];
    served.is_rejected("set", "", &parts);
}

#[test]
fn only_the_subscriber_that_the_file_names_counts() {
    let robot = Robot::new(
        "scopes: {/test: {p: {
            right: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, message: {}, subscriber: /NAME},
            any: {ros1-publish: /NAME/nobody, type: geometry_msgs/Twist, message: {}},
            other: {ros1-publish: /NAME/nobody, type: geometry_msgs/Twist, message: {}, subscriber: /base},
            pose: {ros1-trajectory: /NAME/command, joint-states: /NAME/joint_states, joints: [elbow], poses: {home: [0]}, subscriber: /base}}}}",
    );
    let (asker, topic) = (Master::shared().node(), format!("/{}/nobody", robot.name));
    assert!(robot.run("right", "").is_ok());
    let node = publisher_of(&asker, &topic);
    let _echo = listen(&asker, &node, &topic, "/rostopic");
    assert!(robot.run("any", "").is_ok());
    // A busy machine may find out less at first.
    let is_rejected = |component: &str, goal: &str, expected: &str| {
        until(expected, PATIENCE, || {
            let reason = robot.run_once(component, goal).expect_err("no base");
            println!("{reason}");
            (reason == expected).then_some(())
        });
    };
    // The master does not know the one that only connects.
    let expected = format!("/base does not subscribe to {topic}, and no other node does");
    is_rejected("other", "", &expected);
    let name = &robot.name;
    let expected = format!("/base does not subscribe to /{name}/command; there are: /{name}");
    is_rejected("pose", "home", &expected);
}

#[test]
fn a_motion_without_joint_states_says_why() {
    let robot = Robot::new(
        "scopes: {/test: {p: {
            pose: {ros1-trajectory: /NAME/command, joint-states: /NAME/joint_stats, joints: [elbow], poses: {home: [0]}}}}}",
    );
    let part = format!(": no node publishes /{}/joint_stats", robot.name);
    until("it says why", PATIENCE, || {
        let reason = robot.run_once("pose", "home").expect_err("no joint states");
        println!("{reason}");
        let is_it = reason.contains("so nothing was moved") && reason.ends_with(&part);
        is_it.then_some(())
    });
}
