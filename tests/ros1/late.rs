//! Commands that would arrive late, after the network or the subscriber was away, and goals of a server that was killed.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::channel;
use std::time::Duration;

use ztl_ros1::EndState;
use ztl_ros1::xmlrpc::Value;
use ztl_std::State::{Accepted, Completed, Failed};
use ztl_tests::lab::{PATIENCE, end, start, until};

use crate::rig::{
    Master, Running, connected, listen, publisher_of, string, text, trigger, unique, wait,
};
use crate::serve::Robot;

/// Has a message wait for a subscriber that reads nothing.
fn behind(publisher: &ztl_ros1::Publisher) {
    publisher.publish(text(&"x".repeat(16 << 20)));
    let is_behind = || publisher.audience().nodes.iter().any(|node| !node.has_all);
    wait("the message waits", is_behind);
}

/// Reads until the other end has discarded the connection, and returns how many bytes came before.
#[track_caller]
fn received_until_reset(mut stream: TcpStream) -> usize {
    let mut received = Vec::new();
    let quiet = Some(Duration::from_secs(2));
    stream.set_read_timeout(quiet).unwrap();
    let mut error = stream.read_to_end(&mut received).unwrap_err();
    // The system of a subscriber without room may drop the reset. It gets another one when it sends something.
    if error.kind() == ErrorKind::WouldBlock {
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let sent = stream.write_all(&[0]);
        let read = sent.and_then(|()| stream.read_to_end(&mut received));
        error = read.unwrap_err();
    }
    assert_eq!(error.kind(), ErrorKind::ConnectionReset);
    received.len()
}

#[test]
fn a_late_command_is_discarded_with_the_connection_and_the_node_connects_again() {
    let master = Master::shared();
    let topic = unique("/commands");
    let node = master.node();
    let limit = Duration::from_millis(300);
    let publisher = node.command_publisher(&topic, string(), limit, true);
    let publisher = publisher.unwrap();
    let slow = listen(&node, node.name(), &topic, "/slow");
    behind(&publisher);
    // These are replaced by the newest, and come too late.
    (0..10).for_each(|number| publisher.publish(text(&format!("late {number}"))));
    wait("it is disconnected", || publisher.subscribers().is_empty());
    let lost = publisher.audience().lost;
    assert_eq!(lost.len(), 1);
    assert_eq!(lost[0].node, "/slow");
    assert!(lost[0].reason.contains("has not acknowledged"), "{lost:?}");
    let received = received_until_reset(slow);
    assert!(received < 16 << 20, "{received} bytes");

    let (told, reason) = channel();
    publisher.explain(Some("/slow"), move |text| drop(told.send(text)));
    let reason = reason.recv_timeout(PATIENCE).unwrap();
    assert!(reason.starts_with("/slow was disconnected: "), "{reason}");
    // It only connects: no master could tell it that this topic is there.
    let part = "The ROS master no longer knows that it subscribes: start /slow again";
    assert!(reason.contains(part), "{reason}");
    let _again = listen(&node, node.name(), &topic, "/slow");
    let all = || publisher.audience().nodes.iter().all(|node| node.has_all);
    wait("it has all", || publisher.subscribers().len() == 1 && all());
}

#[test]
fn a_node_that_is_disconnected_has_never_acknowledged_all() {
    let master = Master::shared();
    let node = master.node();
    for _ in 0..10 {
        let topic = unique("/commands");
        let limit = Duration::from_millis(100);
        let publisher = node.command_publisher(&topic, string(), limit, true);
        let publisher = publisher.unwrap();
        let _slow = listen(&node, node.name(), &topic, "/slow");
        behind(&publisher);
        // The system or the node closes the connection, whichever looks first.
        let lost = until("it is lost", PATIENCE * 2, || {
            let audience = publisher.audience();
            assert!(audience.nodes.iter().all(|node| !node.has_all));
            audience.nodes.is_empty().then_some(audience.lost)
        });
        assert_eq!(lost.len(), 1);
    }
}

/// A frame of TCPROS.
fn frame(content: &[u8]) -> Vec<u8> {
    let len = u32::try_from(content.len()).unwrap().to_le_bytes();
    [&len, content].concat()
}

