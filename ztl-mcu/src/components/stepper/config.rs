//! The settings of a stepper.

use ztl_core::link::Busy;

use super::scale::Scale;
use crate::components::power::Power;

/// Settings of a stepper. Start with [`DEFAULT`](Self::DEFAULT) and change what differs:
///
/// ```
/// use ztl_mcu::components::{Scale, StepperConfig};
///
/// // A slide of 250 mm with 80 steps per mm.
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
    /// The unit of goals and its steps. Defaults to steps.
    pub scale: Scale,
    /// Smallest and largest goal, in whole units. Defaults to ±1,000,000.
    pub range: (i32, i32),
    /// Maximum speed in steps a second, up to 200,000 (see [how fast it can go](super::Stepper#how-fast-it-can-go)).
    /// Defaults to 1000.
    pub speed: u32,
    /// Maximum acceleration in steps a second squared. Defaults to 2000.
    pub acceleration: u32,
    /// Speed to the home switch in steps a second, at most `speed`. Defaults to 200.
    pub home_speed: u32,
    /// Whether every other goal is refused until the axis was homed. Defaults to `false`.
    pub home_first: bool,
    /// Minimum width of a step pulse and of the pause after it, in µs. Defaults to 2, for the DRV8825 and faster chips.
    pub pulse_us: u8,
    /// Time from setting the direction to the next step, in µs. Defaults to 5.
    pub direction_us: u8,
    /// Time from enabling the driver to the first step, in µs. Defaults to 1000.
    pub enable_us: u16,
    /// Whether a high enable pin switches the power on. Defaults to `false`, as common drivers need.
    pub enable_high: bool,
    /// Whether a high direction pin means backwards. Defaults to `false`.
    pub reverse: bool,
    /// Whether the motor keeps its power after a task. Defaults to hold.
    pub at_rest: Power,
    /// What [`make_safe`](crate::Component::make_safe) does after it has stopped at once, also to an idle motor. A step
    /// pulse that has begun is ended with its full width. Defaults to hold; a motor without power stays without.
    pub safe: Power,
    /// What happens to a task that arrives while one runs. By default it is refused.
    pub busy: Busy,
}

impl StepperConfig {
    /// A common driver at 1000 steps a second.
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
