//! The nRF51822 of a BBC micro:bit.
#![no_std]

#[cfg(any(feature = "boot", feature = "flash"))]
pub mod flash;
pub mod random;
pub mod uart;
#[cfg(feature = "boot")]
pub mod watchdog;
