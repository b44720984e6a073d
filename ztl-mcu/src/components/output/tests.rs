use super::*;
use core::cell::Cell;
use embedded_hal::digital::{Error, ErrorKind, ErrorType};
use std::string::String;

/// A pin whose level is looked at.
struct Pin<'a> {
    high: &'a Cell<bool>,
    broken: &'a Cell<bool>,
}

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

impl Pin<'_> {
    fn set(&self, high: bool) -> Result<(), Broken> {
        if self.broken.get() {
            return Err(Broken);
        }
        self.high.set(high);
        Ok(())
    }
}

impl OutputPin for Pin<'_> {
    fn set_low(&mut self) -> Result<(), Broken> {
        self.set(false)
    }

    fn set_high(&mut self) -> Result<(), Broken> {
        self.set(true)
    }
}

/// As a node does it.
fn start(lamp: &mut DigitalOutput<Pin<'_>>, ms: u64, goal: &str) -> Result<(), String> {
    let mut text = heapless::String::<48>::new();
    let now = Instant::from_millis(ms);
    let mut checked = lamp.check(goal, &mut Report::new(&mut text));
    if checked.is_ok() {
        checked = lamp.start(now, goal, &mut Report::new(&mut text));
    }
    checked.map_err(|Refused| text.as_str().into())
}

fn poll(lamp: &mut DigitalOutput<Pin<'_>>, ms: u64) -> (Run, String) {
    let mut text = heapless::String::<48>::new();
    let run = lamp.poll(Instant::from_millis(ms), &mut Report::new(&mut text));
    (run, text.as_str().into())
}

/// How it stands, and what is said.
fn says(run: Run, text: &str) -> (Run, String) {
    (run, text.into())
}

#[test]
fn on_and_off_take_effect_at_once_and_persist() {
    let (high, broken) = (Cell::new(true), Cell::new(false));
    let pin = Pin {
        high: &high,
        broken: &broken,
    };
    let mut lamp = DigitalOutput::new("lamp", pin, DigitalOutputConfig::DEFAULT);
    assert!(!high.get(), "off from the beginning");
    for (goal, on) in [
        ("on", true),
        ("off", false),
        ("True", true),
        ("False", false),
    ] {
        start(&mut lamp, 5, goal).unwrap();
        assert_eq!(high.get(), on);
        let text = if on { "on" } else { "off" };
        assert_eq!(poll(&mut lamp, 5), says(Run::Completed, text));
        assert_eq!(high.get(), on);
    }
}

#[test]
fn a_pulse_has_the_requested_length_and_reports_the_time_left() {
    let (high, broken) = (Cell::new(false), Cell::new(false));
    let pin = Pin {
        high: &high,
        broken: &broken,
    };
    let mut lamp = DigitalOutput::new("lamp", pin, DigitalOutputConfig::DEFAULT);
    for goal in [
        "pulse 200",
        "200",
        "{pulse: 200}",
        "{'pulse': 200}",
        "{'pulse': 200.0}",
    ] {
        start(&mut lamp, 1000, goal).unwrap();
        assert!(high.get());
        assert_eq!(poll(&mut lamp, 1000), says(Run::Running, "on, 200 ms left"));
        assert_eq!(poll(&mut lamp, 1080), says(Run::Running, "on, 120 ms left"));
        assert_eq!(poll(&mut lamp, 1199), says(Run::Running, "on, 1 ms left"));
        let wake = lamp.poll_timeout(Instant::from_millis(1199));
        assert_eq!(wake, Instant::from_millis(1200));
        assert_eq!(poll(&mut lamp, 1200), says(Run::Completed, "off"));
        assert!(!high.get());
    }
    start(&mut lamp, 0, "3600000").unwrap();
    assert_eq!(
        poll(&mut lamp, 1),
        says(Run::Running, "on, 3599999 ms left")
    );
}

