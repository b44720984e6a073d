//! Ready [`Component`](crate::Component)s for `embedded-hal` 1.0: create them with the pins of your board and their
//! limits. Requires the feature `components`.
//!
//! | | on | goals | when the link is lost, with or without a task |
//! |---|---|---|---|
//! | [`Servo`] | a PWM channel | an angle: `45.5` | holds, or lets go |
//! | [`Stepper`] | step and direction pins, perhaps enable and limit switches | a position: `1200`; `home` | stops at once; holds, or lets go |
//! | [`DigitalOutput`] | an output pin | `on`, `off`, `pulse 200` | goes off, on, or stays |
//! | [`DigitalInput`] | an input pin | `pressed`, `released`: wait for it | |
//!
//! Motions follow a trapezoid within limits of speed and acceleration. They are computed from the time passed to each
//! call, in integers: no timer, no float, no allocation. A late call delays the motion a little and never makes it
//! faster.
//!
//! A main loop for a board such as the Pico. `board` stands for your chip's HAL: pins that implement the
//! `embedded-hal` traits, and a serial port that implements those of `embedded-io`.
//!
//! ```
//! use ztl_mcu::components::{
//!     DigitalOutput, DigitalOutputConfig, Scale, Servo, ServoConfig, StepMotor, Stepper,
//!     StepperConfig, Switch,
//! };
//! use ztl_mcu::{Identity, Node};
//! # mod board {
//! #     use core::convert::Infallible;
//! #     use embedded_hal::{digital, pwm};
//! #     pub struct Pin;
//! #     impl digital::ErrorType for Pin { type Error = Infallible; }
//! #     impl digital::OutputPin for Pin {
//! #         fn set_low(&mut self) -> Result<(), Infallible> { Ok(()) }
//! #         fn set_high(&mut self) -> Result<(), Infallible> { Ok(()) }
//! #     }
//! #     impl digital::InputPin for Pin {
//! #         fn is_high(&mut self) -> Result<bool, Infallible> { Ok(true) }
//! #         fn is_low(&mut self) -> Result<bool, Infallible> { Ok(false) }
//! #     }
//! #     impl pwm::ErrorType for Pin { type Error = Infallible; }
//! #     impl pwm::SetDutyCycle for Pin {
//! #         fn max_duty_cycle(&self) -> u16 { 62_500 }
//! #         fn set_duty_cycle(&mut self, _: u16) -> Result<(), Infallible> { Ok(()) }
//! #     }
//! #     pub struct Board {
//! #         pub pwm_50_hz: Pin, pub step: Pin, pub direction: Pin, pub enable: Pin,
//! #         pub end_switch: Pin, pub led: Pin, pub serial: Serial,
//! #     }
//! #     pub fn init() -> Board {
//! #         Board {
//! #             pwm_50_hz: Pin, step: Pin, direction: Pin, enable: Pin, end_switch: Pin, led: Pin,
//! #             serial: Serial(0),
//! #         }
//! #     }
//! #     pub struct Serial(pub usize);
//! #     impl Serial {
//! #         pub fn read(&mut self, _: &mut [u8]) -> usize { self.0 += 1; 0 }
//! #         pub fn write(&mut self, bytes: &[u8]) {}
//! #     }
//! #     pub fn now() -> ztl_mcu::Instant { ztl_mcu::Instant::from_micros(0) }
//! #     pub fn boot_count() -> u32 { 1 }
//! # }
//!
//! const PAN: ServoConfig = ServoConfig { range: (-90, 90), ..ServoConfig::DEFAULT };
//! const SLIDE: StepperConfig = StepperConfig {
//!     scale: Scale::new(80, 1, "mm"),
//!     range: (0, 250),
//!     speed: 2000,
//!     ..StepperConfig::DEFAULT
//! };
//!
//! # fn main() {
//! let board = board::init();
//! let slide = StepMotor::new(board.step, board.direction, &SLIDE)
//!     .with_enable(board.enable)
//!     .with_low_limit(Switch::active_low(board.end_switch));
//! let components = (
//!     Servo::new("pan", board.pwm_50_hz, PAN),
//!     Stepper::new("slide", slide, SLIDE),
//!     DigitalOutput::new("lamp", board.led, DigitalOutputConfig::DEFAULT),
//! );
//! let identity = Identity::new("desk", "1.0.0", board::boot_count());
//! let mut node = Node::<_, 4, 128>::new(identity, components);
//!
//! let mut serial = board.serial;
//! let mut buffer = [0; 32];
//! loop {
//!     let now = board::now();
//!     // Read the available bytes, without waiting.
//!     let count = serial.read(&mut buffer);
//!     node.handle_bytes(now, &buffer[..count]);
//!     // A stepper needs frequent calls; see its documentation.
//!     node.handle_timeout(now);
//!     let count = node.poll_transmit(now, &mut buffer);
//!     serial.write(&buffer[..count]);
//! #   if serial.0 > 100 { break }
//! }
//! # }
//! ```
//!
//! Then `ztl task-client … desk:slide:home`, `desk:slide:120.5`, `desk:lamp:'pulse 500'`. With
//! [`Described(components)`](crate::describe::Described), `ztl describe` shows what they do and which goals they take.

mod expected;
mod input;
pub mod number;
mod output;
mod power;
mod profile;
mod servo;
mod stepper;

pub use input::{DigitalInput, DigitalInputConfig};
pub use output::{DigitalOutput, DigitalOutputConfig, SafeOutput};
pub use power::Power;
pub use servo::{Servo, ServoConfig};
pub use stepper::{
    Limit, LimitFlag, Motion, MotorCommand, NoLimit, NoPin, Scale, StepDrive, StepFault, StepMotor,
    Stepper, StepperConfig, Switch,
};

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
