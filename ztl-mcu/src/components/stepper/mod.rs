//! A stepper motor on a driver with step and direction inputs.

mod config;
mod fault;
mod generator;
mod limit;
mod motor;
mod scale;

pub use config::StepperConfig;
pub use fault::StepFault;
pub use limit::{Limit, LimitFlag, NoLimit, Switch};
pub use motor::{Motion, MotorCommand, NoPin, StepDrive, StepMotor};
pub use scale::Scale;

use ztl_core::Instant;
use ztl_core::link::{GoalShape, Offer};

use super::expected::{begin_expected, put_range};
use super::number;
use super::power::Power;
use crate::component::{Component, Refused, Report, Run};
use crate::describe::{ComponentDescription, Describe, GoalRule};
use crate::description;
use crate::parameters::Tunable;

/// A stepper motor. Its goals are absolute positions in steps or another unit, and `home` if it has a switch at its low
/// end.
///
/// Progress and result are the position counted in steps. The count is wrong if the motor loses steps, which it cannot
/// detect. The position at power-on is 0. Home the axis after an immediate stop at high speed (`make_safe`, a limit).
///
/// - `home` moves down at the homing speed until the switch is reached, whose position becomes 0: COMPLETED. If the switch
///   is not reached within the length of the range and an eighth: FAILED.
/// - Any other limit stops the motor at once: FAILED, `limit switch at 1200 steps`. The motor can move away from it.
/// - An abort decelerates: ABORTED, where the motor stops.
/// - An error of a pin: FAILED, with the name of the pin, also if the power cannot be switched off after the motion
///   ([`at_rest`](StepperConfig::at_rest)). On the way to the safe state, the node tries again until the pin works.
///
/// # How fast it can go
///
/// Each call of `poll` sets at most one pin, so a step takes two calls; `poll` never waits. A late call delays the motion,
/// and no later step comes sooner to compensate. The step rate is therefore at most half the rate of the calls, and
/// intervals are rounded up to the next call: a main loop with a period of 100 µs makes at most 5000 steps a second.
/// Consider what else the loop does, such as writing to a slow serial port. If a step is late by more than the interval,
/// the motor slows down and accelerates again, so that one long turn of the loop does not lose steps.
///
/// For higher or more even rates, let a timer's interrupt make the steps: put the [`StepMotor`] behind a
/// `critical_section::Mutex`, call [`StepMotor::tick`] in the interrupt (every 25 µs for 19,500 steps a second, or at the
/// time that it returns; at least every millisecond), and pass the component a reference to the mutex.
///
/// ```
/// use core::cell::RefCell;
/// use critical_section::Mutex;
/// use ztl_mcu::Instant;
/// use ztl_mcu::components::{NoPin, StepMotor, Stepper, StepperConfig};
/// # type StepPin = NoPin; type DirectionPin = NoPin;
/// # const STEP: NoPin = NoPin; const DIRECTION: NoPin = NoPin;
///
/// const CONFIG: StepperConfig = StepperConfig { speed: 10_000, ..StepperConfig::DEFAULT };
/// // With the types of your chip's HAL. If pins cannot be created in a `static`, use a `StaticCell`.
/// static MOTOR: Mutex<RefCell<StepMotor<StepPin, DirectionPin>>> =
///     Mutex::new(RefCell::new(StepMotor::new(STEP, DIRECTION, &CONFIG)));
///
/// /// The timer's interrupt.
/// fn on_timer(now: Instant) {
///     critical_section::with(|token| MOTOR.borrow(token).borrow_mut().tick(now));
/// }
///
/// let base = Stepper::new("base", &MOTOR, CONFIG);
/// # on_timer(Instant::ZERO);
/// ```
#[derive(Debug, Clone, Hash)]
pub struct Stepper<M> {
    name: &'static str,
    motor: M,
    config: StepperConfig,
    /// The range in the offer, as bits of `f32`.
    bounds: (u32, u32),
    /// The range as parsed goals.
    within: (i32, i32),
    /// Maximum distance to the home switch, in steps.
    way_home: i32,
    homing: bool,
    homed: bool,
    /// Whether it was made safe since the last task.
    halted: bool,
    /// In steps.
    goal: i32,
    /// When to call the motor next.
    wake: Instant,
}

impl<M: StepDrive> Stepper<M> {
    /// A stepper with this name and its own motor, or one that an interrupt drives. Both use the same settings.
    pub const fn new(name: &'static str, motor: M, config: StepperConfig) -> Self {
        let (a, b) = config.range;
        let range = if a <= b { (a, b) } else { (b, a) };
        let scale = config.scale;
        let within = (scale.whole(range.0), scale.whole(range.1));
        let length = scale
            .to_steps(within.1)
            .saturating_sub(scale.to_steps(within.0));
        Self {
            name,
            motor,
            config: StepperConfig { range, ..config },
            bounds: ((range.0 as f32).to_bits(), (range.1 as f32).to_bits()),
            within,
            way_home: length.saturating_add(length / 8),
            homing: false,
            homed: false,
            halted: false,
            goal: 0,
            wake: Instant::ZERO,
        }
    }

