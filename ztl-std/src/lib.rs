//! ZTL over ZeroMQ: task server and client, handlers on threads, and the gateway to microcontrollers.
//!
//! | to | use |
//! |---|---|
//! | serve tasks | [`TaskServer`] with a [`TaskController`], whose tasks run on threads |
//! | run tasks | [`RemoteTask`] |
//! | publish values, or subscribe to them | [`Publisher`], [`Subscriber`] |
//! | serve microcontrollers | [`gateway::Gateway`] |
//! | restrict access | [`Access`], [`keys`] and [`Limits`] |
//! | write a handler without threads | [`server::TaskHandler`] |
//!
//! [`files`], [`listen`], [`scope`], [`terminal`] and [`time`] are shared with the other crates of this project, and
//! of little use elsewhere.
//!
//! A task server with one handler, and a client that runs a task on it:
//!
//! ```
//! use std::time::Duration;
//! use ztl_std::{ExecutableTask, RemoteTask, State, TaskContext, TaskController, TaskError};
//! use ztl_std::{TaskRequest, TaskServer};
//!
//! /// Takes 10 ms per word, and can be stopped between two words.
//! struct Speak(String);
//!
//! impl ExecutableTask for Speak {
//!     fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
//!         for word in self.0.split_whitespace() {
//!             context.progress(word);
//!             context.sleep(Duration::from_millis(10))?;
//!         }
//!         Ok(format!("said {}", self.0))
//!     }
//! }
//!
//! struct Robot;
//!
//! impl TaskController for Robot {
//!     fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
//!         match request.component.as_str() {
//!             "tts" => Ok(Box::new(Speak(request.goal.clone()))),
//!             other => Err(format!("no component '{other}'; it has: tts").into()),
//!         }
//!     }
//! }
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut server = TaskServer::bind("tcp://127.0.0.1:*")?;
//! server.register("/robot", Robot);
//! let server = server.spawn()?;
//!
//! let mut robot = RemoteTask::connect(server.endpoint(), "/robot")?;
//! let task = robot.trigger("robot", "tts", "hello there")?;
//! let end = robot.wait(task.id, Some(Duration::from_secs(5)))?;
//! assert_eq!((end.state, end.text.as_str()), (State::Completed, "said hello there"));
//! # Ok(())
//! # }
//! ```

mod client;
mod controller;
#[cfg(feature = "defmt")]
pub mod defmt;
pub mod describe;
pub mod files;
#[cfg(feature = "gateway")]
pub mod gateway;
pub mod host;
pub mod keys;
#[cfg(feature = "libzmq")]
mod libzmq;
#[cfg(feature = "config")]
pub mod listen;
mod log_targets;
mod native;
mod offers;
#[cfg(feature = "publish")]
pub mod publish;
mod random;
mod rate_limit;
pub mod relay;
mod remote_id;
#[cfg(feature = "config")]
pub mod remotes;
pub mod scope;
pub mod server;
mod task_list;
mod task_request;
pub mod terminal;
pub mod time;
mod transport;

pub use client::{
    AbortOnDrop, BackgroundTask, DescribeQuestions, DescribedComponent, Obstacle, ParallelRequests,
    RemoteTask, RequestError, RunError, ServerInfo, Status, TriggerError, Triggered, WaitError,
    server_answer,
};
#[cfg(feature = "config")]
pub use client::{Description, SavedDescription, ServerTask, ServerTasks};
pub use controller::{Aborted, ExecutableTask, TaskContext, TaskController, TaskError};
pub use offers::Offers;
#[cfg(feature = "publish")]
pub use publish::{Publisher, Subscriber};
pub use remote_id::RemoteId;
#[cfg(feature = "config")]
pub use remotes::Remotes;
pub use server::{Access, BindError, Limits, RunningServer, ServerBuilder, TaskServer};
pub use task_list::ListedTask;
pub use task_request::{TaskRequest, encoded};
pub use transport::Transport;
pub use ztl_core::{State, TaskId, TaskSpec};
