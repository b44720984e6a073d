#![doc = include_str!("../../README.md")]
//!
//! What crosses crates; the page above is the README, whose examples are compiled and run here.

pub mod garbage;
mod inert;
pub mod lab;