    /// The position in steps.
    #[must_use]
    pub fn steps(&self) -> i32 {
        self.motor.state().1
    }

    fn parse(&self, goal: &str) -> Option<Goal> {
        if M::HOME && goal.trim_ascii() == "home" {
            return Some(Goal::Home);
        }
        let scale = &self.config.scale;
        let (least, most) = self.within;
        number::parse(goal, scale.decimals())
            .filter(|goal| (least..=most).contains(goal))
            .map(|goal| Goal::Steps(scale.to_steps(goal)))
    }

    fn report_position(&self, report: &mut Report<'_>, steps: i32) {
        self.config.scale.report(report, steps);
    }

    /// Ends a task whose motion ended like this. Returns the motion and the position of the motor then: a motor that
    /// cannot be released has a fault, too. The first fault counts.
    fn end(&mut self, now: Instant, motion: Motion) -> (Motion, i32) {
        // `make_safe` has set the power.
        if self.halted {
            return self.motor.state();
        }
        if self.homing && motion == Motion::Limit {
            self.motor.command(now, MotorCommand::Set { steps: 0 });
            self.homed = true;
        }
        if self.config.at_rest == Power::Release {
            self.motor.command(now, MotorCommand::Release);
        }
        let (after, steps) = self.motor.state();
        match motion {
            Motion::Fault(_) => (motion, steps),
            _ => (after, steps),
        }
    }
}

#[derive(Debug, Clone, Copy)]
enum Goal {
    Home,
    Steps(i32),
}

impl<M: StepDrive> Tunable for Stepper<M> {}

impl<M: StepDrive> Describe for Stepper<M> {
    // No rule covers both numbers and `home`.
    const DESCRIPTION: &'static str = if M::HOME {
        description!(ComponentDescription {
            about: Some("moves to a position; home finds its zero"),
            result: Some("the position"),
            examples: &["home"],
            ..ComponentDescription::new(GoalRule::Any)
        })
    } else {
        description!(ComponentDescription {
            about: Some("moves to a position"),
            result: Some("the position"),
            ..ComponentDescription::new(GoalRule::NUMBER)
        })
    };
}

impl<M: StepDrive> Component for Stepper<M> {
    fn offer(&self) -> Offer<'_> {
        let (least, most) = self.bounds;
        Offer {
            name: self.name,
            goal: GoalShape {
                range: Some((f32::from_bits(least), f32::from_bits(most))),
                unit: self.config.scale.unit(),
                words: if M::HOME { "home" } else { "" },
            },
            busy: self.config.busy,
            loss: self.config.safe.loss(),
            topics: "",
        }
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if self.parse(goal).is_some() {
            return Ok(());
        }
        let (least, most) = self.config.range;
        begin_expected(why, self.name);
        put_range(why, least, most, self.config.scale.unit());
        if M::HOME {
            why.text(", or home");
        }
        Err(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.check(goal, why)?;
        let (steps, homing) = match self.parse(goal) {
            Some(Goal::Steps(_)) if M::HOME && self.config.home_first && !self.homed => {
                why.text("its position is not known yet; home first");
                return Err(Refused);
            }
            Some(Goal::Steps(steps)) => (steps, false),
            Some(Goal::Home) | None => (self.steps().saturating_sub(self.way_home), true),
        };
        self.goal = steps;
        self.homing = homing;
        self.homed &= !homing;
        self.halted = false;
        self.motor
            .command(now, MotorCommand::MoveTo { steps, homing });
        self.wake = now;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.wake = self.motor.drive(now);
        let (motion, steps) = self.motor.state();
        if motion == Motion::Moving {
            self.report_position(report, steps);
            return Run::Running;
        }
        let (motion, steps) = self.end(now, motion);
        match motion {
            Motion::Fault(fault) => {
                report.text(fault.text());
                Run::Failed
            }
            _ if self.halted => {
                self.report_position(report, steps);
                Run::Aborted
            }
            Motion::Limit if self.homing => {
                self.report_position(report, steps);
                Run::Completed
            }
            Motion::Limit => {
                report.text("limit switch at ");
                self.report_position(report, steps);
                report.text(" ");
                report.text(self.config.scale.unit());
                Run::Failed
            }
            _ if steps != self.goal => {
                self.report_position(report, steps);
                Run::Aborted
            }
            _ if self.homing => {
                report.text("the home switch was not reached");
                Run::Failed
            }
            _ => {
                self.report_position(report, steps);
                Run::Completed
            }
        }
    }

    fn abort(&mut self, now: Instant) {
        self.motor.command(now, MotorCommand::Stop);
        self.wake = now;
    }

    fn make_safe(&mut self, now: Instant) {
        self.motor.command(now, MotorCommand::Halt);
        self.halted = true;
        self.wake = now;
        if self.config.safe == Power::Release {
            self.motor.command(now, MotorCommand::Release);
        }
    }

    fn poll_timeout(&self, _now: Instant) -> Instant {
        self.wake
    }
}

#[cfg(test)]
mod tests;
