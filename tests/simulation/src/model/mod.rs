//! The model: the real state machines, and every sequence of events between them.
//!
//! Compiled twice, with the two modules named `ends` in [`crate::real`] and [`crate::broken`].

mod bus;
mod bus_scenarios;
mod gateway;
mod happen;
mod judge;
mod line;
mod link;
mod motor;
mod node;
mod own;
mod parameters;
mod scenarios;
mod words;

use super::ends;

pub use bus::BusModel;
pub use bus_scenarios::{BUS_SCENARIOS, BusAction, BusFault, BusScenario};
pub use line::Way;
pub use link::LinkModel;
pub use motor::Kind;
pub use scenarios::SCENARIOS;
pub use words::{Act, Action, Fault, Scenario};
