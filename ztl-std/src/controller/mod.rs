//! Handlers whose tasks run on threads of their own.

mod pool;
mod task;
mod threads;

pub use task::{Aborted, ExecutableTask, TaskContext, TaskController, TaskError};
