//! Calls that are cancelled by their futures, and those that ignore that.

use std::sync::mpsc::channel;

use ztl_naoqi::{CallError, CallHandle, Cancel, Value};
use ztl_tests::lab::{PATIENCE, reserve_port};

use crate::robot::{Connected, Robot, next, nothing};

fn cancel(nao: &Connected, call: CallHandle) -> Cancel {
    let (sender, told) = channel();
    nao.client.cancel(call, move |cancel| {
        let _ = sender.send(cancel);
    });
    told.recv_timeout(PATIENCE).expect("an answer")
}

#[test]
fn an_animation_is_cancelled_by_its_future() {
    let mut robot = Robot::start(&["ALAnimationPlayer"]);
    let nao = Connected::to(&robot);
    let over = nao.call("ALAnimationPlayer", "run", "[short]");
    assert_eq!(over, Ok(Value::Text("over".to_owned())));
    let (call, result) = nao.begin("ALAnimationPlayer", "run", "[animations/Hey_1]");
    robot.line_with("run animations/Hey_1");
    nothing(&result);
    assert_eq!(cancel(&nao, call), Cancel::Asked);
    assert_eq!(next(&result), Err(CallError::Canceled));
    robot.line_with("cancelled");
    assert_eq!(cancel(&nao, call), Cancel::Ended);
}

#[test]
fn a_call_that_ignores_its_cancellation_ends_as_it_does() {
    let mut robot = Robot::start(&["ALTextToSpeech"]);
    let nao = Connected::to(&robot);
    let (call, result) = nao.begin("ALTextToSpeech", "say", "[a long story]");
    robot.line_with("say a long story");
    assert_eq!(cancel(&nao, call), Cancel::Asked);
    nothing(&result);
    assert_eq!(
        nao.call("ALTextToSpeech", "stopAll", "[]"),
        Ok(Value::Nothing)
    );
    assert_eq!(next(&result), Ok(Value::Nothing));
}

#[test]
fn a_call_that_waits_for_its_robot_is_cancelled_at_once() {
    let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
    let nao = Connected::with(crate::robot::options(&endpoint));
    let (call, result) = nao.begin("ALTextToSpeech", "say", "[hello]");
    assert_eq!(cancel(&nao, call), Cancel::Ended);
    assert_eq!(next(&result), Err(CallError::Canceled));
}
