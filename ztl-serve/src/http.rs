//! Robots with an HTTP interface, such as Misty: a request is the task, or begins it.
//!
//! | file | what |
//! |---|---|
//! | `hosts` | `http` at the top of the file: names for hosts |
//! | `request` | a request of the file, and what it is for a goal |
//! | `exchange` | one request and its answer, bounded |
//! | `condition` | what an answer means |
//! | `task` | `http`: the kind, and the thread of a task |

mod condition;
mod exchange;
pub(crate) mod hosts;
mod request;
pub(crate) mod task;
