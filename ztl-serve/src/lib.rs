//! A robot's programs, and other servers, as the handlers of a task server. `docs/serve.md` describes the
//! configuration file.
//!
//! ```no_run
//! use std::path::Path;
//! use ztl_std::TaskServer;
//! use ztl_serve::{Config, ProcessRegistry};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let config = Config::load(Path::new("robot.yaml"))?;
//! let mut server = TaskServer::bind("tcp://127.0.0.1:12345")?;
//! for (scope, handler) in config.handlers(&ProcessRegistry::default())? {
//!     server.register_handler(&scope, handler);
//! }
//! server.listen()?;
//! # Ok(())
//! # }
//! ```
//!
//! A task goes from `handler` (finds the component in `components`) to `supervisor` (its life cycle, on one thread for each scope), which
//! starts a job of the component's kind. `kind` has the traits, `kinds` the table of all kinds:
//!
//! | file | kind |
//! |---|---|
//! | `program` | `run`, `shell`: a program in a process group of its own, watched by `program/watchdog` |
//! | `built_in` | `built-in`: `echo` and others |
//! | `forward` | `forward`: another ZTL server |
//! | `ros1` | `ros1-action` and others: a robot with ROS 1 |
//! | `naoqi` | `naoqi`: methods of NAO and Pepper |
//! | `http` | `http`: requests to a robot with an HTTP interface |
//!
//! `stream` has the programs whose output is published: `worker` runs them as jobs, like those of tasks.

#![cfg(unix)]

mod admission;
mod built_in;
mod call;
mod component_config;
mod components;
mod config;
mod far_descriptions;
mod forward;
mod handler;
mod http;
mod human;
mod jobs;
mod kind;
mod kinds;
mod log;
mod mailbox;
mod naoqi;
mod program;
mod reader;
mod ros1;
mod secret;
mod stream;
mod supervisor;
mod thread_job;
mod value_template;

pub use config::{Config, Scope};
pub use handler::ScopeHandler;
pub use program::ignored::ignored_signals;
pub use program::processes::ProcessRegistry;
pub use program::watchdog::watchdog;
pub use stream::Streams;
