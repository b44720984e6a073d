//! A hobby servo on a PWM output.

use embedded_hal::pwm::SetDutyCycle;
use ztl_core::Instant;
use ztl_core::link::{Busy, GoalShape, Offer};

use super::expected::{begin_expected, put_range};
use super::number;
use super::power::Power;
use super::profile::{Limits, Profile, after_ticks, ticks_between};
use crate::component::{Component, Refused, Report, Run};
use crate::describe::{ComponentDescription, Describe, GoalRule};
use crate::description;
use crate::parameters::Tunable;

/// Logarithm of the number of parts in a millidegree.
const SHIFT: u32 = 14;
/// Parts of a degree.
const PARTS: i64 = 1000 << SHIFT;
/// Decimals of a goal: it is parsed in millidegrees.
const MILLI: u8 = 3;
/// Ticks that a late `poll` catches up at most, about 50 ms, so that the servo does not jump.
const MOST_TICKS: u64 = 50;

/// Settings of a servo. Start with [`DEFAULT`](Self::DEFAULT) and change what differs:
///
/// ```
/// use ztl_mcu::components::ServoConfig;
///
/// const PAN: ServoConfig = ServoConfig { range: (-90, 90), speed: 120, ..ServoConfig::DEFAULT };
/// ```
///
/// Invalid settings do not panic: a range or pulse beyond its bounds is limited to them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ServoConfig {
    /// Smallest and largest angle in degrees. Defaults to 0 and 180.
    pub range: (i16, i16),
    /// Pulse width at the smallest and at the largest angle, in µs; the first may be the longer one. Defaults to 1000
    /// and 2000, which is within the end stops of every servo.
    pub pulse_us: (u16, u16),
    /// Period of the PWM in µs, as the timer is configured. Defaults to 20,000, which is 50 Hz.
    pub period_us: u16,
    /// Maximum speed in degrees a second. Defaults to 60.
    pub speed: u16,
    /// Maximum acceleration in degrees a second squared. Defaults to 240.
    pub acceleration: u16,
    /// Presumed angle at power-on, in degrees: the first motion starts here. Defaults to the middle of the range.
    pub start: Option<i16>,
    /// What [`make_safe`](Component::make_safe) does, also to an idle servo: it keeps the pulse, so that the servo holds
    /// its position, or ends it, so that most servos let go. Defaults to hold.
    pub safe: Power,
    /// What happens to a task that arrives while one runs. By default it is refused.
    pub busy: Busy,
}

impl ServoConfig {
    /// 0 to 180 degrees by 1000 to 2000 µs at 50 Hz; 60 degrees a second.
    pub const DEFAULT: Self = Self {
        range: (0, 180),
        pulse_us: (1000, 2000),
        period_us: 20_000,
        speed: 60,
        acceleration: 240,
        start: None,
        safe: Power::Hold,
        busy: Busy::Refuse,
    };
}

impl Default for ServoConfig {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// A positional servo: its goals are angles in degrees.
///
/// It moves at limited speed and acceleration. Progress and result are the *commanded* angle with one decimal. A hobby
/// servo gives no feedback, so tasks complete even if it is blocked or unplugged. The first pulse makes it jump to
/// [`start`](ServoConfig::start), if it was elsewhere.
///
/// An abort decelerates and ends as ABORTED where the servo stops. An error of the PWM output ends the task as FAILED;
/// on the way to the safe state, the node tries again until the output works.
///
/// ```
/// use ztl_mcu::components::{Servo, ServoConfig};
/// # use embedded_hal::pwm::{ErrorType, SetDutyCycle};
/// # struct Pwm(u16);
/// # impl ErrorType for Pwm { type Error = core::convert::Infallible; }
/// # impl SetDutyCycle for Pwm {
/// #     fn max_duty_cycle(&self) -> u16 { 20_000 }
/// #     fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Self::Error> { self.0 = duty; Ok(()) }
/// # }
/// # let pwm = Pwm(0);
///
/// const PAN: ServoConfig = ServoConfig { range: (-90, 90), ..ServoConfig::DEFAULT };
/// // `pwm` is a channel of your chip's HAL, its timer set to 50 Hz.
/// let pan = Servo::new("pan", pwm, PAN);
/// ```
#[derive(Debug, Clone, Hash)]
pub struct Servo<P> {
    name: &'static str,
    pwm: P,
    config: ServoConfig,
    /// The range in the offer, as bits of `f32`.
    bounds: (u32, u32),
    pulse: Pulse,
    limits: Limits,
    profile: Profile,
    /// Time up to which the motion is computed.
    clock: Instant,
    /// In parts.
    goal: i64,
    /// Whether there is a pulse: from the first task until it is released.
    driven: bool,
    /// The last duty set; `None` if unknown, because it was never set or that failed.
    duty: Option<u16>,
}

impl<P: SetDutyCycle> Servo<P> {
    /// A servo with this name on this output, which is not changed before the first task.
    pub const fn new(name: &'static str, pwm: P, config: ServoConfig) -> Self {
        let (a, b) = config.range;
        let range = if a <= b { (a, b) } else { (b, a) };
        let config = ServoConfig { range, ..config };
        let start = parts(match config.start {
            Some(start) if start < range.0 => range.0,
            Some(start) if start > range.1 => range.1,
            Some(start) => start,
            None => i16::midpoint(range.0, range.1),
        });
        let speed = if config.speed == 0 { 1 } else { config.speed };
        Self {
            name,
            pwm,
            config,
            bounds: ((range.0 as f32).to_bits(), (range.1 as f32).to_bits()),
            pulse: Pulse::new(&config),
            limits: Limits::new(
                speed as u32 * 1000,
                config.acceleration as u32 * 1000,
                1 << SHIFT,
            ),
            profile: Profile::new(start),
            clock: Instant::ZERO,
            goal: start,
            driven: false,
            duty: None,
        }
    }

