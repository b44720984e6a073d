//! The protocol between server and watchdog.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::TaskId;

use crate::call::Call;
use crate::program::launch::Launch;
use crate::program::process_group::ProcessGroup;
use crate::program::settings::{AbortBy, Program};

/// A program that the watchdog looks after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Charge {
    /// `ZTL_ID` in its environment, which finds it while its group is unknown.
    pub(crate) task: u32,
    pub(crate) group: Option<ProcessGroup>,
    pub(crate) end: Ending,
    pub(crate) grace: Duration,
}

/// How it is stopped.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) enum Ending {
    /// By a signal, as `TERM`.
    Signal(String),
    /// By another program.
    Run(Box<Launch>),
    /// Not at all, since it stops another program.
    Wait,
}

impl Charge {
    /// A task's program.
    pub(crate) fn of(program: &Program, call: &Call) -> Self {
        let end = match &program.abort.by {
            AbortBy::Signal(name, _) => Ending::Signal((*name).to_owned()),
            AbortBy::Program(run) => match run.launch(call) {
                Ok(launch) => Ending::Run(Box::new(launch)),
                // As the server does it.
                Err(_) => Ending::Signal("TERM".to_owned()),
            },
        };
        Self::new(call.id.get(), end, program.abort.grace)
    }

    /// A program that aborts a task's.
    pub(crate) fn of_abort_program(task: TaskId, grace: Duration) -> Self {
        Self::new(task.get(), Ending::Wait, grace)
    }

    pub(crate) fn new(task: u32, end: Ending, grace: Duration) -> Self {
        Self {
            task,
            group: None,
            end,
            grace,
        }
    }
}

/// Messages to the watchdog, one line of JSON each. The watchdog first sends [`READY`]; then it answers each `Begins`
/// with a line that holds the number of the program.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) enum Message {
    /// The program is about to start.
    Begins(u64, Charge),
    /// It has started.
    Runs(u64, ProcessGroup),
    /// It has ended, or has not started.
    Over(u64),
}

/// The watchdog is ready: it survives signals and listens.
pub(crate) const READY: u64 = 0;
