//! A sensor that has a new reading whenever the line has room.

use std::time::Duration;

use ztl_mcu::describe::{ComponentDescription, GoalRule};
use ztl_mcu::link::Offer;
use ztl_mcu::parameters::Tunable;
use ztl_mcu::{Component, Instant, Reading, Refused, Report, Run, description};

/// Length of a reading in bytes.
const LEN: usize = 100;

/// `probe`: publishes readings and takes no tasks.
#[derive(Debug)]
pub(super) struct Sensor {
    /// Shortest time between two readings.
    pause: Duration,
    /// When the next reading is due.
    due: Instant,
    number: u32,
}

impl Sensor {
    pub(super) const fn new(pause: Duration) -> Self {
        Self {
            pause,
            due: Instant::ZERO,
            number: 0,
        }
    }
}

/// What it says of itself.
pub(super) const DESCRIPTION: &str = description!(ComponentDescription {
    about: Some("publishes readings, takes no goals"),
    ..ComponentDescription::new(GoalRule::Any)
});

const TAKES: &str = "probe takes no goals, it only publishes";

impl Tunable for Sensor {}

impl Component for Sensor {
    fn offer(&self) -> Offer<'_> {
        Offer::new("probe").with_topics("reading")
    }

    fn check(&self, _goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        why.text(TAKES);
        Err(Refused)
    }

    fn start(&mut self, _now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.check(goal, why)
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        report.text(TAKES);
        Run::Aborted
    }

    fn abort(&mut self, _now: Instant) {}

    fn make_safe(&mut self, _now: Instant) {}

    fn poll_timeout(&self, _now: Instant) -> Instant {
        self.due
    }

    /// The reading's number as text, padded with `.`.
    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        if now < self.due {
            return None;
        }
        let reading = buffer.get_mut(..LEN)?;
        reading.fill(b'.');
        for (to, digit) in reading.iter_mut().zip(self.number.to_string().bytes()) {
            *to = digit;
        }
        self.number = self.number.wrapping_add(1);
        self.due = now + self.pause;
        Some(Reading { topic: 0, len: LEN })
    }
}
