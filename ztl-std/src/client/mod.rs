//! The client: runs tasks on a server, which may be the original's.
//!
//! [`RemoteTask`] is what a program uses. [`connection`] sends one request and receives its answer, by the
//! rules of [`ztl_core::client`], which also decides what an answer means.

mod abort_on_drop;
mod background;
mod components;
mod connection;
#[cfg(feature = "config")]
mod description;
mod error;
mod parallel_requests;
mod remote_task;
mod reply_status;
#[cfg(feature = "config")]
mod saved_description;
mod socket;
mod status;
#[cfg(feature = "config")]
mod tasks;

pub use abort_on_drop::AbortOnDrop;
pub use background::BackgroundTask;
pub use components::{DescribeQuestions, DescribedComponent};
pub use connection::server_answer;
#[cfg(feature = "config")]
pub use description::Description;
#[cfg(feature = "publish")]
pub(crate) use error::advice;
pub use error::{RequestError, RunError, TriggerError, WaitError};
pub use parallel_requests::ParallelRequests;
pub use remote_task::RemoteTask;
#[cfg(feature = "config")]
pub use saved_description::SavedDescription;
pub use status::{ServerInfo, Status, Triggered};
#[cfg(feature = "config")]
pub use tasks::{ServerTask, ServerTasks};
pub use ztl_zmtp::session::Obstacle;
