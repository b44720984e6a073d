//! As many services as a robot has, and the time that a call takes.

use std::time::Instant;

use ztl_naoqi::Value;

use crate::robot::{Connected, Robot};

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

/// Our call may take 1 ms longer than libqi's own.
#[test]
fn a_call_takes_as_long_as_libqis_own() {
    const CALLS: usize = 1000;
    let mut robot = Robot::start(&["ALLeds"]);
    let nao = Connected::to(&robot);
    robot.process.write_line(&format!("time {CALLS}"));
    let theirs = robot.line_with("p50 ");
    let theirs: u128 = theirs
        .trim()
        .trim_start_matches("p50 ")
        .parse()
        .expect("a number");
    let mut times: Vec<u128> = (0..CALLS)
        .map(|_| {
            let start = Instant::now();
            nao.call("ALLeds", "fadeRGB", "[FaceLeds, 255, 0.5]")
                .expect("a result");
            start.elapsed().as_micros()
        })
        .collect();
    times.sort_unstable();
    let ours = times[CALLS / 2];
    println!("p50 of a call: {ours} µs, libqi's own within its process {theirs} µs");
    assert!(ours < theirs + 1000, "{ours} µs, libqi {theirs} µs");
}
