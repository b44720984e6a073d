//! A pin for the tests of the components, and the calls that a node makes.

use core::cell::Cell;
use embedded_hal::digital::{self, InputPin, OutputPin};
use embedded_hal::pwm::{self, SetDutyCycle};
use std::string::String;

use crate::{Component, Instant, Refused, Report, Run};

/// What is on a wire.
#[derive(Debug, Default)]
pub(super) struct Wire {
    /// 1 if it is high; of a PWM signal the duty, of 65,000 counts.
    pub(super) value: Cell<u16>,
    /// How often it was set.
    pub(super) writes: Cell<usize>,
    /// Whether the pin fails.
    pub(super) broken: Cell<bool>,
}

impl Wire {
    pub(super) fn set(&self, high: bool) {
        self.value.set(high.into());
    }

    pub(super) fn is_high(&self) -> bool {
        self.value.get() > 0
    }
}

/// A pin or a PWM output at a wire.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pin<'a>(pub(super) &'a Wire);

/// The highest duty of the PWM output.
pub(super) const MAX_DUTY: u16 = 65_000;

#[derive(Debug)]
pub(super) struct Broken;

impl digital::Error for Broken {
    fn kind(&self) -> digital::ErrorKind {
        digital::ErrorKind::Other
    }
}

impl pwm::Error for Broken {
    fn kind(&self) -> pwm::ErrorKind {
        pwm::ErrorKind::Other
    }
}

impl Pin<'_> {
    fn works(&self) -> Result<(), Broken> {
        match self.0.broken.get() {
            true => Err(Broken),
            false => Ok(()),
        }
    }

    fn set(&self, value: u16) -> Result<(), Broken> {
        self.works()?;
        self.0.value.set(value);
        self.0.writes.set(self.0.writes.get() + 1);
        Ok(())
    }
}

impl digital::ErrorType for Pin<'_> {
    type Error = Broken;
}

impl OutputPin for Pin<'_> {
    fn set_low(&mut self) -> Result<(), Broken> {
        self.set(0)
    }

    fn set_high(&mut self) -> Result<(), Broken> {
        self.set(1)
    }
}

impl InputPin for Pin<'_> {
    fn is_high(&mut self) -> Result<bool, Broken> {
        self.works()?;
        Ok(self.0.is_high())
    }

    fn is_low(&mut self) -> Result<bool, Broken> {
        self.is_high().map(|high| !high)
    }
}

impl pwm::ErrorType for Pin<'_> {
    type Error = Broken;
}

impl SetDutyCycle for Pin<'_> {
    fn max_duty_cycle(&self) -> u16 {
        MAX_DUTY
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Broken> {
        assert!(duty <= MAX_DUTY);
        self.set(duty)
    }
}

/// Starts a task; returns the reason of a refusal.
pub(super) fn start(component: &mut dyn Component, now: Instant, goal: &str) -> Result<(), String> {
    let mut text = heapless::String::<64>::new();
    let mut started = component.check(goal, &mut Report::new(&mut text));
    if started.is_ok() {
        started = component.start(now, goal, &mut Report::new(&mut text));
    }
    started.map_err(|Refused| text.as_str().into())
}

/// Polls a task; returns its text, too.
pub(super) fn poll(component: &mut dyn Component, now: Instant) -> (Run, String) {
    let mut text = heapless::String::<64>::new();
    let run = component.poll(now, &mut Report::new(&mut text));
    (run, text.as_str().into())
}
