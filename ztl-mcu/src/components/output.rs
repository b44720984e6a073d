//! A lamp, valve, magnet or relay on an output pin.

use core::time::Duration;

use embedded_hal::digital::{OutputPin, PinState};
use ztl_core::Instant;
use ztl_core::link::{Busy, GoalShape, Loss, Offer};
use ztl_core::sink::div_10;

use super::expected::begin_expected;
use super::number;
use crate::component::{Component, Refused, Report, Run};
use crate::describe::{ComponentDescription, Describe, GoalRule};
use crate::description;
use crate::parameters::Tunable;

/// Longest pulse, an hour.
const LONGEST_MS: u32 = 3_600_000;

/// The valid goals.
const EXPECTED: &str = "on, off, or pulse 1 to 3600000 ms";

/// What [`make_safe`](Component::make_safe) does to an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SafeOutput {
    /// It goes off.
    Off,
    /// It stays on: a warning lamp, a brake that needs power.
    On,
    /// It keeps its level, but a pulse ends.
    Keep,
}

/// Settings of an output. Start with [`DEFAULT`](Self::DEFAULT) and change what differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DigitalOutputConfig {
    /// Whether it is on when the pin is low. Defaults to `false`.
    pub inverted: bool,
    /// The state at the start and when the link is lost. Defaults to off.
    pub safe: SafeOutput,
    /// What happens to a task that arrives during a pulse. By default it is refused.
    pub busy: Busy,
}

impl DigitalOutputConfig {
    /// On when the pin is high, off in the safe state.
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

/// A switched output. Its goals are `on`, `off`, and `pulse 200` (or `200`) for a pulse of 200 ms: a whole number up to
/// an hour.
///
/// `on` and `off` are COMPLETED at once, and the output keeps its level. A pulse is COMPLETED at its end; its progress is
/// `on, 120 ms left`, and an abort switches the output off. `True` and `False` mean `on` and `off`, because Python
/// clients convert them, and `{'pulse': 200}` means `pulse 200`. An error of the pin ends the task as FAILED; on the way to
/// the safe state, the node tries again until the pin works.
///
/// When the link is lost, the output goes to its [safe state](DigitalOutputConfig::safe), even long after `on` was
/// COMPLETED.
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
    /// Setting the pin failed.
    failed: bool,
}

#[derive(Debug, Clone, Copy)]
enum Goal {
    On,
    Off,
    Pulse { ms: u32 },
}

impl<P: OutputPin> DigitalOutput<P> {
    /// An output with this name on this pin, which is set to its safe state at once. If the pin fails here, as one behind an
    /// expander may, it keeps its level until a task sets it or the link is lost.
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
            // A pulse, or an attempt to switch off that failed.
            SafeOutput::Keep if self.until.is_some() || !self.on => self.set(false),
            SafeOutput::Keep => self.failed = false,
        }
    }
}

impl<P> Tunable for DigitalOutput<P> {}

impl<P> Describe for DigitalOutput<P> {
    // No rule covers `pulse 200`, and one that leaves it out would call it wrong.
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("switches on or off, or on for some ms"),
        examples: &["on", "off", "pulse 500"],
        ..ComponentDescription::new(GoalRule::Any)
    });
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
        begin_expected(why, self.name);
        why.text(EXPECTED);
        Err(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        // Valid: the goal was checked.
        let goal = parse(goal).ok_or(Refused)?;
        self.aborted = false;
        self.set(!matches!(goal, Goal::Off));
        if let Goal::Pulse { ms } = goal {
            // An hour of microseconds fits 32 bits.
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

/// Milliseconds from `now` to the later `until`, rounded up; at most an hour.
fn millis_between(now: Instant, until: Instant) -> u32 {
    let micros = until.as_micros().wrapping_sub(now.as_micros());
    let mut left = (micros as u32).saturating_add(999);
    for _ in 0..3 {
        (left, _) = div_10(left);
    }
    left
}

/// The words that switch off, on, off and on.
const WORDS: [&str; 4] = ["off", "on", "false", "true"];

/// The prefixes of the number of a pulse.
const PULSES: [&[u8]; 3] = [b"pulse ", b"{'pulse': ", b"{pulse: "];

fn parse(goal: &str) -> Option<Goal> {
    let mut goal = goal.as_bytes().trim_ascii();
    for (index, word) in WORDS.iter().enumerate() {
        if goal.eq_ignore_ascii_case(word.as_bytes()) {
            return Some(if index & 1 == 0 { Goal::Off } else { Goal::On });
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