#[test]
fn a_request_that_waits_when_its_process_ends_is_discarded() {
    let master = Master::shared();
    let node = master.node();
    let service = unique("/slow");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let uri = format!("rosrpc://{}", listener.local_addr().unwrap());
    let asker = master.node();
    let params = [&service[..], &uri, "http://127.0.0.1:1/"].map(Value::from);
    asker.ask_master("registerService", &params).unwrap();
    let request = text(&"x".repeat(16 << 20));
    node.call(&service, trigger(), request, PATIENCE, |_| {});
    let (mut stream, _) = listener.accept().unwrap();
    // It answers the header, and takes the length of the request.
    let mut header = [0; 4];
    stream.read_exact(&mut header).unwrap();
    let mut rest = vec![0; u32::from_le_bytes(header) as usize];
    stream.read_exact(&mut rest).unwrap();
    let answer = frame(&text(&format!("md5sum={}", trigger().md5)));
    stream.write_all(&answer).unwrap();
    stream.read_exact(&mut header).unwrap();
    node.stop();
    let received = received_until_reset(stream);
    assert!(received < 16 << 20, "{received} bytes");
}

#[test]
fn a_node_that_hung_is_disconnected_and_connects_again_when_it_goes_on() {
    let master = Master::shared();
    let name = unique("hung");
    let robot = master.robot(&["topics", &name]);
    let node = master.node();
    let limit = Duration::from_millis(300);
    let publisher = node.command_publisher(&format!("/{name}/in"), string(), limit, true);
    let publisher = publisher.unwrap();
    wait("it is connected", || publisher.subscribers().len() == 1);
    robot.signal("STOP");
    behind(&publisher);
    wait("it is disconnected", || publisher.subscribers().is_empty());
    robot.signal("CONT");
    wait("it is connected again", || {
        publisher.subscribers().len() == 1
    });
    publisher.publish(text("again"));
    robot.wait_for("heard again");
}

#[test]
fn a_node_that_stops_discards_what_waits() {
    let master = Master::shared();
    let topic = unique("/commands");
    let limit = Duration::from_secs(3600);
    let node = master.node();
    let publisher = node.command_publisher(&topic, string(), limit, true);
    let publisher = publisher.unwrap();
    let slow = listen(&node, node.name(), &topic, "/slow");
    behind(&publisher);
    node.stop();
    let received = received_until_reset(slow);
    assert!(received < 16 << 20, "{received} bytes");
}

/// One of 200 Hz fills the little room of a subscriber that reads nothing.
const FAST: &str = "scopes: {/test: {p: {
    drive: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, rate: 200 Hz, for: '{goal.seconds}',
            message: {linear: {x: '{goal.speed}'}}, stop: {}},
    bound: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, subscriber: /NAME, rate: 200 Hz, for: 1 s, dead-man: 20 s, message: {linear: {x: 0.5}}},
    absent: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, subscriber: /absent}}}}";

#[test]
fn a_task_whose_subscriber_takes_nothing_more_is_unknown_and_nothing_of_it_arrives_late() {
    let robot = Robot::new(FAST);
    let asker = Master::shared().node();
    let topic = format!("/{}/cmd_vel", robot.name);
    let node = publisher_of(&asker, &topic);
    assert!(robot.run("drive", "{speed: 0.5, seconds: 0.1}").is_ok());
    let mut remote = robot.remote();
    // A busy machine may pause for longer than the dead-man time.
    let (slow, text) = until("a drive without a pause", PATIENCE, || {
        let slow = listen(&asker, &node, &topic, "/slow");
        let task = start(&mut remote, "p", "drive", "{speed: 0.5, seconds: 60}");
        let (state, text) = end(&mut remote, task);
        assert_eq!(state, Failed);
        (!text.contains("longer than dead-man")).then_some((slow, text))
    });
    assert!(
        text.starts_with("unknown: /slow was disconnected: "),
        "{text}"
    );
    let late = received_until_reset(slow);
    // What its machine had taken: the messages of less than half a second.
    assert!(late < 60 * 52, "{late} bytes");

    // When it is back, it is stopped first, also if a task that it did not hear has begun and ended meanwhile.
    assert!(robot.run("drive", "{speed: 0.5, seconds: 0.1}").is_ok());
    let mut back = listen(&asker, &node, &topic, "/slow");
    let mut twist = [0; 52];
    back.set_read_timeout(Some(PATIENCE)).unwrap();
    back.read_exact(&mut twist).unwrap();
    assert_eq!(twist, *frame(&[0; 48]));
    drop(back);

    // The file names the node that counts, so another one stops nothing.
    let _slow = listen(&asker, &node, &topic, "/slow");
    assert_eq!(robot.run("bound", ""), Ok((Completed, "True".to_owned())));
}

