//! Robots with an HTTP interface, such as Misty: a request is the task, or begins it; events are streams, or end it.
//!
//! | file | what |
//! |---|---|
//! | `hosts` | names for hosts, and their certificates |
//! | `hosts_reader` | `http` at the top of the file |
//! | `request` | a request of the file, and what it is for a goal |
//! | `dial` | connections, plain or encrypted, each with its time |
//! | `tls` | whom to trust |
//! | `exchange` | one request and its answer, bounded |
//! | `events` | WebSockets and Server-Sent Events (`sse`), read on a thread |
//! | `condition` | what an answer or an event means |
//! | `task` | `http`: the kind |
//! | `task/run` | the thread of a task, and the supervisor's side of it |
//! | `thread` | starts a thread |
//! | `shared` | what both know in common |
//! | `stream` | `http-event`: events as a stream |

#[cfg(feature = "http")]
mod condition;
#[cfg(feature = "http")]
mod dial;
#[cfg(feature = "http")]
mod events;
#[cfg(feature = "http")]
mod exchange;
#[cfg(feature = "http")]
pub(crate) mod hosts;
#[cfg(feature = "http")]
mod hosts_reader;
#[cfg(feature = "http")]
mod request;
#[cfg(feature = "http")]
mod shared;
#[cfg(feature = "http")]
mod sse;
#[cfg(feature = "http")]
pub(crate) mod stream;
#[cfg(feature = "http")]
pub(crate) mod task;
#[cfg(feature = "http")]
mod thread;
#[cfg(feature = "http")]
mod tls;

#[cfg(not(feature = "http"))]
mod left_out;
#[cfg(not(feature = "http"))]
pub(crate) use left_out::{stream, task};
