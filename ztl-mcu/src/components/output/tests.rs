use super::*;
use crate::components::testing::{self, Pin, Wire};
use std::string::String;

fn lamp(wire: &Wire) -> DigitalOutput<Pin<'_>> {
    DigitalOutput::new("lamp", Pin(wire), DigitalOutputConfig::DEFAULT)
}

fn start(lamp: &mut DigitalOutput<Pin<'_>>, ms: u64, goal: &str) -> Result<(), String> {
    testing::start(lamp, Instant::from_millis(ms), goal)
}

fn poll(lamp: &mut DigitalOutput<Pin<'_>>, ms: u64) -> (Run, String) {
    testing::poll(lamp, Instant::from_millis(ms))
}

/// How it stands, and what is said.
fn says(run: Run, text: &str) -> (Run, String) {
    (run, text.into())
}

#[test]
fn on_and_off_take_effect_at_once_and_persist() {
    let wire = Wire::default();
    wire.set(true);
    let mut lamp = lamp(&wire);
    assert!(!wire.is_high(), "off from the beginning");
    for (goal, on) in [
        ("on", true),
        ("off", false),
        ("True", true),
        ("False", false),
    ] {
        start(&mut lamp, 5, goal).unwrap();
        assert_eq!(wire.is_high(), on);
        let text = if on { "on" } else { "off" };
        assert_eq!(poll(&mut lamp, 5), says(Run::Completed, text));
        assert_eq!(wire.is_high(), on);
    }
}

#[test]
fn a_pulse_has_the_requested_length_and_reports_the_time_left() {
    let wire = Wire::default();
    let mut lamp = lamp(&wire);
    for goal in [
        "pulse 200",
        "200",
        "{pulse: 200}",
        "{'pulse': 200}",
        "{'pulse': 200.0}",
    ] {
        start(&mut lamp, 1000, goal).unwrap();
        assert!(wire.is_high());
        assert_eq!(poll(&mut lamp, 1000), says(Run::Running, "on, 200 ms left"));
        assert_eq!(poll(&mut lamp, 1080), says(Run::Running, "on, 120 ms left"));
        assert_eq!(poll(&mut lamp, 1199), says(Run::Running, "on, 1 ms left"));
        let wake = lamp.poll_timeout(Instant::from_millis(1199));
        assert_eq!(wake, Instant::from_millis(1200));
        assert_eq!(poll(&mut lamp, 1200), says(Run::Completed, "off"));
        assert!(!wire.is_high());
    }
    start(&mut lamp, 0, "3600000").unwrap();
    assert_eq!(
        poll(&mut lamp, 1),
        says(Run::Running, "on, 3599999 ms left")
    );
}

#[test]
fn an_abort_ends_a_pulse() {
    let wire = Wire::default();
    let mut lamp = lamp(&wire);
    start(&mut lamp, 0, "pulse 200").unwrap();
    lamp.abort(Instant::from_millis(3));
    assert!(!wire.is_high());
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
        let wire = Wire::default();
        let config = DigitalOutputConfig {
            inverted,
            safe,
            ..DigitalOutputConfig::DEFAULT
        };
        let mut lamp = DigitalOutput::new("lamp", Pin(&wire), config);
        if safe != Keep {
            assert_eq!(wire.is_high() != inverted, safe == On, "from the beginning");
        }
        start(&mut lamp, 0, goal).unwrap();
        poll(&mut lamp, 0);
        lamp.make_safe(Instant::from_millis(1));
        assert_eq!(
            wire.is_high() != inverted,
            after,
            "{inverted} {safe:?} {goal}"
        );
        assert_eq!(lamp.is_on(), after);
        let hold = lamp.offer().loss == Loss::Hold;
        assert_eq!(hold, safe == Keep);
    }
}

#[test]
fn a_failing_pin_fails_the_task() {
    let wire = Wire::default();
    let mut lamp = lamp(&wire);
    wire.broken.set(true);
    start(&mut lamp, 0, "pulse 100").unwrap();
    let failed = says(Run::Failed, "the output pin failed");
    assert_eq!(poll(&mut lamp, 0), failed);
    wire.broken.set(false);
    start(&mut lamp, 0, "pulse 100").unwrap();
    wire.broken.set(true);
    assert_eq!(poll(&mut lamp, 100), failed);
    wire.broken.set(false);
    start(&mut lamp, 0, "off").unwrap();
    assert_eq!(poll(&mut lamp, 0), says(Run::Completed, "off"));
}

#[test]
fn any_other_goal_is_rejected_with_the_valid_ones() {
    let wire = Wire::default();
    let mut lamp = lamp(&wire);
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
    assert!(!wire.is_high());
}

#[test]
fn an_output_that_cannot_be_made_safe_fails_until_it_is() {
    use SafeOutput::{Keep, Off, On};
    for (safe, goal, after) in [
        (Off, "on", false),
        (On, "off", true),
        (Keep, "pulse 200", false),
        (Off, "pulse 200", false),
    ] {
        let wire = Wire::default();
        let config = DigitalOutputConfig {
            safe,
            ..DigitalOutputConfig::DEFAULT
        };
        let mut lamp = DigitalOutput::new("lamp", Pin(&wire), config);
        start(&mut lamp, 0, goal).unwrap();
        wire.broken.set(true);
        for ms in 1..4 {
            lamp.make_safe(Instant::from_millis(ms));
            assert_eq!(poll(&mut lamp, ms).0, Run::Failed, "{safe:?} {goal}");
            assert_ne!(wire.is_high(), after);
        }
        wire.broken.set(false);
        lamp.make_safe(Instant::from_millis(5));
        assert_ne!(poll(&mut lamp, 5).0, Run::Failed);
        assert_eq!(wire.is_high(), after, "{safe:?} {goal}");
    }
}

#[test]
fn an_output_that_keeps_its_level_is_safe_after_a_failed_task() {
    let wire = Wire::default();
    let config = DigitalOutputConfig {
        safe: SafeOutput::Keep,
        ..DigitalOutputConfig::DEFAULT
    };
    let mut lamp = DigitalOutput::new("lamp", Pin(&wire), config);
    wire.broken.set(true);
    start(&mut lamp, 0, "on").unwrap();
    assert_eq!(poll(&mut lamp, 0).0, Run::Failed);
    wire.broken.set(false);
    lamp.make_safe(Instant::from_millis(1));
    assert_ne!(poll(&mut lamp, 1).0, Run::Failed);
    assert!(!wire.is_high(), "it is not switched on later");
}
