//! The gateway's end of the link to a microcontroller, without I/O.
//!
//! `docs/link.md` specifies the link. The parts that both ends share are in `ztl_core::link`; this crate needs an
//! allocator.

pub mod bus;
mod device;
mod doubt;
mod event;
mod journal;
mod outcome;
mod own;
mod parameters;
mod receive;
mod send;
mod session;
mod state;
mod statistics;
mod task;
mod update;

pub use device::{ComponentInfo, DeviceInfo};
pub use event::LinkEvent;
pub use journal::{Entry, Restored, Sent, SessionJournal};
pub use own::BegunTask;
pub use parameters::{
    ParameterAnswer, ParameterFailure, ParameterInfo, ParameterRequest, ParameterValue,
};
pub use state::{BusNeeds, Session};
pub use statistics::{LinkCounters, RoundTrips};
pub use update::{FirmwareInfo, UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest};
