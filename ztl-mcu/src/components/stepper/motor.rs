//! A motor and the pins of its driver chip.

use core::cell::RefCell;
use core::convert::Infallible;

use critical_section::Mutex;
use embedded_hal::digital::{ErrorType, OutputPin, PinState};
use ztl_core::Instant;

use super::config::StepperConfig;
use super::fault::StepFault;
use super::generator::{Due, Generator, PARTS, Timing};
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

/// The state of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Motion {
    /// The motor moves.
    Moving,
    /// The motor rests: it reached the target or was stopped.
    Rest,
    /// A limit switch stopped it.
    Limit,
    /// A pin failed, and the motor was stopped.
    Fault(StepFault),
}

/// A command of [`Stepper`](super::Stepper) to its motor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum MotorCommand {
    /// Switch the power on and move to this step.
    MoveTo {
        /// The target.
        steps: i32,
        /// Whether to move at the homing speed.
        homing: bool,
    },
    /// Decelerate and stop.
    Stop,
    /// Stop at once, also after a fault.
    Halt,
    /// Declare the current position to be this step.
    Set {
        /// The position.
        steps: i32,
    },
    /// Switch the power off.
    Release,
}

/// A motor of a [`Stepper`](super::Stepper): a [`StepMotor`], or one behind a `critical_section::Mutex` that an interrupt
/// drives.
pub trait StepDrive {
    /// Whether it has a home switch.
    const HOME: bool;

    /// Executes a command.
    fn command(&mut self, now: Instant, command: MotorCommand);

    /// Advances the motion, unless an interrupt does. Returns when to call it next.
    fn drive(&mut self, now: Instant) -> Instant;

    /// The state of the last motion, and the position in steps.
    fn state(&self) -> (Motion, i32);
}

/// A driver chip with step and direction inputs (A4988, DRV8825, TMC2209, ...).
///
/// [`tick`](Self::tick) makes the steps. The main loop calls it through the component, or a timer's interrupt does; see
/// [`Stepper`](super::Stepper).
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
    /// A motor at rest at step 0. The pins are not changed; the step pin must be low.
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
    /// Adds an enable pin. The first motion sets its level for the first time.
    pub fn with_enable<P: OutputPin>(self, enable: P) -> StepMotor<S, D, P, L, H> {
        self.with(|_| enable, |low| low, |high| high)
    }

    /// Adds a switch at the low end, to which `home` moves.
    pub fn with_low_limit<T: Limit>(self, limit: T) -> StepMotor<S, D, E, T, H> {
        self.with(|enable| enable, |_| limit, |high| high)
    }

    /// Adds a switch at the high end.
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
    /// Sets one pin, if one is due, and returns when to call it next. A call that comes too early costs one
    /// comparison. A late call takes no longer than others, but the next one may be due at once.
    pub fn tick(&mut self, now: Instant) -> Instant {
        let due = self.generator.due(now);
        self.make(now, due)
    }

    /// Makes the change that is due, if there is one, and returns when to call it next.
    fn make(&mut self, now: Instant, due: Option<Due>) -> Instant {
        if let Some(due) = due {
            match self.act(due) {
                Ok(true) => self.generator.done(now, due),
                Ok(false) => self.end(Motion::Limit),
                Err(fault) => self.end(Motion::Fault(fault)),
            }
        }
        self.generator.wake()
    }

    /// Changes a pin. Returns `false` if a limit switch forbids the step.
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
        let level = PinState::from(on == self.enable_high);
        let set = self.enable.set_state(level);
        // After an error the level is unknown, so the next motion waits for the power.
        self.powered = on && set.is_ok();
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

    fn command(&mut self, now: Instant, command: MotorCommand) {
        match command {
            MotorCommand::MoveTo { steps, homing } => {
                self.ended = Motion::Rest;
                let lead = if self.powered { 0 } else { self.enable_us };
                if let Err(fault) = self.power(true) {
                    return self.end(Motion::Fault(fault));
                }
                let limits = if homing { self.homing } else { self.limits };
                self.generator
                    .move_to(now.after(lead.into()), steps, limits);
            }
            MotorCommand::Stop => self.generator.stop(),
            // A fault is over: its pin may work again.
            MotorCommand::Halt => self.end(Motion::Rest),
            MotorCommand::Set { steps } => self.generator.put(steps),
            MotorCommand::Release => {
                if let Err(fault) = self.power(false) {
                    self.end(Motion::Fault(fault));
                }
            }
        }
    }

    fn drive(&mut self, now: Instant) -> Instant {
        let due = self.generator.due_caught_up(now);
        self.make(now, due)
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

/// A motor whose interrupt calls [`StepMotor::tick`]; the component only sends commands.
impl<M: StepDrive> StepDrive for &Mutex<RefCell<M>> {
    const HOME: bool = M::HOME;

    fn command(&mut self, now: Instant, command: MotorCommand) {
        critical_section::with(|token| {
            // Always free: nothing else runs in a critical section.
            if let Ok(mut motor) = self.borrow(token).try_borrow_mut() {
                motor.command(now, command);
            }
        });
    }

    fn drive(&mut self, now: Instant) -> Instant {
        now.after(10_000)
    }

    fn state(&self) -> (Motion, i32) {
        critical_section::with(|token| match self.borrow(token).try_borrow() {
            Ok(motor) => motor.state(),
            Err(_) => (Motion::Fault(StepFault::InUse), 0),
        })
    }
}
