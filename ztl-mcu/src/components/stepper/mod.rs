//! A stepper motor on a driver with step and direction inputs.

mod generator;
mod limit;
mod motor;
mod scale;

pub use limit::{Limit, LimitFlag, NoLimit, Switch};
pub use motor::{Command, Motion, NoPin, StepDrive, StepFault, StepMotor};
pub use scale::Scale;

use ztl_core::Instant;
use ztl_core::link::{Busy, GoalShape, Offer};

use super::{Power, number, range, takes};
use crate::component::{Component, Refused, Report, Run};

/// What a stepper is and may do. Take [`DEFAULT`](Self::DEFAULT) and change what differs:
///
/// ```
/// use ztl_mcu::components::{Scale, StepperConfig};
///
/// // A slide of 250 mm, 80 steps to each.
/// const SLIDE: StepperConfig = StepperConfig {
///     scale: Scale::new(80, 1, "mm"),
///     range: (0, 250),
///     speed: 4000,
///     acceleration: 8000,
///     ..StepperConfig::DEFAULT
/// };
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StepperConfig {
    /// The unit of goals, and how many steps there are to it. Default: steps.
    pub scale: Scale,
    /// Least and greatest goal, in whole units. Default ±1,000,000.
    pub range: (i32, i32),
    /// Greatest speed in steps a second, up to 200,000 (and what the calls suffice for). Default 1000.
    pub speed: u32,
    /// Greatest acceleration in steps a second squared. Default 2000.
    pub acceleration: u32,
    /// Speed to the home switch in steps a second, at most `speed`. Default 200.
    pub home_speed: u32,
    /// Whether any other goal is refused until the axis has been home. Default: no.
    pub home_first: bool,
    /// Least width of a step pulse, and of the pause after it, in µs. Default 2: DRV8825 and faster.
    pub pulse_us: u8,
    /// Time from setting the direction to the next step, in µs. Default 5.
    pub direction_us: u8,
    /// Time from enabling the driver to the first step, in µs. Default 1000.
    pub enable_us: u16,
    /// Whether a high enable pin gives power. Default: a low one does, as with all usual drivers.
    pub enable_high: bool,
    /// Whether a high direction pin is backwards. Default: forwards.
    pub reverse: bool,
    /// Whether it stays under power after a task. Default: it holds.
    pub at_rest: Power,
    /// What [`make_safe`](Component::make_safe) does after it has stopped at once, also to a motor at rest, when the
    /// link is lost. Default: it holds, or stays without power if it had none.
    pub safe: Power,
    /// What happens to a task that comes while one runs. Default: it is refused.
    pub busy: Busy,
}

impl StepperConfig {
    /// A driver as they are usual, 1000 steps a second.
    pub const DEFAULT: Self = Self {
        scale: Scale::STEPS,
        range: (-1_000_000, 1_000_000),
        speed: 1000,
        acceleration: 2000,
        home_speed: 200,
        home_first: false,
        pulse_us: 2,
        direction_us: 5,
        enable_us: 1000,
        enable_high: false,
        reverse: false,
        at_rest: Power::Hold,
        safe: Power::Hold,
        busy: Busy::Refuse,
    };
}

