//! Robots with NAOqi, such as NAO and Pepper: their methods as tasks, their events and signals as streams.
//!
//! | file | what |
//! |---|---|
//! | `connection` | the client that all share |
//! | `reader` | `naoqi` at the top of the file; names and arguments |
//! | `arguments` | arguments of methods, filled with a goal |
//! | `names` | the services, methods and signals that the file uses, and which of them are not there |
//! | `call` | `naoqi`: a call of a method |
//! | `signal` | `naoqi-event` and `naoqi-signal`, streams |
//! | `wait` | `naoqi-wait`: a wait for an event |

mod arguments;
pub(crate) mod call;
pub(crate) mod connection;
pub(crate) mod names;
mod reader;
pub(crate) mod signal;
pub(crate) mod wait;

use std::sync::Arc;

use ztl_naoqi::{CallError, Cancel, MetaObject, Value};

/// What the client reports to a job.
#[derive(Debug)]
pub(crate) enum Event {
    /// What the service says of itself.
    Described(Result<Arc<MetaObject>, CallError>),
    /// The call has ended.
    Ended(Result<Value, CallError>),
    /// The call that aborts it has ended.
    AbortEnded(Result<Value, CallError>),
    /// What has become of the wish to cancel the call.
    Canceled(Cancel),
}
