//! States of tasks, steps, scenes, servers and runs.

use std::fmt;

use serde::{Deserialize, Serialize};
use ztl_core::State;

/// How a scene or a step ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// Everything that it waited for completed. A step in the background: every task was started.
    Completed,
    /// It was played, and something failed or stayed unknown.
    Failures,
    /// It was left before its end.
    Stopped,
}

/// Why a step waits.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "because", rename_all = "snake_case")]
pub enum WaitReason {
    /// A server does not answer: the state of its tasks is unknown.
    ServerSilent {
        /// Name of the server.
        remote: String,
    },
    /// A server restarted: the outcome of its tasks is unknown.
    ServerRestarted {
        /// Name of the server.
        remote: String,
    },
    /// A server no longer knows a task that it accepted.
    TaskUnknown,
    /// A server answers, but not about its tasks: it does not serve their scope (yet), or its
    /// controller raises an exception.
    NotTold {
        /// Name of the server.
        remote: String,
    },
    /// A server's answer does not tell the state of a task, and asking again would not help: the server
    /// could not learn the outcome, or answered about another task or outside of ZTL's definitions.
    AnswerUnclear {
        /// Name of the server.
        remote: String,
    },
    /// An INIT was sent and not answered: whether the task runs is unknown.
    StartUnknown,
    /// A task failed, was aborted by another client, or was not started.
    Failed,
    /// A task exceeds its time limit.
    TooLong,
}

impl WaitReason {
    /// Whether the wait can end without a decision: a server answers again, or a task ends.
    pub(crate) const fn may_mend(&self) -> bool {
        matches!(
            self,
            Self::ServerSilent { .. } | Self::NotTold { .. } | Self::TooLong
        )
    }
}

impl fmt::Display for WaitReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ServerSilent { remote } => write!(f, "server '{remote}' is silent"),
            Self::ServerRestarted { remote } => write!(f, "server '{remote}' was restarted"),
            Self::TaskUnknown => f.write_str("a task is unknown to its server"),
            Self::NotTold { remote } => {
                write!(f, "server '{remote}' does not say how its tasks are")
            }
            Self::AnswerUnclear { remote } => {
                write!(f, "server '{remote}' gives no usable answer about a task")
            }
            Self::StartUnknown => f.write_str("whether a task was started is unknown"),
            Self::Failed => f.write_str("a task failed"),
            Self::TooLong => f.write_str("a task takes longer than its limit"),
        }
    }
}

/// The state of a task as the run knows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskState {
    /// INIT sent, not answered yet.
    Asked,
    /// Not started: the server is not configured, not reachable, or never received the request.
    NotStarted,
    /// The server rejected the INIT.
    Refused,
    /// The server accepted the INIT; its handler has not decided yet.
    Initiated,
    /// Running.
    Accepted,
    /// Rejected by its handler. Final.
    Rejected,
    /// Ended without reaching its goal. Final.
    Failed,
    /// Stopped on request. Final.
    Aborted,
    /// Reached its goal. Final.
    Completed,
    /// Unknown: no answer, or the server restarted. It may become known again.
    Unknown,
}

impl TaskState {
    /// Whether the task has ended or never began.
    #[must_use]
    pub const fn is_over(self) -> bool {
        self.is_failure() || matches!(self, Self::Completed)
    }

    /// Whether the task is over without having reached its goal.
    #[must_use]
    pub const fn is_failure(self) -> bool {
        matches!(
            self,
            Self::NotStarted | Self::Refused | Self::Rejected | Self::Failed | Self::Aborted
        )
    }

    /// The name in records: `completed`, `not_started`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::NotStarted => "not_started",
            Self::Refused => "refused",
            Self::Initiated => "initiated",
            Self::Accepted => "accepted",
            Self::Rejected => "rejected",
            Self::Failed => "failed",
            Self::Aborted => "aborted",
            Self::Completed => "completed",
            Self::Unknown => "unknown",
        }
    }
}

impl From<State> for TaskState {
    fn from(state: State) -> Self {
        match state {
            State::Initiated => Self::Initiated,
            State::Accepted => Self::Accepted,
            State::Rejected => Self::Rejected,
            State::Failed => Self::Failed,
            State::Aborted => Self::Aborted,
            State::Completed => Self::Completed,
        }
    }
}

impl fmt::Display for TaskState {
    /// The name for people: `completed`, `not started`, and `rejected` for both kinds of rejection.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotStarted => f.write_str("not started"),
            Self::Refused => Self::Rejected.fmt(f),
            other => f.write_str(other.name()),
        }
    }
}

/// A request about a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum RequestKind {
    /// Start a task.
    Init,
    /// Report the state of a task.
    Status,
    /// Stop a task.
    Abort,
}

/// The state of a server as the run knows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "is", rename_all = "snake_case")]
pub enum ServerState {
    /// It answers.
    Answering {
        /// Version of a server of this project; `None` for the original's.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        version: Option<String>,
    },
    /// It answered before, and does not answer now.
    Silent,
    /// It is not reachable, or does not serve the scope.
    Absent {
        /// Why.
        #[serde(default, skip_serializing_if = "String::is_empty")]
        text: String,
    },
    /// It restarted and lost all tasks.
    Restarted,
}

/// How a run ended. The exit code follows from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunOutcome {
    /// Nothing that was played failed.
    Completed,
    /// It came to its end or was left, and something failed, stayed unknown or was stopped.
    Failures,
    /// It was stopped, and every task that it had started is known to have ended.
    Stopped,
    /// It was stopped, and at least one task may still run.
    NotConfirmed,
    /// It was left between scenes, and nothing that was played failed. Background tasks continue.
    Left,
    /// An error ended it.
    Error,
}
