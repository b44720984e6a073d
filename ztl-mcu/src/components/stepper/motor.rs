//! The motor's driver chip on its pins, and what moves it.

use core::cell::RefCell;
use core::convert::Infallible;

use critical_section::Mutex;
use embedded_hal::digital::{ErrorType, OutputPin, PinState};
use ztl_core::Instant;

use super::StepperConfig;
use super::generator::{Due, Generator, PARTS, Timing, after};
use super::limit::{Limit, NoLimit};
use crate::components::profile::Limits;

/// A pin that is not connected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NoPin;

impl ErrorType for NoPin {
    type Error = Infallible;
}

impl OutputPin for NoPin {
    fn set_low(&mut self) -> Result<(), Infallible> {
        Ok(())
    }

    fn set_high(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Which pin failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StepFault {
    /// Step.
    StepPin,
    /// Direction.
    DirectionPin,
    /// Enable.
    EnablePin,
    /// A limit switch's.
    LimitPin,
    /// Its code was called within itself.
    InUse,
}

impl StepFault {
    /// For the person who asked for the motion.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::StepPin => "the step pin failed",
            Self::DirectionPin => "the direction pin failed",
            Self::EnablePin => "the enable pin failed",
            Self::LimitPin => "a limit switch's pin failed",
            Self::InUse => "the motor is in use",
        }
    }
}

impl core::fmt::Display for StepFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.text())
    }
}

impl core::error::Error for StepFault {}

/// How a motion stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Motion {
    /// Under way.
    Moving,
    /// At rest: the target is reached, or it was stopped.
    Rest,
    /// A limit has stopped it.
    Limit,
    /// A pin has failed; it is stopped.
    Fault(StepFault),
}

/// What [`Stepper`](super::Stepper) tells a motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Command {
    /// Take power and go to this step.
    MoveTo {
        /// Where to.
        steps: i32,
        /// At the homing speed.
        homing: bool,
    },
    /// Slow down and rest.
    Stop,
    /// Stop at once.
    Halt,
    /// The place where it rests is this step.
    Set {
        /// Its number.
        steps: i32,
    },
    /// Take the power away.
    Release,
}

/// A motor that [`Stepper`](super::Stepper) supervises: a [`StepMotor`], or one that an interrupt
/// drives, behind a `critical_section::Mutex`.
pub trait StepDrive {
    /// Whether it has a switch to move home to.
    const HOME: bool;

    /// Follows this command.
    fn command(&mut self, now: Instant, command: Command);

    /// Lets it move on, if that is the main loop's task, and says when to be called next.
    fn drive(&mut self, now: Instant) -> Instant;

    /// How the last motion stands, and the position in steps.
    fn state(&self) -> (Motion, i32);
}

/// A driver chip with step and direction inputs (A4988, DRV8825, TMC2209, ...).
///
/// [`tick`](Self::tick) makes the steps. The main loop calls it by way of the component, or a timer's
/// interrupt does; see [`Stepper`](super::Stepper).
#[derive(Debug, Clone, Hash)]
pub struct StepMotor<S, D, E = NoPin, L = NoLimit, H = NoLimit> {
    step: S,
    direction: D,
    enable: E,
    low: L,
    high: H,
    generator: Generator,
    limits: Limits,
    homing: Limits,
    enable_us: u32,
    enable_high: bool,
    reverse: bool,
    powered: bool,
    ended: Motion,
}

impl<S: OutputPin, D: OutputPin> StepMotor<S, D> {
    /// A motor at rest, at step 0. Nothing is set on the pins; step has to be low.
    #[inline(always)] // With a constant configuration there is nothing to compute.
    pub const fn new(step: S, direction: D, config: &StepperConfig) -> Self {
        let speed = if config.speed == 0 { 1 } else { config.speed };
        let pulse_us = if config.pulse_us == 0 {
            1
        } else {
            config.pulse_us
        };
        let limits = Limits::new(speed, config.acceleration, PARTS);
        let timing = Timing {
            pulse_us: pulse_us as u32,
            direction_us: config.direction_us as u32,
            interval_us: 1_000_000u32.div_ceil(speed),
        };
        Self {
            step,
            direction,
            enable: NoPin,
            low: NoLimit,
            high: NoLimit,
            generator: Generator::new(timing, limits),
            limits,
            homing: limits.slower(config.home_speed, PARTS),
            enable_us: config.enable_us as u32,
            enable_high: config.enable_high,
            reverse: config.reverse,
            powered: false,
            ended: Motion::Rest,
        }
    }
}

impl<S, D, E, L, H> StepMotor<S, D, E, L, H> {
    /// With an enable pin. Its level is first set by the first motion.
    pub fn with_enable<P: OutputPin>(self, enable: P) -> StepMotor<S, D, P, L, H> {
        self.with(|_| enable, |low| low, |high| high)
    }

