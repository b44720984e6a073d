//! Topics, services and parameters of a real node.

use std::io::Read as _;
use std::sync::mpsc::{Receiver, TryRecvError, channel};

use ztl_ros1::xmlrpc::Value;
use ztl_ros1::{CallError, OpenError, Pace, ServiceError};
use ztl_tests::lab::{PATIENCE, process_status};

use crate::rig::{Master, listen, of, string, text, trigger, unique, wait};

/// Waits for a message. rospy may send the last one again to a subscriber that connects.
#[track_caller]
fn arrives(messages: &Receiver<(String, Vec<u8>)>, last: &str, expected: &str) -> String {
    loop {
        let (from, content) = messages.recv_timeout(PATIENCE).expect("a message");
        if content == text(expected) {
            return from;
        }
        assert_eq!(content, text(last));
    }
}

#[test]
fn messages_go_both_ways() {
    let master = Master::shared();
    let name = unique("talker");
    let mut robot = master.robot(&["topics", &name]);
    let node = master.node();
    // Published before anybody receives it.
    let publisher = node
        .publisher(&format!("{name}/in"), string(), true)
        .unwrap();
    publisher.publish(text("first"));
    robot.wait_for("heard first");
    publisher.publish(text("second"));
    robot.wait_for("heard second");
    assert_eq!(publisher.subscribers(), [format!("/{name}")]);
    let (told, heard) = channel();
    let own = node.subscribe(
        &format!("/{name}/in"),
        string(),
        Pace::Irregular,
        move |_, content| {
            let _ = told.send(content.to_vec());
        },
    );
    assert_eq!(heard.recv_timeout(PATIENCE), Ok(text("second")));
    assert_eq!(publisher.subscribers(), [format!("/{name}")]);
    drop(own.unwrap());

    let (told, heard) = channel();
    let topic = format!("/{name}/out");
    let subscription = node.subscribe(&topic, string(), Pace::Irregular, move |from, content| {
        let _ = told.send((from.to_owned(), content.to_vec()));
    });
    let mut last = "";
    for expected in ["one", "two words"] {
        robot.write_line(expected);
        assert_eq!(arrives(&heard, last, expected), format!("/{name}"));
        last = expected;
    }
    drop(subscription.unwrap());
    wait("no more messages", || {
        heard.try_recv() == Err(TryRecvError::Disconnected)
    });
}

#[test]
fn another_type_is_refused_by_both_ends() {
    let master = Master::shared();
    let name = unique("typed");
    let robot = master.robot(&["topics", &name]);
    let node = master.node();
    let topic = format!("/{name}/number");
    let publisher = node.publisher(&topic, string(), false).unwrap();
    let again = node.publisher(&topic, of("std_msgs/Int32", "*"), false);
    assert!(matches!(again, Err(OpenError::Type(_))));
    // It receives what is published with the right type, so it has seen the other topic as well.
    let right = node
        .publisher(&format!("/{name}/in"), string(), true)
        .unwrap();
    right.publish(text("right"));
    robot.wait_for("heard right");
    assert_eq!(publisher.subscribers(), Vec::<String>::new());
}

