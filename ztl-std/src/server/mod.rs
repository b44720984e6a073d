//! The task server: a ZeroMQ ROUTER socket around `ztl-core`'s dispatcher.
//!
//! The thread that answers clients never runs handler code that could block: a handler takes a task,
//! returns at once, and reports from its own threads.
//!
//! A request goes from `rounds` (waits for messages and reports) to `requests` (parses one), through
//! the dispatcher to a [`TaskHandler`]; the handler's reports come back through `reporter`.

mod access;
mod bind;
mod client_liveness;
mod clientless;
mod clock;
mod dropped;
mod engine;
mod handle;
mod handler;
pub(crate) mod incoming;
#[cfg(feature = "config")]
mod limit_text;
mod limits;
mod memory;
mod own_tasks;
mod reporter;
mod requests;
mod reserved_ids;
mod rounds;
mod router;
#[cfg(feature = "publish")]
mod task_events;
mod task_server;
mod task_table;
mod waker;

pub use crate::offers::offered;
pub use access::Access;
#[cfg(any(feature = "publish", feature = "libzmq"))]
pub(crate) use access::CurrentAccess;
#[cfg(feature = "libzmq")]
pub(crate) use access::Sender;
pub use bind::BindError;
pub use handle::{RunningServer, ServerHandle};
pub use handler::{Answers, Restored, RestoredTask, TaskHandler, would_take};
#[cfg(feature = "config")]
pub(crate) use limit_text::LIMITS;
#[cfg(feature = "config")]
pub use limit_text::bytes;
pub use limits::{KEEP, Limits, MAX_MESSAGE};
pub use own_tasks::{OwnTasks, ReservedId};
pub(crate) use reporter::AbortRejection;
#[cfg(feature = "gateway")]
pub(crate) use reporter::Claim;
pub use reporter::TaskReporter;
pub use reserved_ids::ReservedIds;
#[cfg(feature = "publish")]
pub(crate) use router::{rules, to_bind};
pub use task_server::{ServerBuilder, TaskServer};
pub(crate) use waker::WakeBatch;

/// What [`relay`](crate::relay) uses of a server.
pub(crate) mod relayed {
    pub(crate) use super::router::Router;
    pub(crate) use super::waker::{Signal, Waker};
}
