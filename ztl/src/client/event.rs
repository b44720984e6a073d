//! What happens to a client's task.

use ztl_std::{RemoteId, RequestError, State, Status};

/// The outcome of a task for its client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TaskOutcome {
    Completed,
    Rejected,
    Failed,
    Aborted,
    /// The task may run, or have any final state.
    Unknown,
    /// The task does not run: no server was reached, or the INIT did not arrive.
    NotStarted,
}

impl TaskOutcome {
    /// The outcome of an accepted task.
    pub(crate) const fn of(state: State) -> Self {
        match state {
            State::Completed => Self::Completed,
            State::Rejected => Self::Rejected,
            State::Failed => Self::Failed,
            State::Aborted => Self::Aborted,
            State::Initiated | State::Accepted => Self::Unknown,
        }
    }

    /// The exit code.
    pub(crate) const fn code(self) -> u8 {
        match self {
            Self::Completed => 0,
            Self::Rejected => 1,
            Self::Failed => 3,
            Self::Aborted => 4,
            Self::Unknown | Self::NotStarted => 5,
        }
    }
}

/// An event that a client reports.
#[derive(Debug)]
pub(crate) enum ClientEvent<'a> {
    /// The client sends the INIT.
    Asking,
    /// Ctrl-C before the answer to the INIT.
    Interrupted,
    Started {
        id: &'a RemoteId,
        reply: &'a str,
    },
    /// An answer to a status request.
    Progress {
        id: &'a RemoteId,
        status: &'a Status,
    },
    /// The time limit was reached, or Ctrl-C was pressed.
    Aborting {
        id: &'a RemoteId,
        interrupted: bool,
    },
    /// The task continues.
    NotAborted {
        id: &'a RemoteId,
        reply: &'a str,
        /// Whether the client waits a little longer.
        waits: bool,
    },
    Last(LastEvent<'a>),
}

/// The last event.
#[derive(Debug)]
pub(crate) enum LastEvent<'a> {
    /// The INIT started no task, or an unknown one.
    NotTriggered {
        /// The server's id, which the original prints; `None` for -1.
        id: Option<RemoteId>,
        reason: &'a str,
        outcome: TaskOutcome,
    },
    /// The task ended in time.
    Ended {
        id: &'a RemoteId,
        status: &'a Status,
    },
    /// The server's answer does not contain the task's state.
    Lost {
        id: &'a RemoteId,
        reason: &'a str,
        answer: Option<Answer<'a>>,
    },
    /// The answer to the abort does not contain the task's state.
    StopUnclear { id: &'a RemoteId, reason: &'a str },
    /// The task was aborted, or ended just before.
    Stopped {
        id: &'a RemoteId,
        status: &'a Status,
        /// The result, for programs. The answer to an abort does not have it.
        words: &'a str,
    },
    /// The state some time after an abort that was rejected or not answered.
    After {
        id: &'a RemoteId,
        state: Option<State>,
        text: &'a str,
        /// The answer to the abort.
        reply: &'a str,
    },
    /// The task was not aborted, and there is no time to wait.
    Left { id: &'a RemoteId, reply: &'a str },
}

/// An answer that does not contain the task's state, as the original reads it: the state, if ZTL defines it, and the
/// text.
pub(crate) type Answer<'a> = (Option<State>, &'a str);

pub(crate) fn answer(error: &RequestError) -> Option<Answer<'_>> {
    match error {
        RequestError::UnknownTask { text, .. } => Some((Some(State::Rejected), text)),
        RequestError::NotTold { state, text } => Some((Some(*state), text)),
        RequestError::UnknownOutcome { text } => Some((Some(State::Failed), text)),
        RequestError::OtherTask { state, text, .. } => Some((*state, text)),
        RequestError::UndefinedState { text, .. } => Some((None, text)),
        _ => None,
    }
}

impl LastEvent<'_> {
    pub(crate) fn outcome(&self) -> TaskOutcome {
        match self {
            Self::NotTriggered { outcome, .. } => *outcome,
            Self::Ended { status, .. } | Self::Stopped { status, .. } => {
                TaskOutcome::of(status.state)
            }
            Self::Lost { .. } | Self::StopUnclear { .. } | Self::Left { .. } => {
                TaskOutcome::Unknown
            }
            Self::After { state, .. } => state.map_or(TaskOutcome::Unknown, TaskOutcome::of),
        }
    }
}
