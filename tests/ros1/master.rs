//! A master that is killed, restarted or stopped, and the simulated clock.

use ztl_ros1::xmlrpc::Value;
use ztl_ros1::{EndState, Node, Pace};

use crate::rig::{
    Master, Running, connected, not_sent, string, test_action, text, unique, wait, wait_for_server,
};

/// How many times the master names the node as a publisher or subscriber of a topic.
fn registered(asker: &Node, topic: &str, node: &str) -> usize {
    let state = asker.ask_master("getSystemState", &[]);
    let state = state.unwrap_or(Value::Nil);
    let parts = state.as_array().unwrap_or_default().iter();
    let rows = parts.flat_map(|part| part.as_array().unwrap_or_default());
    let of_topic = rows.filter_map(|row| match row.as_array()? {
        [name, nodes] if name.as_str() == Some(topic) => nodes.as_array(),
        _ => None,
    });
    of_topic
        .flatten()
        .filter(|name| name.as_str() == Some(node))
        .count()
}

#[test]
fn a_master_that_was_killed_and_restarted_gets_everything_again() {
    let mut master = Master::start();
    let node = master.node();
    let publisher = node.publisher("/robot/in", string(), true).unwrap();
    publisher.publish(text("kept"));
    let _subscription = node.subscribe("/robot/out", string(), Pace::Irregular, |_, _| {});
    let mut robot = master.action("arm", "/arm");
    let action = connected(&node, "/arm");
    let running = Running::send(&action, 4);
    running.accepted();

    master.kill();
    node.param("/x").unwrap_err();
    master.restart();
    // The goal runs on, although the new master does not know its server.
    for topic in ["/robot/in", "/robot/out", "/arm/goal", "/arm/status"] {
        wait(topic, || registered(&node, topic, node.name()) == 1);
    }
    robot.write_line("finish");
    running.ends(EndState::Succeeded, "told", Some(7));
    Running::send(&action, 1).ends(EndState::Succeeded, "done", Some(10));
    // A new node finds it.
    let robot = master.robot(&["topics", "robot"]);
    robot.wait_for("heard kept");
}

#[test]
fn a_master_that_hangs_stops_no_goal() {
    let master = Master::start();
    let node = master.node();
    let _robot = master.action("arm", "/arm");
    let action = connected(&node, "/arm");
    master.signal("STOP");
    let error = node.param("/x").unwrap_err().to_string();
    assert!(error.starts_with("no answer from "), "{error}");
    Running::send(&action, 1).ends(EndState::Succeeded, "done", Some(10));
    master.signal("CONT");
    wait("it is registered", || {
        registered(&node, "/arm/goal", node.name()) == 1
    });
}

#[test]
fn a_node_may_start_before_its_master() {
    let mut master = Master::start();
    master.kill();
    let node = master.node();
    let action = node.action("/arm", test_action()).unwrap();
    let told = format!(
        "the ROS master http://127.0.0.1:{} does not answer: ",
        master.port
    );
    let text = not_sent(&action, &[&told]);
    assert!(text.starts_with(&told), "{text}");
    master.restart();
    let _robot = master.action("arm", "/arm");
    wait_for_server(&action);
}

#[test]
fn a_node_that_stops_unregisters() {
    let master = Master::shared();
    let [watcher, node] = [master.node(), master.node()];
    let topic = unique("/left");
    let name = node.name().to_owned();
    let publisher = node.publisher(&topic, string(), false).unwrap();
    let subscription = node
        .subscribe(&topic, string(), Pace::Irregular, |_, _| {})
        .unwrap();
    wait("both are registered", || {
        registered(&watcher, &topic, &name) == 2
    });
    drop(subscription);
    wait("one is registered", || {
        registered(&watcher, &topic, &name) == 1
    });
    node.stop();
    let state = format!("{:?}", watcher.ask_master("getSystemState", &[]).unwrap());
    assert!(!state.contains(&name), "{state}");
    publisher.publish(text("late"));
    assert!(node.action("/arm", test_action()).is_err());
}

#[test]
fn goals_have_the_simulated_time_and_limits_have_not() {
    let master = Master::start();
    let node = master.node();
    node.ask_master("setParam", &["/use_sim_time".into(), Value::Bool(true)])
        .unwrap();
    let node = master.node();
    let mut robot = master.robot(&["topics", "clock"]);
    let _server = master.action("arm", "/arm");
    let action = connected(&node, "/arm");
    let script = "import rospy, sys; from actionlib.msg import TestActionGoal\n\
        rospy.init_node('spy', disable_signals=True, disable_rosout=True)\n\
        rospy.Subscriber('/arm/goal', TestActionGoal, \
        lambda goal: print('stamp', goal.goal_id.stamp.secs, flush=True))\n\
        print('ready', flush=True)\nsys.stdin.read()";
    let spy = ztl_tests::lab::Process::start(master.debian_python().args(["-c", script]));
    spy.wait_for("ready");
    for time in [5000, 40] {
        robot.write_line(&format!("clock {time}"));
        wait("a goal has the time of the clock", || {
            Running::send(&action, 2).ends(EndState::Aborted, "broken", Some(20));
            spy.stdout().contains(&format!("stamp {time}\n"))
        });
    }
}
