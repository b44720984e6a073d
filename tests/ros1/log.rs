//! What `ztl serve` says in its log of a robot that is not right.

use ztl_tests::lab::{PATIENCE, Scratch, Server, connect, reserve_port, until, ztl};

use crate::check::define;
use crate::rig::Master;
use crate::serve::run_once;

/// Serves these lines, with a component `p:nowhere`.
#[track_caller]
fn serve(scratch: &Scratch, master: &Master, lines: &str) -> Server {
    let path = scratch.path("robot.yaml");
    let (port, publish) = (master.port, reserve_port());
    let text = format!(
        "publish: {publish}\nros1: {{master: 'http://127.0.0.1:{port}', host: 127.0.0.1}}
scopes: {{/test: {{p: {{
    nowhere: {{ros1-publish: /nowhere, type: std_msgs/String, message: {{}}}},
    drive: {{ros1-publish: /drive, type: std_msgs/String, message: {{}}}},
    count: {{ros1-action: /count, type: actionlib/TestAction}}}}}}}}\n{lines}"
    );
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    command.env("ROS_PACKAGE_PATH", scratch.path("packages"));
    command.arg("serve").arg(&path).args(["-p", "0"]);
    Server::start(&mut command)
}

/// Two tasks to a topic that nobody receives take three seconds.
#[track_caller]
fn let_time_pass(server: &Server) {
    for _ in 0..2 {
        let mut remote = connect(&server.endpoint());
        run_once(&mut remote, "p", "nowhere", "").expect_err("nobody receives it");
    }
}

/// Waits for a line, and asserts later that it came once.
#[track_caller]
fn says_once(server: &Server, line: &str) {
    let count = || server.process.stderr().matches(line).count();
    until(line, PATIENCE, || (count() > 0).then_some(()));
    let_time_pass(server);
    assert_eq!(count(), 1, "{}", server.process.stderr());
}

#[test]
fn a_master_that_is_off_and_on_again_is_told_once_each() {
    let mut master = Master::start();
    let scratch = Scratch::new();
    let joints = "streams: {/test: {joints: {ros1-topic: /joints, type: sensor_msgs/JointState}}}";
    let server = serve(&scratch, &master, joints);
    master.kill();
    let uri = format!("the ROS master http://127.0.0.1:{}", master.port);
    says_once(&server, &format!("{uri} does not answer: "));
    master.restart();
    says_once(&server, &format!("{uri} answers again"));
    let told = server.process.stderr().matches(&uri).count();
    assert_eq!(told, 2, "{}", server.process.stderr());
}

#[test]
fn a_stream_whose_topic_has_another_definition_is_told_once() {
    let master = Master::start();
    let _robot = master.robot(&["topics", "talker"]);
    let scratch = Scratch::new();
    define(&scratch, "std_msgs/msg/Char.msg", "char data\n");
    let out = "streams: {/test: {out: {ros1-topic: /talker/out, type: std_msgs/Char}}}";
    let server = serve(&scratch, &master, out);
    says_once(&server, "/talker/out is not received from http://");
    let log = server.process.stderr();
    assert!(log.contains("std_msgs/Char"), "{log}");
}