    /// With a switch at the low end, which is also the one that `home` goes to.
    pub fn with_low_limit<T: Limit>(self, limit: T) -> StepMotor<S, D, E, T, H> {
        self.with(|enable| enable, |_| limit, |high| high)
    }

    /// With a switch at the high end.
    pub fn with_high_limit<T: Limit>(self, limit: T) -> StepMotor<S, D, E, L, T> {
        self.with(|enable| enable, |low| low, |_| limit)
    }

    fn with<E2, L2, H2>(
        self,
        enable: impl FnOnce(E) -> E2,
        low: impl FnOnce(L) -> L2,
        high: impl FnOnce(H) -> H2,
    ) -> StepMotor<S, D, E2, L2, H2> {
        StepMotor {
            step: self.step,
            direction: self.direction,
            enable: enable(self.enable),
            low: low(self.low),
            high: high(self.high),
            generator: self.generator,
            limits: self.limits,
            homing: self.homing,
            enable_us: self.enable_us,
            enable_high: self.enable_high,
            reverse: self.reverse,
            powered: self.powered,
            ended: self.ended,
        }
    }
}

impl<S, D, E, L, H> StepMotor<S, D, E, L, H>
where
    S: OutputPin,
    D: OutputPin,
    E: OutputPin,
    L: Limit,
    H: Limit,
{
    /// Sets one pin, if that is due, and says when to be called next. A call that comes too early
    /// costs a comparison.
    pub fn tick(&mut self, now: Instant) -> Instant {
        if let Some(due) = self.generator.due(now) {
            match self.act(due) {
                Ok(true) => self.generator.done(now, due),
                Ok(false) => self.end(Motion::Limit),
                Err(fault) => self.end(Motion::Fault(fault)),
            }
        }
        self.generator.wake()
    }

    /// `false` when a limit forbids it.
    fn act(&mut self, due: Due) -> Result<bool, StepFault> {
        match due {
            Due::Direction { forward } => {
                let level = PinState::from(forward != self.reverse);
                let set = self.direction.set_state(level);
                set.map_err(|_| StepFault::DirectionPin)?;
            }
            Due::Step { forward: true } if self.high.is_reached()? => return Ok(false),
            Due::Step { forward: false } if self.low.is_reached()? => return Ok(false),
            Due::Step { .. } => self.step.set_high().map_err(|_| StepFault::StepPin)?,
            Due::PulseEnd => self.step.set_low().map_err(|_| StepFault::StepPin)?,
        }
        Ok(true)
    }

    fn end(&mut self, how: Motion) {
        self.generator.halt();
        self.ended = how;
    }

    fn power(&mut self, on: bool) -> Result<(), StepFault> {
        self.powered = on;
        let level = PinState::from(on == self.enable_high);
        let set = self.enable.set_state(level);
        set.map_err(|_| StepFault::EnablePin)
    }
}

impl<S, D, E, L, H> StepDrive for StepMotor<S, D, E, L, H>
where
    S: OutputPin,
    D: OutputPin,
    E: OutputPin,
    L: Limit,
    H: Limit,
{
    const HOME: bool = L::PRESENT;

    fn command(&mut self, now: Instant, command: Command) {
        match command {
            Command::MoveTo { steps, homing } => {
                self.ended = Motion::Rest;
                let lead = if self.powered { 0 } else { self.enable_us };
                if let Err(fault) = self.power(true) {
                    return self.end(Motion::Fault(fault));
                }
                let limits = if homing { self.homing } else { self.limits };
                self.generator.move_to(after(now, lead), steps, limits);
            }
            Command::Stop => self.generator.stop(),
            Command::Halt => self.generator.halt(),
            Command::Set { steps } => self.generator.put(steps),
            Command::Release => {
                if let Err(fault) = self.power(false) {
                    self.end(Motion::Fault(fault));
                }
            }
        }
    }

    fn drive(&mut self, now: Instant) -> Instant {
        self.tick(now)
    }

    fn state(&self) -> (Motion, i32) {
        let motion = if self.generator.is_moving() && self.ended == Motion::Rest {
            Motion::Moving
        } else {
            self.ended
        };
        (motion, self.generator.steps())
    }
}

/// A motor that an interrupt drives: it calls [`StepMotor::tick`], the component only commands.
impl<M: StepDrive> StepDrive for &Mutex<RefCell<M>> {
    const HOME: bool = M::HOME;

    fn command(&mut self, now: Instant, command: Command) {
        critical_section::with(|token| {
            // It is free: nothing else runs in here.
            if let Ok(mut motor) = self.borrow(token).try_borrow_mut() {
                motor.command(now, command);
            }
        });
    }

    fn drive(&mut self, now: Instant) -> Instant {
        after(now, 10_000)
    }

    fn state(&self) -> (Motion, i32) {
        critical_section::with(|token| match self.borrow(token).try_borrow() {
            Ok(motor) => motor.state(),
            Err(_) => (Motion::Fault(StepFault::InUse), 0),
        })
    }
}
