//! The same robot, built without a log (`--no-default-features`), for what it weighs.
#![no_std]
#![no_main]

#[path = "../robot.rs"]
mod robot;

use board_support::board::run;
