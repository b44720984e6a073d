//! Host names that the other end cannot resolve.

use std::net::TcpListener;
use std::time::Duration;

use crate::rig::{Master, not_sent, test_action, unique, within};

#[test]
fn a_robot_whose_host_name_is_unknown_here_is_told_to_set_ros_hostname() {
    let master = Master::shared();
    let name = unique("lost");
    let _robot = master.robot_at("no-such-robot.invalid", &["action", &name, &name]);
    let node = master.node();
    let action = node.action(&name, test_action()).unwrap();
    not_sent(&action, &["'no-such-robot.invalid'", "ROS_HOSTNAME"]);
    let survey = node.survey().unwrap();
    let (_, wrong) = &survey.nodes[&format!("/{name}")];
    assert!(
        wrong.as_ref().unwrap().contains("'no-such-robot.invalid'"),
        "{wrong:?}"
    );
    assert_eq!(survey.actions[&format!("/{name}")], "actionlib/TestAction");
}

#[test]
fn a_robot_that_cannot_resolve_our_host_name_is_named_with_it() {
    let master = Master::shared();
    let name = unique("blind");
    let _robot = master.action(&name, &name);
    let node = master.node_as("ztl", "no-such-ztl.invalid");
    let action = node.action(&name, test_action()).unwrap();
    not_sent(&action, &[&name, "'no-such-ztl.invalid'", "ROS_HOSTNAME"]);
}

#[test]
fn nodes_that_do_not_answer_are_waited_for_at_once() {
    let master = Master::start();
    let node = master.node();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let silent = format!("http://{}/", listener.local_addr().unwrap());
    let script = format!(
        "import xmlrpc.client as x; master = x.ServerProxy('http://127.0.0.1:{}')\n\
         for n in range(4): master.registerPublisher(f'/dead{{n}}', '/x', 'std_msgs/String', '{silent}')",
        master.port
    );
    let done = master.debian_python().args(["-c", &script]).status();
    assert!(done.unwrap().success());
    // Each is waited for 5 s.
    let survey = within(Duration::from_secs(15), || node.survey().unwrap());
    for number in 0..4 {
        let (_, wrong) = &survey.nodes[&format!("/dead{number}")];
        assert!(
            wrong.as_ref().unwrap().starts_with("no answer from "),
            "{wrong:?}"
        );
    }
}
