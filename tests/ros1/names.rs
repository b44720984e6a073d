//! Host names that the other end cannot resolve.

use crate::rig::{Master, not_sent, test_action, unique};

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
