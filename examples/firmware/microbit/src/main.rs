//! The desk robot on a BBC micro:bit: nRF51822, Cortex-M0, 16 MHz.
//!
//! `cargo xtask qemu microbit` runs it in QEMU. Its pins are those of the panel, for a test to press
//! and see.
#![no_std]
#![no_main]

mod robot;
