//! The player: decides what a script does next.
//!
//! No step starts before every task that the last one waited for has ended, as told by its server. An
//! unknown outcome is never taken for success: while a server is silent or has forgotten a task, the step
//! waits, says so, and the operator decides. An INIT is never sent again without a decision.

mod answers;
mod commands;
mod cues;
mod input;
mod probe;
mod requests;
mod state;
mod step_end;
mod steps;
mod stop;
mod tasks;

pub use state::PlayOptions;
pub(crate) use state::{Player, Request};

#[cfg(test)]
mod tests;
