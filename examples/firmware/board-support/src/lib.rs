//! Support for boards without a HAL: registers, a clock, a boot counter, the vector table; for boards in QEMU also
//! simulated pins.
#![no_std]

pub mod board;
pub mod boots;
#[cfg(target_arch = "arm")]
pub mod clock;
#[cfg(target_arch = "arm")]
mod handlers;
pub mod lamp;
#[cfg(target_arch = "arm")]
mod memory;
pub mod panel;
mod register;
#[cfg(target_arch = "arm")]
mod vectors;

pub use register::Register;
#[cfg(target_arch = "arm")]
pub use vectors::unexpected;
