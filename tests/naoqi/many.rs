//! As many services as a robot has, and the time that a call takes.

use std::time::Instant;

use ztl_naoqi::Value;
use ztl_tests::lab::{PATIENCE, busy, until};

use crate::robot::{Connected, Robot};

const CALLS: usize = 500;

#[test]
fn each_of_200_services_is_listed_and_called() {
    let mut robot = Robot::start(&[]);
    robot.tell("many 200");
    let nao = Connected::to(&robot);
    assert_eq!(nao.client.services().len(), 201);
    for number in 0..200 {
        let name = nao.call(&format!("Service{number:03}"), "name", "[]");
        assert_eq!(name, Ok(Value::Text("other".to_owned())));
    }
}

/// The median of some calls of libqi itself, in its own process, in microseconds.
#[track_caller]
fn theirs(robot: &mut Robot) -> u128 {
    robot.process.write_line(&format!("time {CALLS}"));
    let line = robot.line_with("p50 ");
    let number = line.trim().trim_start_matches("p50 ");
    number.parse().expect("a number")
}

/// The median of ours.
fn ours(nao: &Connected) -> u128 {
    let call = || {
        let start = Instant::now();
        let result = nao.call("ALLeds", "fadeRGB", "[FaceLeds, 255, 0.5]");
        result.expect("a result");
        start.elapsed().as_micros()
    };
    let mut times: Vec<u128> = (0..CALLS).map(|_| call()).collect();
    times.sort_unstable();
    times[CALLS / 2]
}

#[test]
fn a_call_takes_at_most_a_millisecond_longer_than_libqis_own() {
    let _busy = busy();
    let mut robot = Robot::start(&["ALLeds"]);
    let nao = Connected::to(&robot);
    // A busy machine delays some attempts, a defect delays all.
    until("calls are quick", 3 * PATIENCE, || {
        let (theirs, ours) = (theirs(&mut robot), ours(&nao));
        println!("p50 of a call: {ours} µs, of libqi's own: {theirs} µs");
        (ours < theirs + 1000).then_some(())
    });
}
