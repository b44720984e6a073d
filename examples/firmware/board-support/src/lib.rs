//! What boards without a HAL have in common: registers, a clock; and for those in QEMU pins that a test can
//! press and see.
#![no_std]

pub mod board;
pub mod boots;
#[cfg(target_arch = "arm")]
pub mod clock;
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
