//! The model: the real state machines, and all that can happen between them.
//!
//! Compiled twice (see [`crate::real`] and [`crate::broken`]), over the ends that stand in `ends`
//! beside it.

mod gateway;
mod happen;
mod judge;
mod lab;
mod line;
mod motor;
mod scenarios;
mod words;

use super::ends;

pub use lab::Lab;
pub use line::Way;
pub use motor::Kind;
pub use scenarios::SCENARIOS;
pub use words::{Act, Action, Fault, Scenario};
