//! Scripts: scenes of steps of tasks, as people write them who do not program.

mod ask;
pub mod event;
mod finding;
mod model;
mod params;
mod plan;
pub mod player;
mod read;
pub mod record;
pub mod report;
mod show;
mod stand_ins;

pub use ask::{Said, ask_all};
pub use finding::Finding;
pub use model::{Defaults, Handler, OnFailure, Scene, Script, Step, Task};
pub use plan::timeline;
pub use player::Player;
pub use read::read_value;
pub use show::{Connect, Inputs, Show};
pub use stand_ins::StandIns;

#[cfg(test)]
mod tests;