impl Default for StepperConfig {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// A stepper motor: its goals are absolute positions in steps or a unit of one's choice, and `home`
/// when it has a switch at its low end.
///
/// Progress and result are the position that the steps made so far amount to: the truth, unless the
/// motor has lost steps, which nobody notices. Power on is position 0; after a stop at once
/// (`make_safe`, a limit) at high speed a `home` is wise.
///
/// - `home` moves down at the homing speed until the switch is reached, which is 0 from then on:
///   COMPLETED. Without the switch within the range's length and an eighth: FAILED.
/// - A limit that is reached otherwise stops the motor at once: FAILED, `limit switch at 1200 steps`.
///   From there it may move away.
/// - An abort slows down by the ramp: ABORTED, where it stopped.
/// - An error of a pin: FAILED, with which.
///
/// # How fast it can go
///
/// Each call of `poll` sets one pin at most, so a step takes two calls, and no step is made by waiting. A
/// call that is late delays the motion. Nothing is made up for: no step ever comes sooner after the
/// last one than at the speed limit. So the rate is at most half that of the calls, and
/// intervals are rounded up to when a call is made: a main loop that turns each 100 µs makes 5000 steps
/// a second at most. Mind what else the loop does, as a write to a slow serial port. A step
/// that is late by more than the time between two slows the motor down, and it speeds up again by the ramp,
/// so that one long turn does not throw it out of step.
///
/// For more, or for evenness, let a timer's interrupt make the steps: put the [`StepMotor`] behind a
/// `critical_section::Mutex`, call [`StepMotor::tick`] in the interrupt (each 25 µs: 20,000 steps a second;
/// or a timer set to the time that it returns), and give the component a reference to the mutex.
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
/// // With the types of your chip's HAL. Where pins cannot be made in a `static`, use a `StaticCell`.
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
    /// The range's ends as the offer has them, in the bits of an `f32`.
    bounds: (u32, u32),
    /// The same as goals are read.
    within: (i32, i32),
    /// How far home can be, in steps.
    way_home: i32,
    homing: bool,
    homed: bool,
    /// Stopped at once, until the next task.
    halted: bool,
    /// In steps.
    goal: i32,
    /// When the motor wants to be called.
    wake: Instant,
}

impl<M: StepDrive> Stepper<M> {
    /// A stepper of this name with a motor of its own, or one that an interrupt drives. The motor was
    /// made with the same configuration.
    #[inline(always)] // With a constant configuration there is nothing to compute.
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

    /// The task is over.
    fn rest(&mut self, now: Instant, run: Run) -> Run {
        if self.config.at_rest == Power::Release {
            self.motor.command(now, Command::Release);
        }
        run
    }
}

#[derive(Debug, Clone, Copy)]
enum Goal {
    Home,
    Steps(i32),
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
        takes(why, self.name);
        range(why, least, most, self.config.scale.unit());
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
        self.motor.command(now, Command::MoveTo { steps, homing });
        self.wake = now;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.wake = self.motor.drive(now);
        let (motion, steps) = self.motor.state();
        let run = match motion {
            Motion::Moving => {
                self.report_position(report, steps);
                return Run::Running;
            }
            Motion::Fault(fault) => {
                report.text(fault.text());
                Run::Failed
            }
            // Its power is as it was made safe.
            _ if self.halted => {
                self.report_position(report, steps);
                return Run::Aborted;
            }
            Motion::Limit if self.homing => {
                self.motor.command(now, Command::Set { steps: 0 });
                self.homed = true;
                self.report_position(report, 0);
                Run::Completed
            }
            Motion::Limit => {
                report.text("limit switch at ");
                self.report_position(report, steps);
                report.text(" ");
                report.text(self.config.scale.unit());
                Run::Failed
            }
            Motion::Rest if steps != self.goal => {
                self.report_position(report, steps);
                Run::Aborted
            }
            Motion::Rest if self.homing => {
                report.text("the home switch was not reached");
                Run::Failed
            }
            Motion::Rest => {
                self.report_position(report, steps);
                Run::Completed
            }
        };
        self.rest(now, run)
    }

    fn abort(&mut self, now: Instant) {
        self.motor.command(now, Command::Stop);
        self.wake = now;
    }

    fn make_safe(&mut self, now: Instant) {
        self.motor.command(now, Command::Halt);
        self.halted = true;
        self.wake = now;
        if self.config.safe == Power::Release {
            self.motor.command(now, Command::Release);
        }
    }

    fn poll_timeout(&self, _now: Instant) -> Instant {
        self.wake
    }
}

#[cfg(test)]
mod tests;
