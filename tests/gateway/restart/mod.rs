//! The gateway is killed at any moment and restarted on its journal: each task has one id and one final state, and clients are
//! receive the true one.

mod device;
mod disk;
mod handler;
mod kills;
mod lab;
mod power;
mod reload;
mod stopped;
