//! A lamp, valve, magnet or relay on an output pin.

use core::time::Duration;

use embedded_hal::digital::{OutputPin, PinState};
use ztl_core::Instant;
use ztl_core::link::{Busy, GoalShape, Loss, Offer};
use ztl_core::sink::div_10;

use super::{number, takes};
use crate::component::{Component, Refused, Report, Run};

/// Longest pulse: an hour.
const LONGEST_MS: u32 = 3_600_000;

/// The goals that would be right.
const TAKEN: &str = "on, off, or pulse 1 to 3600000 ms";

/// What [`make_safe`](Component::make_safe) does to an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SafeOutput {
    /// It goes off.
    Off,
    /// It goes on: a brake that power closes, a warning lamp.
    On,
    /// It stays as it is; but a pulse ends.
    Keep,
}

/// What an output is. Take [`DEFAULT`](Self::DEFAULT) and change what differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DigitalOutputConfig {
    /// Whether it is on when the pin is low. Default: on when high.
    pub inverted: bool,
    /// The safe state, in which it also starts, and to which it goes when the link is lost. Default: off.
    pub safe: SafeOutput,
    /// What happens to a task that comes while a pulse runs. Default: it is refused.
    pub busy: Busy,
}

impl DigitalOutputConfig {
    /// On when high, off when safe.
    pub const DEFAULT: Self = Self {
        inverted: false,
        safe: SafeOutput::Off,
        busy: Busy::Refuse,
    };
}

impl Default for DigitalOutputConfig {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// An output that is switched: its goals are `on`, `off`, and `pulse 200`, or only `200`, for on
/// during so many milliseconds, a whole number, up to an hour.
///
/// `on` and `off` are COMPLETED at once, and the output stays so. A pulse is COMPLETED when it has
/// ended; its progress is `on, 120 ms left`; an abort switches off. `True` and `False` are taken for
/// `on` and `off`, since clients in Python make that of them, and `{'pulse': 200}` for `pulse 200`.
/// An error of the pin ends the task as FAILED.
///
/// When the link is lost it goes to its [safe state](DigitalOutputConfig::safe), also long after `on` was COMPLETED.
///
/// ```
/// use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
/// # use embedded_hal::digital::{ErrorType, OutputPin};
/// # struct Pin(bool);
/// # impl ErrorType for Pin { type Error = core::convert::Infallible; }
/// # impl OutputPin for Pin {
/// #     fn set_low(&mut self) -> Result<(), Self::Error> { self.0 = false; Ok(()) }
/// #     fn set_high(&mut self) -> Result<(), Self::Error> { self.0 = true; Ok(()) }
/// # }
/// # let pin = Pin(true);
///
/// // `pin` is an output of your chip's HAL. This lamp lights when it is low.
/// const LAMP: DigitalOutputConfig = DigitalOutputConfig { inverted: true, ..DigitalOutputConfig::DEFAULT };
/// let lamp = DigitalOutput::new("lamp", pin, LAMP);
/// ```
#[derive(Debug, Clone, Hash)]
pub struct DigitalOutput<P> {
    name: &'static str,
    pin: P,
    config: DigitalOutputConfig,
    on: bool,
    /// When the pulse ends.
    until: Option<Instant>,
    aborted: bool,
    /// The pin could not be set.
    failed: bool,
}

#[derive(Debug, Clone, Copy)]
enum Goal {
    On,
    Off,
    Pulse { ms: u32 },
}

impl<P: OutputPin> DigitalOutput<P> {
    /// An output of this name on this pin, which is set to its safe state at once.
    pub fn new(name: &'static str, pin: P, config: DigitalOutputConfig) -> Self {
        let mut output = Self {
            name,
            pin,
            config,
            on: false,
            until: None,
            aborted: false,
            failed: false,
        };
        output.go_safe();
        output
    }

    /// Whether it was switched on.
    #[must_use]
    pub const fn is_on(&self) -> bool {
        self.on
    }

    fn set(&mut self, on: bool) {
        self.on = on;
        self.until = None;
        let state = PinState::from(on != self.config.inverted);
        self.failed = self.pin.set_state(state).is_err();
    }

    fn go_safe(&mut self) {
        match self.config.safe {
            SafeOutput::Off => self.set(false),
            SafeOutput::On => self.set(true),
            SafeOutput::Keep if self.until.is_some() => self.set(false),
            SafeOutput::Keep => {}
        }
    }
}

impl<P: OutputPin> Component for DigitalOutput<P> {
    fn offer(&self) -> Offer<'_> {
        Offer {
            name: self.name,
            goal: GoalShape {
                range: Some((1.0, LONGEST_MS as f32)),
                unit: "ms",
                words: "on off pulse",
            },
            busy: self.config.busy,
            loss: match self.config.safe {
                SafeOutput::Keep => Loss::Hold,
                SafeOutput::Off | SafeOutput::On => Loss::Abort,
            },
            topics: "",
        }
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if parse(goal).is_some() {
            return Ok(());
        }
        takes(why, self.name);
        why.text(TAKEN);
        Err(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        // It was checked.
        let goal = parse(goal).ok_or(Refused)?;
        self.aborted = false;
        self.set(!matches!(goal, Goal::Off));
        if let Goal::Pulse { ms } = goal {
            // 32 bits hold an hour of them.
            self.until = Some(now.after((ms * 1000).into()));
        }
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let left = match self.until {
            Some(until) if now < until => millis_between(now, until),
            _ => 0,
        };
        if left == 0 && self.until.is_some() {
            self.set(false);
        }
        if self.failed {
            self.until = None;
            report.text("the output pin failed");
            return Run::Failed;
        }
        report.text(if self.on { "on" } else { "off" });
        if left > 0 {
            report.text(", ");
            number::report(report, left as i32, 0);
            report.text(" ms left");
            Run::Running
        } else if self.aborted {
            Run::Aborted
        } else {
            Run::Completed
        }
    }

    fn abort(&mut self, _now: Instant) {
        if self.until.is_some() {
            self.aborted = true;
            self.set(false);
        }
    }

    fn make_safe(&mut self, _now: Instant) {
        self.go_safe();
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        let soon = now + Duration::from_millis(50);
        self.until.map_or(soon, |until| until.min(soon))
    }
}

/// Rounded up; the second is the later, by an hour at most.
fn millis_between(now: Instant, until: Instant) -> u32 {
    let micros = until.as_micros().wrapping_sub(now.as_micros());
    let mut left = (micros as u32).saturating_add(999);
    for _ in 0..3 {
        (left, _) = div_10(left);
    }
    left
}

/// What switches off, on, off and on, in lower case.
const WORDS: [&str; 4] = ["off", "on", "false", "true"];

/// What may stand before the number of a pulse.
const PULSES: [&[u8]; 3] = [b"pulse ", b"{'pulse': ", b"{pulse: "];

fn parse(goal: &str) -> Option<Goal> {
    let mut goal = goal.as_bytes().trim_ascii();
    for (place, word) in WORDS.iter().enumerate() {
        if goal.eq_ignore_ascii_case(word.as_bytes()) {
            return Some(if place & 1 == 0 { Goal::Off } else { Goal::On });
        }
    }
    for before in &PULSES {
        goal = match goal.strip_prefix(*before) {
            Some([number @ .., b'}']) if before.len() > 6 => number,
            Some(number) if before.len() == 6 => number,
            _ => continue,
        };
        break;
    }
    let ms = number::parse_whole(goal)?;
    (1..=LONGEST_MS).contains(&ms).then_some(Goal::Pulse { ms })
}

#[cfg(test)]
mod tests;
