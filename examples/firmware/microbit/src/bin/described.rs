//! `microbit-quiet` with components that say what they are, for what that weighs.
#![no_std]
#![no_main]

#[path = "../robot.rs"]
mod robot;

use board_support::board::run_described as run;
