//! Robots with ROS 1: kinds that run tasks there, and topics as streams.
//!
//! | file | what |
//! |---|---|
//! | `connection` | the node that all share |
//! | `reader` | `ros1` at the top of the file, and names |
//! | `types` | types by their names in the file, and the names in ROS that have them |
//! | `message`, `fit` | messages with placeholders, read from YAML and filled with a goal |
//! | `used_name`, `names` | the names in ROS that the file uses, and what of these is not there |
//! | `shown` | texts with parts of a received message |
//! | `action` | `ros1-action` |
//! | `trajectory`, `motion` | `ros1-trajectory`, and the end of a motion by joint states |
//! | `audience` | who receives what is published |
//! | `publish` | `ros1-publish` |
//! | `service` | `ros1-service` |
//! | `parameter` | `ros1-parameter` |
//! | `topic` | `ros1-topic`, a stream |

pub(crate) mod action;
mod audience;
pub(crate) mod connection;
mod fit;
pub(crate) mod message;
mod motion;
pub(crate) mod names;
pub(crate) mod parameter;
pub(crate) mod publish;
mod reader;
pub(crate) mod service;
mod shown;
pub(crate) mod topic;
pub(crate) mod trajectory;
mod types;
pub(crate) mod used_name;

use ztl_ros1::GoalEvent;

/// What the node reports to a job.
#[derive(Debug)]
pub(crate) enum Event {
    Goal(GoalEvent),
    /// The encoded response of a service, or why there is none; `unknown`: the service may have carried out the call.
    Response(Result<Vec<u8>, Refusal>),
    /// Why no node receives a topic.
    Reason(String),
}

/// Why a service has not answered.
#[derive(Debug)]
pub(crate) struct Refusal {
    pub(crate) reason: String,
    /// Whether the service may have done it.
    pub(crate) unknown: bool,
}

#[cfg(test)]
mod tests;
