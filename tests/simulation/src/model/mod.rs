//! The model: the real state machines, and all that can happen between them.
//!
//! Compiled twice (see [`crate::real`] and [`crate::broken`]), over the ends that stand in `ends`
//! beside it.

mod gateway;
mod lab;
mod line;
mod motor;
mod scenarios;

use super::ends;

pub use lab::{Act, Action, Fault, Lab, Scenario};
pub use line::Way;
pub use motor::Kind;
pub use scenarios::SCENARIOS;
