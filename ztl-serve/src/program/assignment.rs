//! What a program runs for: one task, or one start of a stream.

use super::launch::Launch;
use super::settings::{AbortBy, Program};
use crate::call::Call;

/// A program's commands for one task, or for one start of a stream.
pub(crate) struct Assignment {
    /// For people: `task 7`, `stream /robot/battery`.
    pub(crate) name: String,
    /// `ZTL_ID` in the environment. No other program on this machine has it.
    pub(crate) id: String,
    pub(crate) launch: Launch,
    /// What stops it, if a program does, or why that cannot be started.
    pub(crate) abort: Option<Result<Launch, String>>,
}

impl Assignment {
    /// For a task; an error is why the task is rejected.
    pub(crate) fn of_task(program: &Program, call: &Call) -> Result<Self, String> {
        let abort = match &program.abort.by {
            AbortBy::Program(run) => Some(run.launch(call)),
            AbortBy::Signal(..) => None,
        };
        Ok(Self {
            name: format!("task {}", call.id),
            id: call.id.to_string(),
            launch: program.run.launch(call)?,
            abort,
        })
    }

    /// For a stream.
    pub(crate) fn of_stream(program: &Program, scope: &str, topic: &str, id: String) -> Self {
        let abort = match &program.abort.by {
            AbortBy::Program(run) => Some(Ok(run.launch_stream(scope, &id))),
            AbortBy::Signal(..) => None,
        };
        Self {
            name: format!("stream {topic}"),
            launch: program.run.launch_stream(scope, &id),
            id,
            abort,
        }
    }
}
