//! The protocol between server and watchdog.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::program::assignment::Assignment;
use crate::program::launch::Launch;
use crate::program::process_group::ProcessGroup;
use crate::program::settings::{Abort, AbortBy};

/// A program that the watchdog looks after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Charge {
    /// What it runs for, as `task 7`.
    pub(crate) name: String,
    /// `ZTL_ID` in its environment, which finds it while its group is unknown.
    pub(crate) id: String,
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
    /// The program of a task or stream.
    pub(crate) fn of(assignment: &Assignment, abort: &Abort) -> Self {
        let end = match (&assignment.abort, &abort.by) {
            (Some(Ok(launch)), _) => Ending::Run(Box::new(launch.clone())),
            (None, AbortBy::Signal(name, _)) => Ending::Signal((*name).to_owned()),
            // As the server does it.
            _ => Ending::Signal("TERM".to_owned()),
        };
        Self::new(&assignment.name, &assignment.id, end, abort.grace)
    }

    pub(crate) fn new(name: &str, id: &str, end: Ending, grace: Duration) -> Self {
        Self {
            name: name.to_owned(),
            id: id.to_owned(),
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
