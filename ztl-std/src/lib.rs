//! ZTL over ZeroMQ: task server and client, handlers on threads, and the gateway to microcontrollers.
//!
//! A task server with one handler, and a client that runs a task on it:
//!
//! ```
//! use std::time::Duration;
//! use ztl_std::{ExecutableTask, RemoteTask, State, TaskContext, TaskController, TaskError};
//! use ztl_std::{TaskRequest, TaskServer};
//!
//! /// Speaks by printing; takes 10 ms a word, and can be stopped between two words.
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

pub mod controller;
#[cfg(feature = "defmt")]
pub mod defmt;
mod endpoint;
pub mod files;
mod frames;
#[cfg(feature = "gateway")]
pub mod gateway;
pub mod keys;
#[cfg(feature = "config")]
pub mod listen;
mod random;
mod remote;
#[cfg(feature = "config")]
pub mod remotes;
pub mod scope;
pub mod server;
pub mod terminal;
pub mod time;

pub use controller::{
    Aborted, ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest,
};
pub use remote::{
    Description, Fate, InBackground, Offers, RemoteId, RemoteTask, RequestError, ServerInfo,
    ServerTask, ServerTasks, Status, TaskGuard, TriggerError, Triggered, WaitError, encoded,
};
#[cfg(feature = "config")]
pub use remotes::Remotes;
pub use server::{Access, BindError, Limits, ListedTask, Listing, RunningServer, TaskServer};
pub use ztl_core::{State, TaskId, TaskSpec};
