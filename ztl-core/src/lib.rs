#![doc = include_str!("../README.md")]
#![no_std]

#[cfg(test)]
extern crate std;

pub mod base64;
pub mod client;
#[cfg(feature = "serde")]
mod cursor;
pub mod describe;
pub mod dispatcher;
pub mod envelope;
#[cfg(feature = "serde")]
pub mod goal;
pub mod integer;
pub mod lifecycle;
pub mod link;
pub mod manifest;
pub mod memory;
pub mod message;
pub mod reply;
pub mod repr;
pub mod sink;
pub mod spec;
mod task_id;
pub mod tasks;
mod text;
pub mod time;
pub mod topic;

pub use lifecycle::{Event, Request, State};
pub use message::Message;
pub use spec::TaskSpec;
pub use task_id::TaskId;
pub use time::Instant;

/// Version of this crate, as `$ztl` reports it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