#[test]
fn an_abort_ends_a_pulse() {
    let (high, broken) = (Cell::new(false), Cell::new(false));
    let pin = Pin {
        high: &high,
        broken: &broken,
    };
    let mut lamp = DigitalOutput::new("lamp", pin, DigitalOutputConfig::DEFAULT);
    start(&mut lamp, 0, "pulse 200").unwrap();
    lamp.abort(Instant::from_millis(3));
    assert!(!high.get());
    assert_eq!(poll(&mut lamp, 3), says(Run::Aborted, "off"));
    start(&mut lamp, 4, "on").unwrap();
    assert_eq!(poll(&mut lamp, 4), says(Run::Completed, "on"));
}

#[test]
fn the_safe_state_is_as_configured() {
    use SafeOutput::{Keep, Off, On};
    for (inverted, safe, goal, after) in [
        (false, Off, "on", false),
        (true, Off, "on", false),
        (false, On, "off", true),
        (true, On, "off", true),
        (false, Keep, "on", true),
        (true, Keep, "off", false),
        (false, Keep, "pulse 200", false),
        (false, Off, "pulse 200", false),
    ] {
        let (high, broken) = (Cell::new(false), Cell::new(false));
        let pin = Pin {
            high: &high,
            broken: &broken,
        };
        let config = DigitalOutputConfig {
            inverted,
            safe,
            ..DigitalOutputConfig::DEFAULT
        };
        let mut lamp = DigitalOutput::new("lamp", pin, config);
        if safe != Keep {
            assert_eq!(high.get() != inverted, safe == On, "from the beginning");
        }
        start(&mut lamp, 0, goal).unwrap();
        poll(&mut lamp, 0);
        lamp.make_safe(Instant::from_millis(1));
        assert_eq!(high.get() != inverted, after, "{inverted} {safe:?} {goal}");
        assert_eq!(lamp.is_on(), after);
        let hold = lamp.offer().loss == Loss::Hold;
        assert_eq!(hold, safe == Keep);
    }
}

#[test]
fn a_failing_pin_fails_the_task() {
    let (high, broken) = (Cell::new(false), Cell::new(false));
    let pin = Pin {
        high: &high,
        broken: &broken,
    };
    let mut lamp = DigitalOutput::new("lamp", pin, DigitalOutputConfig::DEFAULT);
    broken.set(true);
    start(&mut lamp, 0, "pulse 100").unwrap();
    let failed = says(Run::Failed, "the output pin failed");
    assert_eq!(poll(&mut lamp, 0), failed);
    broken.set(false);
    start(&mut lamp, 0, "pulse 100").unwrap();
    broken.set(true);
    assert_eq!(poll(&mut lamp, 100), failed);
    broken.set(false);
    start(&mut lamp, 0, "off").unwrap();
    assert_eq!(poll(&mut lamp, 0), says(Run::Completed, "off"));
}

#[test]
fn any_other_goal_is_rejected_with_the_valid_ones() {
    let (high, broken) = (Cell::new(false), Cell::new(false));
    let pin = Pin {
        high: &high,
        broken: &broken,
    };
    let mut lamp = DigitalOutput::new("lamp", pin, DigitalOutputConfig::DEFAULT);
    for goal in [
        "",
        "blink",
        "0",
        "-5",
        "3600001",
        "pulse",
        "pulse200",
        "pulse 0",
        "pulse x",
        "pulse 010",
        "pulse 0.5",
        "pulse 1.",
        "pulse 2e2",
        "pulse 99999999999",
        "{pulse: x}",
        "{pulse:200}",
        "{'pulse: 200}",
        "{blink: 3}",
        "{pulse 200}",
        "{pulse: 200",
    ] {
        let refused = Err("lamp takes on, off, or pulse 1 to 3600000 ms".into());
        assert_eq!(start(&mut lamp, 0, goal), refused, "{goal}");
    }
    assert!(!high.get());
}
