//! The gateway is killed at any moment and restarted on its journal: each task has one id and one final state, and clients receive
//! the true one.

mod boards;
pub(crate) mod device;
mod disk;
mod handler;
mod kills;
mod power;
mod reload;
mod rig;
mod stopped;
