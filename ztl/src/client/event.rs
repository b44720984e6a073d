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
    StopUnclear {
        id: &'a RemoteId,
        reason: &'a str,
        answer: Option<Answer<'a>>,
    },
    /// The task was aborted, or ended just before.
    Stopped {
        id: &'a RemoteId,
        status: &'a Status,
        /// The result, if it is reported and known. The answer to an abort does not have it.
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

/// An answer that does not contain the task's state, as the original reads it: it looks at the number of the state alone.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Answer<'a> {
    /// The state, if ZTL defines it.
    pub(crate) state: Option<State>,
    pub(crate) is_negative: bool,
    pub(crate) text: &'a str,
}

impl<'a> Answer<'a> {
    pub(crate) fn of(error: &'a RequestError) -> Option<Self> {
        let (state, text) = match error {
            RequestError::UnknownTask { text, .. } => (Some(State::Rejected), text),
            RequestError::NotTold { state, text } => (Some(*state), text),
            RequestError::UnknownOutcome { text } => (Some(State::Failed), text),
            RequestError::OtherTask { state, text, .. } => (*state, text),
            RequestError::UndefinedState { text, .. } => (None, text),
            _ => return None,
        };
        let negative = |state: &RemoteId| state.as_str().starts_with('-');
        Some(Self {
            state,
            is_negative: matches!(error, RequestError::UndefinedState { state, .. } if negative(state)),
            text,
        })
    }

    /// Whether the original takes the task for running.
    pub(crate) fn runs(&self) -> bool {
        self.is_negative || self.state.is_some_and(|state| !state.is_final())
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
