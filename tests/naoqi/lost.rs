//! Services that vanish and come back, processes that are killed, and a directory that is restarted.

use std::time::Duration;

use ztl_naoqi::{Call, CallError, Event, Value};
use ztl_tests::lab::{PATIENCE, reserve_port};

use crate::robot::{Connected, Robot, next, options};

#[track_caller]
fn unknown(result: Result<Value, CallError>, part: &str) {
    match result {
        Err(CallError::Unknown(reason)) if reason.contains(part) => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_service_that_vanishes_leaves_its_call_unknown_and_comes_back() {
    let mut robot = Robot::start(&["ALTextToSpeech"]);
    let nao = Connected::to(&robot);
    let (_, result) = nao.begin("ALTextToSpeech", "say", "[a long story]");
    robot.line_with("say a long story");
    robot.tell("unregister ALTextToSpeech");
    nao.wait_for(|event| *event == Event::ServiceRemoved("ALTextToSpeech".to_owned()));
    unknown(next(&result), "ALTextToSpeech was removed");
    let gone = nao.call("ALTextToSpeech", "say", "[hello]");
    let absent = format!("no service ALTextToSpeech at {}", robot.endpoint);
    assert_eq!(gone, Err(CallError::NotSent(absent)));
    robot.tell("register ALTextToSpeech");
    nao.wait_for(|event| *event == Event::ServiceAdded("ALTextToSpeech".to_owned()));
    assert_eq!(
        nao.call("ALTextToSpeech", "say", "[hello]"),
        Ok(Value::Nothing)
    );
}

#[test]
fn a_service_in_a_process_of_its_own_is_called_and_its_end_is_noticed() {
    let robot = Robot::start(&["ALMotion"]);
    let mut speech = robot.beside(&["ALTextToSpeech"]);
    let nao = Connected::to(&robot);
    assert_eq!(
        nao.call("ALTextToSpeech", "say", "[hello]"),
        Ok(Value::Nothing)
    );
    let (_, result) = nao.begin("ALTextToSpeech", "say", "[a long story]");
    speech.line_with("say a long story");
    drop(speech);
    unknown(next(&result), "the connection was lost: tcp://127.0.0.1:");
    nao.wait_for(|event| *event == Event::ServiceRemoved("ALTextToSpeech".to_owned()));
    assert_eq!(
        nao.call("ALMotion", "moveTo", "[1, 0, 0]"),
        Ok(Value::Bool(true))
    );
    let _speech = robot.beside(&["ALTextToSpeech"]);
    nao.wait_for(|event| *event == Event::ServiceAdded("ALTextToSpeech".to_owned()));
    assert_eq!(
        nao.call("ALTextToSpeech", "say", "[hello]"),
        Ok(Value::Nothing)
    );
}

#[test]
fn a_directory_that_is_restarted_is_found_again() {
    let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
    let mut robot = Robot::start_at(&endpoint, &["ALTextToSpeech"]);
    let nao = Connected::to(&robot);
    let (_, result) = nao.begin("ALTextToSpeech", "say", "[a long story]");
    robot.line_with("say a long story");
    drop(robot);
    unknown(next(&result), "the connection was lost");
    nao.wait_for(|event| matches!(event, Event::Disconnected { .. }));
    let call = || {
        Call::new(
            "ALTextToSpeech",
            "say",
            vec![Value::Text("hello".to_owned())],
        )
    };
    match nao.client.call_and_wait(call(), Duration::from_millis(50)) {
        Err(CallError::NotSent(reason)) => {
            let expected = format!("not connected to {endpoint}: ");
            assert!(reason.starts_with(&expected), "{reason}");
        }
        other => panic!("{other:?}"),
    }
    // A call that may wait is sent once the robot is there.
    let (_, result) = nao.begin("ALTextToSpeech", "say", "[hello]");
    let _robot = Robot::start_at(&endpoint, &["ALTextToSpeech"]);
    nao.wait_for(|event| *event == Event::Connected);
    let said = next(&result);
    // It was resolved before the service was registered.
    if matches!(said, Err(CallError::NotSent(_))) {
        nao.wait_for(|event| *event == Event::ServiceAdded("ALTextToSpeech".to_owned()));
        assert_eq!(
            nao.client.call_and_wait(call(), PATIENCE),
            Ok(Value::Nothing)
        );
    } else {
        assert_eq!(said, Ok(Value::Nothing));
    }
}

#[test]
fn a_robot_that_is_not_there_is_told_once() {
    let nao = Connected::with(options(&format!("tcp://127.0.0.1:{}", reserve_port())));
    let told = nao.wait_for(|event| matches!(event, Event::Disconnected { .. }));
    let Event::Disconnected { reason } = told else {
        unreachable!("it was one");
    };
    assert!(reason.contains("refused"), "{reason}");
    // Several attempts later.
    let call = Call::new("ALMotion", "wakeUp", Vec::new());
    let result = nao.client.call_and_wait(call, Duration::from_secs(1));
    assert!(matches!(result, Err(CallError::NotSent(_))), "{result:?}");
    assert_eq!(nao.events.try_recv().ok(), None);
}
