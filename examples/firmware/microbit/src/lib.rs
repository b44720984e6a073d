//! The nRF51822 of a BBC micro:bit.
#![no_std]

pub mod random;
pub mod uart;
