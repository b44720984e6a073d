//! A button, a bumper or a light barrier on an input pin.

use core::time::Duration;

use embedded_hal::digital::InputPin;
use ztl_core::Instant;
use ztl_core::link::{Busy, GoalShape, Loss, Offer};

use super::expected::begin_expected;
use crate::component::{Component, Reading, Refused, Report, Run};
use crate::describe::{ComponentDescription, Describe, GoalRule};
use crate::description;
use crate::parameters::Tunable;

/// Settings of an input. Start with [`DEFAULT`](Self::DEFAULT) and change what differs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DigitalInputConfig {
    /// Whether a low pin means pressed, as with a button to ground and a pull-up. Defaults to `true`.
    pub active_low: bool,
    /// How long a new level must last before it counts, in ms. Defaults to 20.
    pub debounce_ms: u16,
}

impl DigitalInputConfig {
    /// A button to ground.
    pub const DEFAULT: Self = Self {
        active_low: true,
        debounce_ms: 20,
    };
}

impl Default for DigitalInputConfig {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// A debounced input. It publishes `True` and `False` on its topic `pressed`, once at the start and at each change. Its
/// goals `pressed` and `released` wait for that state, and are COMPLETED at once if it is reached already.
///
/// It samples the pin every 10 ms, or in each turn of a slower main loop. It misses shorter presses.
#[derive(Debug, Clone, Hash)]
pub struct DigitalInput<P> {
    name: &'static str,
    pin: P,
    config: DigitalInputConfig,
    /// The debounced state; `None` before the first sample.
    pressed: Option<bool>,
    /// Since when the pin differs from the debounced state, if it does.
    change: Option<Instant>,
    /// The last published state.
    published: Option<bool>,
    /// The state that the task waits for.
    awaited: bool,
    aborted: bool,
}

impl<P: InputPin> DigitalInput<P> {
    /// An input with this name on this pin.
    pub const fn new(name: &'static str, pin: P, config: DigitalInputConfig) -> Self {
        Self {
            name,
            pin,
            config,
            pressed: None,
            change: None,
            published: None,
            awaited: true,
            aborted: false,
        }
    }

    /// The debounced state; `None` before the first sample.
    #[must_use]
    pub const fn is_pressed(&self) -> Option<bool> {
        self.pressed
    }

    fn sample(&mut self, now: Instant) -> Result<(), P::Error> {
        let level = self.pin.is_high()? != self.config.active_low;
        if self.pressed == Some(level) {
            self.change = None;
            return Ok(());
        }
        let since = *self.change.get_or_insert(now);
        let wait = Duration::from_millis(self.config.debounce_ms.into());
        if self.pressed.is_none() || now >= since + wait {
            self.pressed = Some(level);
            self.change = None;
        }
        Ok(())
    }
}

impl<P> Tunable for DigitalInput<P> {}

impl<P> Describe for DigitalInput<P> {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("waits until it is pressed or released"),
        ..ComponentDescription::new(GoalRule::words(&["pressed", "released"]))
    });
}

impl<P: InputPin> Component for DigitalInput<P> {
    fn offer(&self) -> Offer<'_> {
        Offer {
            name: self.name,
            goal: GoalShape {
                range: None,
                unit: "",
                words: "pressed released",
            },
            busy: Busy::Refuse,
            loss: Loss::Abort,
            topics: "pressed",
        }
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if matches!(goal.trim_ascii(), "pressed" | "released") {
            return Ok(());
        }
        begin_expected(why, self.name);
        why.text("pressed or released");
        Err(Refused)
    }

    fn start(&mut self, _now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.check(goal, why)?;
        self.awaited = goal.trim_ascii() == "pressed";
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        if self.sample(now).is_err() {
            report.text("the input pin failed");
            // An input is always safe.
            return match self.aborted {
                true => Run::Aborted,
                false => Run::Failed,
            };
        }
        let pressed = self.pressed == Some(true);
        report.text(if pressed { "pressed" } else { "released" });
        if pressed == self.awaited {
            Run::Completed
        } else if self.aborted {
            Run::Aborted
        } else {
            Run::Running
        }
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        // A failing pin publishes nothing; a task reports the failure.
        self.sample(now).ok()?;
        let pressed = self.pressed.filter(|_| self.pressed != self.published)?;
        let text: &[u8] = if pressed { b"True" } else { b"False" };
        let room = buffer.get_mut(..text.len())?;
        for (to, from) in room.iter_mut().zip(text) {
            *to = *from;
        }
        self.published = Some(pressed);
        Some(Reading {
            topic: 0,
            len: text.len(),
        })
    }
}

#[cfg(test)]
mod tests;
