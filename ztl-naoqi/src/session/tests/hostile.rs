//! Robots that try to take memory.

use super::*;

/// A text of this length, as it is sent.
fn text(length: usize) -> Vec<u8> {
    let count = u32::try_from(length).expect("a length");
    [&count.to_le_bytes()[..], &vec![b'i'; length]].concat()
}

#[test]
fn long_names_of_services_are_not_kept() {
    let mut robot = Robot::ready();
    let added = Address {
        service: 1,
        object: 1,
        action: 106,
    };
    for number in 0..8_u32 {
        let name = [&number.to_le_bytes()[..], &text(257)].concat();
        robot.send(Kind::Event, number, added, name);
    }
    let mut kept = robot.session.services();
    assert!(kept.all(|name| name.len() < 257));
    drop(kept);
    robot.send(
        Kind::Event,
        9,
        added,
        [&[9, 0, 0, 0][..], &text(256)].concat(),
    );
    assert!(robot.session.services().any(|name| name.len() == 256));
}

#[test]
fn a_description_with_a_huge_signature_is_unreadable() {
    for length in [1, 9000] {
        let mut robot = Robot::ready();
        let call = robot.say();
        robot.resolve("[ALTextToSpeech, 2, nao, 100, ['tcp://127.0.0.1:9559'], '1']");
        // One method: its numbers, what it returns, its name and its parameters, of which there are none; and what follows.
        let number = |number: u32| number.to_le_bytes().to_vec();
        let say = [&3_u32.to_le_bytes()[..], b"say"].concat();
        let none = [&2_u32.to_le_bytes()[..], b"()"].concat();
        let method = [number(100), number(100), text(length), say, none].concat();
        let rest = [number(0), number(0), number(0)].concat();
        let meta = [number(1), method, rest, vec![0; 12]].concat();
        robot.answer(2, Kind::Reply, meta);
        let error = robot.ended(call).expect_err("a wrong argument");
        let readable = matches!(error, CallError::Arguments(_));
        assert_eq!(readable, length == 1, "{error}");
    }
}

#[test]
fn what_is_never_answered_is_bounded() {
    let mut robot = Robot::ready();
    let first = robot
        .session
        .subscribe(SignalOf::service("ALTextToSpeech", "level"));
    robot.resolve_speech();
    robot.session.unsubscribe(first);
    let call = robot.say();
    for _ in 0..10_000 {
        let level = SignalOf::service("ALTextToSpeech", "level");
        let subscription = robot.session.subscribe(level);
        robot.session.unsubscribe(subscription);
        while robot.hear_more().is_some() {}
    }
    let waiting: usize = robot
        .session
        .links
        .values()
        .map(|link| link.pending.len())
        .sum();
    assert!(waiting <= 8192, "{waiting} answers are awaited");
    assert!(waiting > 1024, "{waiting} answers are awaited");
    assert_eq!(robot.session.cancel(call), Cancel::Asked);
}

#[test]
fn a_token_that_is_not_one_line_is_not_taken() {
    for token in ["x".repeat(1025), "a\nb".to_owned(), " x".to_owned()] {
        let mut robot = Robot::new(nao());
        let key = |key: &str| {
            let length = u32::try_from(key.len()).expect("a length");
            [&length.to_le_bytes()[..], key.as_bytes()].concat()
        };
        let state = [key("__qi_auth_state"), key("I"), vec![2, 0, 0, 0]].concat();
        let new = [key("auth_newToken"), key("s"), key(&token)].concat();
        let answer = [vec![2, 0, 0, 0], state, new].concat();
        robot.answer(8, Kind::Reply, answer);
        let reason = robot.disconnected();
        assert!(
            reason.ends_with("the robot asks for more than user and token"),
            "{reason}"
        );
    }
}

#[test]
fn a_robot_that_refuses_a_subscription_again_and_again_is_told_once() {
    let mut robot = Robot::ready();
    let level = SignalOf::service("ALTextToSpeech", "level");
    robot.session.subscribe(level);
    let mut told = 0;
    for _ in 0..10 {
        robot.resolve_speech();
        let refusal = [text(0), vec![0; 4]].concat();
        robot.answer(0, Kind::Error, refusal);
        // It is unregistered nevertheless.
        assert_eq!(robot.hear().address.action, 1);
        let about = |action| Address {
            service: 1,
            object: 1,
            action,
        };
        for action in [107, 106] {
            let speech = bytes("[2, ALTextToSpeech]", "(Is)");
            robot.send(Kind::Event, 0, about(action), speech);
        }
        while let Some(event) = robot.session.poll_event() {
            told += usize::from(matches!(event, Event::Unsubscribed { .. }));
        }
    }
    assert_eq!(told, 1);
}