/// Resets the connection, as a firewall or a machine that restarts does.
fn reset(stream: TcpStream) {
    rustix::net::sockopt::set_socket_linger(&stream, Some(Duration::ZERO)).unwrap();
    drop(stream);
}

#[test]
fn a_node_whose_connection_is_reset_during_a_task_makes_its_outcome_unknown_and_is_stopped_first() {
    let robot = Robot::new(
        "scopes: {/test: {p: {
            drive: {ros1-publish: /NAME/cmd_vel, type: geometry_msgs/Twist, for: 60 s, dead-man: 20 s, message: {linear: {x: 0.5}}, stop: {}},
            pose: {ros1-trajectory: /NAME/command, joint-states: /NAME/joint_states, joints: [elbow], poses: {far: [200]}}}}}",
    );
    let asker = Master::shared().node();
    let mut remote = robot.remote();
    // An empty trajectory has a header and two lists.
    for (component, goal, topic, begun, stop) in [
        ("drive", "", "cmd_vel", "twist 0.5", vec![0; 48]),
        ("pose", "far", "command", "trajectory", vec![0; 24]),
    ] {
        let topic = format!("/{}/{topic}", robot.name);
        let node = publisher_of(&asker, &topic);
        let task = until("the robot is connected", PATIENCE, || {
            let started = remote.trigger("p", component, goal).ok()?;
            started.id.number()
        });
        robot.node.wait_for(begun);
        let slow = listen(&asker, &node, &topic, "/slow");
        reset(slow);
        let (state, text) = end(&mut remote, task);
        assert_eq!(state, Failed);
        let part = "unknown: /slow was disconnected: the connection of 127.0.0.1:";
        assert!(text.starts_with(part), "{text}");
        let mut back = listen(&asker, &node, &topic, "/slow");
        let mut first = vec![0xff; stop.len() + 4];
        back.set_read_timeout(Some(PATIENCE)).unwrap();
        back.read_exact(&mut first).unwrap();
        assert_eq!(first, frame(&stop));
    }
}

/// How many bytes for this end of a connection wait in the system, at the other end. A closed connection has none.
fn waits_for(stream: &TcpStream) -> usize {
    let port = |address: SocketAddr| format!(":{:04X}", address.port());
    let Ok(there) = stream.peer_addr().map(port) else {
        return 0;
    };
    let here = port(stream.local_addr().unwrap());
    let tables = ["/proc/net/tcp", "/proc/net/tcp6"].map(std::fs::read_to_string);
    let lines = tables.iter().flatten().flat_map(|table| table.lines());
    // number, local and remote address, state, bytes to send:bytes to read
    let fields = |line: &str| {
        let mut fields = line.split_whitespace().skip(1);
        let addresses = (fields.next()?, fields.next()?);
        let wanted = addresses.0.ends_with(&there) && addresses.1.ends_with(&here);
        let queues = fields.nth(1).filter(|_| wanted)?;
        usize::from_str_radix(queues.split(':').next()?, 16).ok()
    };
    lines.filter_map(fields).next().unwrap_or(0)
}

