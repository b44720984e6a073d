//! The desk robot on a BBC micro:bit: nRF51822, Cortex-M0, 16 MHz.
//!
//! `cargo xtask qemu microbit` runs it in QEMU. Its pins are the simulated ones of the panel, which
//! tests read and write.
#![no_std]
#![no_main]

mod robot;

use board_support::board::run;
