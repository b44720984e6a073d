use super::*;
use core::cell::Cell;
use embedded_hal::digital::{Error, ErrorKind, ErrorType};
use std::string::String;

/// A pin with this level; `None` when it cannot be read.
struct Pin<'a>(&'a Cell<Option<bool>>);

#[derive(Debug)]
struct Broken;

impl Error for Broken {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Other
    }
}

impl ErrorType for Pin<'_> {
    type Error = Broken;
}

impl InputPin for Pin<'_> {
    fn is_high(&mut self) -> Result<bool, Broken> {
        self.0.get().ok_or(Broken)
    }

    fn is_low(&mut self) -> Result<bool, Broken> {
        self.is_high().map(|high| !high)
    }
}

fn button(level: &Cell<Option<bool>>) -> DigitalInput<Pin<'_>> {
    DigitalInput::new("button", Pin(level), DigitalInputConfig::DEFAULT)
}

fn reading(button: &mut DigitalInput<Pin<'_>>, ms: u64) -> Option<String> {
    let mut buffer = [0xA5; 8];
    let reading = button.poll_reading(Instant::from_millis(ms), &mut buffer)?;
    assert_eq!(reading.topic, 0);
    Some(std::str::from_utf8(&buffer[..reading.len]).unwrap().into())
}

fn poll(button: &mut DigitalInput<Pin<'_>>, ms: u64) -> (Run, String) {
    let mut text = heapless::String::<48>::new();
    let run = button.poll(Instant::from_millis(ms), &mut Report::new(&mut text));
    (run, text.as_str().into())
}

#[test]
fn changes_are_published_after_debouncing() {
    let level = Cell::new(Some(true));
    let mut button = button(&level);
    assert_eq!(
        button.poll_reading(Instant::ZERO, &mut [0; 3]),
        None,
        "no room"
    );
    assert_eq!(reading(&mut button, 0).as_deref(), Some("False"));
    assert_eq!(reading(&mut button, 1), None);
    level.set(Some(false));
    assert_eq!(reading(&mut button, 10), None);
    // It bounces, which restarts the wait.
    level.set(Some(true));
    assert_eq!(reading(&mut button, 15), None);
    level.set(Some(false));
    assert_eq!(reading(&mut button, 16), None);
    assert_eq!(reading(&mut button, 35), None);
    assert_eq!(reading(&mut button, 36).as_deref(), Some("True"));
    assert_eq!(button.is_pressed(), Some(true));
    level.set(None);
    assert_eq!(reading(&mut button, 99), None);
}

#[test]
fn a_task_waits_for_its_input_state() {
    let level = Cell::new(Some(true));
    let mut button = button(&level);
    let mut text = heapless::String::<48>::new();
    let mut start = |button: &mut DigitalInput<Pin<'_>>, goal: &str| {
        let start = button.start(Instant::ZERO, goal, &mut Report::new(&mut text));
        start.map_err(|Refused| String::from(text.as_str()))
    };
    start(&mut button, "pressed").unwrap();
    assert_eq!(poll(&mut button, 0), (Run::Running, "released".into()));
    level.set(Some(false));
    assert_eq!(poll(&mut button, 10), (Run::Running, "released".into()));
    assert_eq!(poll(&mut button, 30), (Run::Completed, "pressed".into()));

    start(&mut button, "released").unwrap();
    button.abort(Instant::ZERO);
    assert_eq!(poll(&mut button, 31), (Run::Aborted, "pressed".into()));
    start(&mut button, "released").unwrap();
    level.set(None);
    assert_eq!(
        poll(&mut button, 32),
        (Run::Failed, "the input pin failed".into())
    );

    let refused = Err("button takes pressed or released".into());
    assert_eq!(start(&mut button, "5"), refused);
}