#[test]
fn a_killed_server_leaves_no_late_command() {
    let robot = Robot::new(&FAST.replacen("200 Hz", "200 Hz, dead-man: 2 s", 1));
    let asker = Master::shared().node();
    let topic = format!("/{}/cmd_vel", robot.name);
    let node = publisher_of(&asker, &topic);
    assert!(robot.run("drive", "{speed: 0.5, seconds: 0.1}").is_ok());
    let mut remote = robot.remote();
    let slow = until("messages wait for one that does not read", PATIENCE, || {
        let slow = listen(&asker, &node, &topic, "/slow");
        let id = start(&mut remote, "p", "drive", "{speed: 0.5, seconds: 60}");
        // On a busy machine, the slow one may be disconnected before.
        while remote
            .status(id)
            .is_ok_and(|status| status.state == Accepted)
        {
            if waits_for(&slow) > 10 * 52 {
                return Some(slow);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        None
    });
    robot.server.process.signal("KILL");
    robot.server.process.end(PATIENCE);
    let late = received_until_reset(slow);
    assert!(late < 100 * 52, "{late} bytes");
}

#[test]
fn a_cancel_that_is_acknowledged_late_is_not_discarded() {
    let master = Master::shared();
    // Goals have long names then, and one cancel is more than the slow node has room for.
    let name = unique(&"x".repeat(16_000));
    let _server = master.action("late", &name);
    let node = master.node();
    let action = connected(&node, &name);
    let mut slow = listen(&node, node.name(), &format!("/{name}/cancel"), "/slow");
    let running = Running::send(&action, 4);
    running.accepted();
    running.goal.cancel();
    running.ends(EndState::Preempted, "stopped", Some(-1));
    // Longer than a goal may wait.
    std::thread::sleep(Duration::from_secs(3));
    slow.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut length = [0; 4];
    slow.read_exact(&mut length).unwrap();
    let mut cancel = vec![0; u32::from_le_bytes(length) as usize];
    slow.read_exact(&mut cancel).unwrap();
    assert!(cancel.len() > 16_000);
}

#[test]
fn a_cancel_that_waits_does_not_wait_when_its_server_can_be_reached() {
    let master = Master::shared();
    // Goals have long names then, and one cancel is more than the slow connection has room for.
    let server_name = unique("cut");
    let name = unique(&"x".repeat(16_000));
    let mut server = master.action(&server_name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    // A connection that the server knows nothing of, as after a cut.
    let slow = listen(
        &node,
        node.name(),
        &format!("/{name}/cancel"),
        &format!("/{server_name}"),
    );
    let running = Running::send(&action, 8);
    running.accepted();
    running.goal.cancel();
    let reset = until("the connection is closed", PATIENCE, || {
        // Nothing is read, so that nothing more is acknowledged.
        rustix::net::sockopt::socket_error(&slow).unwrap().err()
    });
    assert_eq!(reset, rustix::io::Errno::CONNRESET);
    let _back = listen(
        &node,
        node.name(),
        &format!("/{name}/cancel"),
        &format!("/{server_name}"),
    );
    server.write_line("finish");
    running.ends(EndState::Succeeded, "told", Some(7));
}

#[test]
fn a_goal_that_a_killed_server_has_left_is_cancelled_by_another_one() {
    let name = unique("left");
    let action = Master::shared().action(&name, &name);
    let text = format!(
        "scopes: {{/test: {{p: {{count: {{ros1-action: /{name}, type: actionlib/TestAction}}}}}}}}"
    );
    let first = Robot::new(&text);
    let other = Robot::new(&text);
    assert!(first.run("count", "1").is_ok());
    assert!(other.run("count", "1").is_ok());
    let mut remote = other.remote();
    let held = start(&mut remote, "p", "count", "4");
    start(&mut first.remote(), "p", "count", "4");
    until("both goals are there", PATIENCE, || {
        (action.stdout().matches("goal 4").count() == 2).then_some(())
    });
    first.server.process.signal("KILL");
    first.server.process.end(PATIENCE);
    let next = Robot::new(&text);
    let said = format!("cancels a goal of /{name}: /ztl_");
    until("the goal is cancelled", PATIENCE, || {
        let told = [&other, &next].map(|robot| robot.server.process.stderr().contains(&said));
        (told.contains(&true) && action.stdout().contains("cancel /ztl_")).then_some(())
    });
    // That of a server that lives goes on.
    let mut action = action;
    action.write_line("finish");
    let end = remote.wait(held, Some(PATIENCE)).expect("an end");
    assert_eq!(
        (end.state, end.text),
        (Completed, "{'result': 7}".to_owned())
    );
}
