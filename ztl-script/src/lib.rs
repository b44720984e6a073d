//! Scripts: scenes of steps of tasks in YAML, written by people who do not program.
//!
//! - [`Script`] reads a script and reports mistakes and doubts; [`Script::check_live`] asks its servers, and
//!   [`Script::check_described`] reads what they said before.
//! - [`Runner`] plays a script on servers, which it reaches only through [`server::Connection`]. What is done
//!   next is decided by its player, a state machine without I/O.
//! - [`event`]: everything that happens in a run. [`record`] writes events to a file and reads them back;
//!   [`report`] makes a page and tables of them.
//! - [`board`]: the state of a run as views show it.
//! - [`drawing`] draws timelines, also for other crates.
//! - [`timeline`] shows what would be sent when.

pub mod board;
pub mod drawing;
mod dry_run;
mod durations;
pub mod event;
mod finding;
mod live_check;
mod millis;
mod model;
mod player;
mod read;
pub mod record;
pub mod report;
mod runner;
mod script;
pub mod server;

pub use dry_run::timeline;
pub use finding::Finding;
pub use live_check::{ConnectShared, ServerCheck, check_servers};
pub use model::{Cue, Defaults, Handler, OnFailure, OperatorGone, Scene, Step, Task};
pub use player::PlayOptions;
pub use read::read_value;
pub use runner::{Connect, Runner, RunnerHandle, SeenStops};
pub use script::Script;

#[cfg(test)]
mod tests;
