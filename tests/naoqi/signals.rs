//! Subscriptions: kept up while services come and go, and bounded when signals flood.

use std::sync::mpsc::{Receiver, Sender, channel};

use ztl_naoqi::{Event, Limits, Options, SignalOf, SubscriptionHandle};
use ztl_tests::lab::PATIENCE;

use crate::robot::{Connected, Robot, next, nothing, options, wait_for};

/// What arrives: a text for each event.
fn shown(event: &Event) -> String {
    match event {
        Event::Subscribed(_) => "subscribed".to_owned(),
        Event::Unsubscribed { reason, .. } => format!("unsubscribed: {reason}"),
        Event::Signal {
            values: Ok(values), ..
        } => values.to_string(),
        other => format!("{other:?}"),
    }
}

fn subscribe(nao: &Connected, signal: SignalOf) -> (SubscriptionHandle, Receiver<String>) {
    let (sender, events) = channel();
    let each = move |event| drop(sender.send(shown(&event)));
    (nao.client.subscribe(signal, each), events)
}

#[test]
fn touches_arrive_from_the_robots_memory_until_they_are_unsubscribed() {
    let mut robot = Robot::start(&["ALMemory"]);
    let nao = Connected::to(&robot);
    let (touch, touches) = subscribe(&nao, SignalOf::memory("FrontTactilTouched"));
    let (_, words) = subscribe(&nao, SignalOf::memory("WordRecognized"));
    assert_eq!(next(&touches), "subscribed");
    assert_eq!(next(&words), "subscribed");
    robot.tell("raise FrontTactilTouched 1.0");
    assert_eq!(next(&touches), "[1.0]");
    robot.tell("raise WordRecognized ['hello',0.5]");
    assert_eq!(next(&words), "[['hello', 0.5]]");
    nao.client.unsubscribe(touch);
    robot.tell("raise WordRecognized ['bye',0.5]");
    assert_eq!(next(&words), "[['bye', 0.5]]");
    robot.tell("raise FrontTactilTouched 0.0");
    nothing(&touches);
}

#[test]
fn two_subscriptions_to_one_signal_get_each_once() {
    let mut robot = Robot::start(&["ALMemory"]);
    let nao = Connected::to(&robot);
    let signal = || SignalOf::service("ALMemory", "changed");
    let (first, firsts) = subscribe(&nao, signal());
    assert_eq!(next(&firsts), "subscribed");
    let (_, seconds) = subscribe(&nao, signal());
    assert_eq!(next(&seconds), "subscribed");
    robot.tell("flood 1");
    assert_eq!(next(&firsts), "['flood', 0]");
    assert_eq!(next(&seconds), "['flood', 0]");
    nothing(&firsts);
    nao.client.unsubscribe(first);
    robot.tell("flood 1");
    assert_eq!(next(&seconds), "['flood', 0]");
    nothing(&seconds);
}

#[test]
fn a_property_tells_its_changes() {
    let robot = Robot::start(&["ALMotion"]);
    let nao = Connected::to(&robot);
    let (_, changes) = subscribe(&nao, SignalOf::service("ALMotion", "stiffness"));
    assert_eq!(next(&changes), "subscribed");
    nao.call("ALMotion", "setProperty", "[stiffness, 0.5]")
        .expect("it is set");
    assert_eq!(next(&changes), "[0.5]");
}

#[test]
fn signals_arrive_again_when_their_service_comes_back() {
    let mut robot = Robot::start(&[]);
    let nao = Connected::to(&robot);
    let (_, changes) = subscribe(&nao, SignalOf::service("ALMemory", "changed"));
    let (_, missing) = subscribe(&nao, SignalOf::service("ALMemory", "absent"));
    let none = format!("unsubscribed: no service ALMemory at {}", robot.endpoint);
    assert_eq!(next(&changes), none);
    robot.tell("register ALMemory");
    assert_eq!(next(&changes), "subscribed");
    robot.tell("flood 1");
    assert_eq!(next(&changes), "['flood', 0]");
    robot.tell("unregister ALMemory");
    assert_eq!(next(&changes), "unsubscribed: the service was removed");
    robot.tell("register ALMemory");
    assert_eq!(next(&changes), "subscribed");
    robot.tell("flood 1");
    assert_eq!(next(&changes), "['flood', 0]");
    assert_eq!(next(&missing), none);
}

#[test]
fn a_flood_of_signals_is_bounded_and_what_was_dropped_is_counted() {
    const FLOOD: u64 = 20_000;
    let mut robot = Robot::start(&["ALMemory", "ALLeds"]);
    let nao = Connected::with(Options {
        limits: Limits {
            signals: 10,
            ..Limits::default()
        },
        ..options(&robot.endpoint)
    });
    let (sender, events) = channel();
    let (go, wait): (Sender<()>, Receiver<()>) = channel();
    let mut first = true;
    nao.client
        .subscribe(SignalOf::service("ALMemory", "changed"), move |event| {
            // One that is slow, which blocks the client's thread.
            if matches!(event, Event::Signal { .. }) && std::mem::take(&mut first) {
                let _ = wait.recv_timeout(PATIENCE);
            }
            drop(sender.send(event));
        });
    wait_for(&events, |event| matches!(event, Event::Subscribed(_)));
    robot.process.write_line(&format!("flood {FLOOD}"));
    robot.line_with("done flood");
    go.send(()).expect("it waits");
    let (mut arrived, mut lost) = (0, 0);
    while arrived + lost < FLOOD {
        let Event::Signal {
            values, dropped, ..
        } = next(&events)
        else {
            continue;
        };
        values.expect("values");
        arrived += 1;
        lost += dropped;
    }
    assert_eq!(arrived + lost, FLOOD);
    assert!(lost > 0, "nothing was dropped");
    // Calls go on.
    let result = nao.call("ALLeds", "echo", "[1]");
    assert_eq!(result.expect("a result").to_string(), "1");
}
