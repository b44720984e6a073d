//! The gateway's end of the link to a microcontroller, without I/O.
//!
//! `docs/link.md` specifies the link. The parts that both ends share are in `ztl_core::link`; this crate needs an
//! allocator.

pub mod bus;
mod device;
mod event;
mod journal;
mod parameters;
mod session;
mod statistics;
mod task;
mod updates;

pub use device::{ComponentInfo, DeviceInfo};
pub use event::LinkEvent;
pub use journal::{Entry, Restored, Sent, SessionJournal};
pub use parameters::{
    ParameterAnswer, ParameterFailure, ParameterInfo, ParameterRequest, ParameterValue,
};
pub use session::{BegunTask, BusNeeds, Session};
pub use statistics::{LinkCounters, RoundTrips};
pub use updates::{FirmwareInfo, UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest};
