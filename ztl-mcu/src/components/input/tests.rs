use super::*;
use crate::components::testing::{self, Pin, Wire};
use std::string::String;

/// A released button; it pulls its wire down.
fn released() -> Wire {
    let wire = Wire::default();
    wire.set(true);
    wire
}

fn button(wire: &Wire) -> DigitalInput<Pin<'_>> {
    DigitalInput::new("button", Pin(wire), DigitalInputConfig::DEFAULT)
}

fn reading(button: &mut DigitalInput<Pin<'_>>, ms: u64) -> Option<String> {
    let mut buffer = [0xA5; 8];
    let reading = button.poll_reading(Instant::from_millis(ms), &mut buffer)?;
    assert_eq!(reading.topic, 0);
    Some(std::str::from_utf8(&buffer[..reading.len]).unwrap().into())
}

fn poll(button: &mut DigitalInput<Pin<'_>>, ms: u64) -> (Run, String) {
    testing::poll(button, Instant::from_millis(ms))
}

#[test]
fn changes_are_published_after_debouncing() {
    let wire = released();
    let mut button = button(&wire);
    assert_eq!(
        button.poll_reading(Instant::ZERO, &mut [0; 3]),
        None,
        "no room"
    );
    assert_eq!(reading(&mut button, 0).as_deref(), Some("False"));
    assert_eq!(reading(&mut button, 1), None);
    wire.set(false);
    assert_eq!(reading(&mut button, 10), None);
    // It bounces, which restarts the wait.
    wire.set(true);
    assert_eq!(reading(&mut button, 15), None);
    wire.set(false);
    assert_eq!(reading(&mut button, 16), None);
    assert_eq!(reading(&mut button, 35), None);
    assert_eq!(reading(&mut button, 36).as_deref(), Some("True"));
    assert_eq!(button.is_pressed(), Some(true));
    wire.broken.set(true);
    assert_eq!(reading(&mut button, 99), None);
}

#[test]
fn a_task_waits_for_its_input_state() {
    let wire = released();
    let mut button = button(&wire);
    let start = |button: &mut DigitalInput<Pin<'_>>, goal: &str| {
        testing::start(button, Instant::ZERO, goal)
    };
    start(&mut button, "pressed").unwrap();
    assert_eq!(poll(&mut button, 0), (Run::Running, "released".into()));
    wire.set(false);
    assert_eq!(poll(&mut button, 10), (Run::Running, "released".into()));
    assert_eq!(poll(&mut button, 30), (Run::Completed, "pressed".into()));

    start(&mut button, "released").unwrap();
    button.abort(Instant::ZERO);
    assert_eq!(poll(&mut button, 31), (Run::Aborted, "pressed".into()));
    start(&mut button, "released").unwrap();
    wire.broken.set(true);
    assert_eq!(
        poll(&mut button, 32),
        (Run::Failed, "the input pin failed".into())
    );

    let refused = Err("button takes pressed or released".into());
    assert_eq!(start(&mut button, "5"), refused);
}

#[test]
fn an_input_has_no_unsafe_state() {
    let wire = released();
    let mut button = button(&wire);
    testing::start(&mut button, Instant::ZERO, "pressed").unwrap();
    wire.broken.set(true);
    let text = "the input pin failed";
    assert_eq!(poll(&mut button, 0), (Run::Failed, text.into()));
    button.make_safe(Instant::ZERO);
    assert_eq!(poll(&mut button, 0), (Run::Aborted, text.into()));
}