    /// The commanded angle in millidegrees.
    #[must_use]
    pub const fn commanded_millidegrees(&self) -> i32 {
        ((self.profile.position() + (1 << (SHIFT - 1))) >> SHIFT) as i32
    }

    fn parse(&self, goal: &str) -> Option<i32> {
        let (least, most) = self.config.range;
        let range = i32::from(least) * 1000..=i32::from(most) * 1000;
        number::parse(goal, MILLI).filter(|goal| range.contains(goal))
    }

    /// Computes the motion up to `now`.
    fn advance(&mut self, now: Instant) {
        let ticks = ticks_between(self.clock, now);
        for _ in 0..ticks.min(MOST_TICKS) {
            self.profile.advance(self.limits);
        }
        self.clock = if ticks > MOST_TICKS {
            now
        } else {
            after_ticks(self.clock, ticks)
        };
    }

    /// Sets the output to the commanded angle, if it changed.
    fn drive(&mut self) {
        let (least, _) = self.config.range;
        let above = i64::from(self.commanded_millidegrees() - i32::from(least) * 1000);
        let part = self.pulse.at_least + above * self.pulse.slope;
        let duty = (i64::from(self.pwm.max_duty_cycle()) * part + (1 << 31)) >> 32;
        // Fits, because the part is at most 1.
        let duty = duty as u16;
        if self.duty != Some(duty) {
            self.duty = self.pwm.set_duty_cycle(duty).ok().map(|()| duty);
        }
    }
}

impl<P> Tunable for Servo<P> {}

impl<P> Describe for Servo<P> {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("turns to an angle"),
        result: Some("the commanded angle"),
        ..ComponentDescription::new(GoalRule::NUMBER)
    });
}

impl<P: SetDutyCycle> Component for Servo<P> {
    fn offer(&self) -> Offer<'_> {
        let (least, most) = self.bounds;
        Offer {
            name: self.name,
            goal: GoalShape {
                range: Some((f32::from_bits(least), f32::from_bits(most))),
                unit: "degrees",
                words: "",
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
        put_range(why, least.into(), most.into(), "degrees");
        Err(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.check(goal, why)?;
        self.advance(now);
        self.clock = now;
        self.goal = i64::from(self.parse(goal).unwrap_or_default()) << SHIFT;
        self.profile.move_to(self.goal);
        self.driven = true;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.advance(now);
        if self.driven {
            self.drive();
        }
        if self.duty.is_none() && (self.driven || self.config.safe == Power::Release) {
            self.profile.put(self.profile.position());
            report.text("the PWM output failed");
            return Run::Failed;
        }
        let angle = number::rounded(self.commanded_millidegrees(), MILLI - 1);
        number::report(report, angle, 1);
        if !self.profile.is_at_rest() {
            Run::Running
        } else if self.profile.position() == self.goal {
            Run::Completed
        } else {
            Run::Aborted
        }
    }

    fn abort(&mut self, now: Instant) {
        self.advance(now);
        self.profile.move_to(self.profile.stopping_point());
    }

    fn make_safe(&mut self, now: Instant) {
        self.advance(now);
        self.profile.put(self.profile.position());
        // When holding, `poll` keeps the pulse.
        if self.config.safe == Power::Release {
            self.driven = false;
            self.duty = self.pwm.set_duty_cycle_fully_off().ok().map(|()| 0);
        }
    }
}

/// Pulse width as a fraction of the period, in units of 2^-32.
#[derive(Debug, Clone, Copy, Hash)]
struct Pulse {
    /// At the smallest angle.
    at_least: i64,
    /// Change per millidegree.
    slope: i64,
}

impl Pulse {
    const fn new(config: &ServoConfig) -> Self {
        let at_least = part_of(config.pulse_us.0, config.period_us);
        let at_most = part_of(config.pulse_us.1, config.period_us);
        let way = (config.range.1 as i64 - config.range.0 as i64) * 1000;
        let slope = if way == 0 {
            0
        } else {
            (at_most - at_least) / way
        };
        Self { at_least, slope }
    }
}

/// The fraction of the period, at most 1.
const fn part_of(pulse_us: u16, period_us: u16) -> i64 {
    if pulse_us >= period_us {
        return 1 << 32;
    }
    ((pulse_us as i64) << 32) / period_us as i64
}

const fn parts(degrees: i16) -> i64 {
    degrees as i64 * PARTS
}

#[cfg(test)]
mod tests;