#[test]
fn services_answer_fail_and_are_missing() {
    let master = Master::shared();
    let name = unique("services");
    let _robot = master.robot(&["topics", &name]);
    let node = master.node();
    let call = |service: &str, ty| {
        let (done, answer) = channel();
        let service = format!("/{name}/{service}");
        node.call(&service, ty, Vec::new(), PATIENCE, move |answer| {
            drop(done.send(answer))
        });
        answer.recv().expect("an answer")
    };
    assert_eq!(
        call("trigger", trigger()),
        Ok([vec![1], text("pulled")].concat())
    );
    match call("broken", trigger()) {
        Err(ServiceError::Failed { reason }) => {
            assert!(reason.contains("it is broken"), "{reason}")
        }
        other => panic!("{other:?}"),
    }
    assert!(matches!(
        call("missing", trigger()),
        Err(ServiceError::NotFound {
            error: CallError::Refused { .. },
            ..
        })
    ));
    let wrong = of("std_srvs/Trigger", "0123456789abcdef0123456789abcdef");
    match call("trigger", wrong) {
        Err(ServiceError::Refused { reason }) => assert!(reason.contains("md5sum"), "{reason}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn parameters_are_read() {
    let master = Master::shared();
    let node = master.node();
    let name = unique("/limits");
    let value = Value::Struct(vec![("speed".to_owned(), Value::Double(0.5))]);
    node.ask_master("setParam", &[name[..].into(), value.clone()])
        .unwrap();
    assert_eq!(node.param(&name), Ok(value));
    assert_eq!(node.param(&format!("{name}/speed")), Ok(Value::Double(0.5)));
    assert!(matches!(
        node.param("/none"),
        Err(CallError::Refused { .. })
    ));
}

#[test]
fn a_slow_subscriber_delays_nobody_and_takes_bounded_memory() {
    let master = Master::shared();
    let name = unique("quick");
    let robot = master.robot(&["topics", &name]);
    let node = master.node();
    let topic = format!("/{name}/in");
    let publisher = node.publisher(&topic, string(), false).unwrap();
    wait("the robot is connected", || {
        publisher.subscribers().len() == 1
    });
    let mut slow = listen(&node, node.name(), &topic, "/slow");
    wait("both are connected", || publisher.subscribers().len() == 2);
    let before = process_status(std::process::id(), "VmRSS:");
    let long = "x".repeat(100_000);
    for number in 0..1000 {
        publisher.publish(text(&format!("{number} {long}")));
        if number % 20 == 19 {
            // In step with the quick subscriber, whose queue is as short.
            robot.wait_for(&format!("heard {number}\n"));
        }
    }
    robot.wait_for("heard 999\n");
    let after = process_status(std::process::id(), "VmRSS:");
    // Two queues of 64 messages, and what other tests take meanwhile.
    assert!(after < before + 60 * 1024, "{before} KiB, then {after} KiB");
    // What it gets are whole messages, the newest among them.
    slow.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut last = 0;
    while last < 999 {
        let mut len = [0; 4];
        slow.read_exact(&mut len).unwrap();
        let mut content = vec![0; u32::from_le_bytes(len) as usize];
        slow.read_exact(&mut content).unwrap();
        let content = String::from_utf8(content.split_off(4)).unwrap();
        let (number, rest) = content.split_once(' ').unwrap();
        let number: i32 = number.parse().unwrap();
        assert!(rest == long && (number > last || number == 0));
        last = number;
    }
}

#[test]
fn a_node_that_floods_keeps_no_other_waiting() {
    let master = Master::shared();
    let [flood, calm] = [unique("flood"), unique("calm")];
    let mut flooding = master.robot(&["topics", &flood]);
    let mut robot = master.robot(&["topics", &calm]);
    let node = master.node();
    let (count, counted) = channel();
    let _flood = node.subscribe(
        &format!("/{flood}/out"),
        string(),
        Pace::Irregular,
        move |_, content| {
            let _ = count.send(content.len());
        },
    );
    let (told, heard) = channel();
    let _calm = node.subscribe(
        &format!("/{calm}/out"),
        string(),
        Pace::Irregular,
        move |from, content| {
            let _ = told.send((from.to_owned(), content.to_vec()));
        },
    );
    flooding.write_line("flood");
    counted.recv_timeout(PATIENCE).expect("the flood");
    let mut last = String::new();
    for number in 0..20 {
        let line = format!("n{number}");
        robot.write_line(&line);
        arrives(&heard, &last, &line);
        last = line;
    }
}

#[test]
fn a_second_subscription_gets_the_latched_message_too() {
    let master = Master::shared();
    let [node, other] = [master.node(), master.node()];
    let topic = unique("/latched");
    let publisher = other.publisher(&topic, string(), true).unwrap();
    publisher.publish(text("kept"));
    let subscribe = || {
        let (told, heard) = channel();
        let on_message = move |_: &str, bytes: &[u8]| drop(told.send(bytes.to_vec()));
        let subscription = node
            .subscribe(&topic, string(), Pace::Irregular, on_message)
            .unwrap();
        (subscription, heard)
    };
    let (_one, first) = subscribe();
    assert_eq!(first.recv_timeout(PATIENCE), Ok(text("kept")));
    let (_other, second) = subscribe();
    assert_eq!(second.recv_timeout(PATIENCE), Ok(text("kept")));
}

#[test]
fn a_silent_connection_is_replaced_where_messages_come_all_the_time() {
    let master = Master::shared();
    let publishing = master.node();
    let topic = unique("/steady");
    let publisher = publishing.publisher(&topic, string(), true).unwrap();
    publisher.publish(text("kept"));
    // A new connection brings the kept message again.
    let subscribe = |pace| {
        let node = master.node();
        let (told, heard) = channel();
        let on_message = move |_: &str, bytes: &[u8]| drop(told.send(bytes.to_vec()));
        let subscription = node.subscribe(&topic, string(), pace, on_message);
        (node, subscription.unwrap(), heard)
    };
    let (_node, _steady, steady) = subscribe(Pace::Steady);
    let (_other, _rare, rare) = subscribe(Pace::Irregular);
    for heard in [&steady, &rare, &steady, &steady] {
        assert_eq!(heard.recv_timeout(PATIENCE), Ok(text("kept")));
    }
    assert_eq!(rare.try_recv(), Err(TryRecvError::Empty));
}
