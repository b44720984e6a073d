//! Errors between a client and a server.

use std::io;
use std::time::Duration;

use ztl_core::dispatcher::UNKNOWN_OUTCOME;
use ztl_core::{State, client};
use ztl_zmtp::session::Obstacle;

use super::status::Status;
use crate::keys::KeyError;
use crate::remote_id::RemoteId;
use crate::terminal::quoted;

/// Why a request has no usable answer.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RequestError {
    /// No connection within the time limit; nothing was sent.
    NotConnected {
        /// The server.
        endpoint: String,
        /// How long the client tried.
        waited: Duration,
        /// What ended the last attempt, if the server's side of the handshake tells it.
        obstacle: Option<Obstacle>,
    },
    /// The message is longer than the server accepts; nothing was sent.
    TooLong {
        /// The server.
        endpoint: String,
        /// The message's length.
        bytes: usize,
        /// The server's limit.
        most: usize,
    },
    /// Sent, but not answered within the time limit. Whether the server acted is unknown.
    NoAnswer {
        /// The server.
        endpoint: String,
        /// How long the client waited.
        waited: Duration,
    },
    /// The server does not know the task: it was restarted, or has forgotten it. Whether and how the task ended is
    /// unknown.
    UnknownTask {
        /// The task's id.
        id: RemoteId,
        /// The server's text.
        text: String,
    },
    /// The server answered that the request failed: the scope has no controller (yet), or the controller raised
    /// an exception. The task may still run.
    NotTold {
        /// The state in the answer, which is not the task's.
        state: State,
        /// The server's text.
        text: String,
    },
    /// The server ended the task as FAILED without having learnt how it ended. It may still run.
    UnknownOutcome {
        /// The server's text.
        text: String,
    },
    /// The server answered for another scope or task than the request named. What the task does is unknown; an INIT may
    /// have started it.
    OtherTask {
        /// The state in the answer, if ZTL defines it.
        state: Option<State>,
        /// Which task the answer is about, in words.
        about: String,
        /// The server's text.
        text: String,
    },
    /// The server answered with a state that ZTL does not define. What the task does is unknown.
    UndefinedState {
        /// The number.
        state: RemoteId,
        /// The server's text.
        text: String,
    },
    /// The answer is not a ZTL message. An INIT may have started its task.
    Unreadable {
        /// The answer, as far as it is text.
        answer: String,
    },
    /// A server of this project does not describe itself in a readable way.
    Undescribed {
        /// The answer.
        answer: String,
    },
    /// Nothing can be sent to this scope, for this reason.
    Scope(String),
    /// Keys were given, but libzmq cannot encrypt.
    NoCurve,
    /// The endpoint is invalid.
    Endpoint {
        /// The endpoint.
        endpoint: String,
        /// What is wrong with it.
        why: String,
    },
    /// The system has no more files, threads or memory: its words.
    System(String),
}

impl RequestError {
    /// Whether nothing was sent, so nothing was done.
    #[must_use]
    pub const fn nothing_was_sent(&self) -> bool {
        matches!(
            self,
            Self::NotConnected { .. } | Self::TooLong { .. } | Self::Scope(_)
        )
    }

    /// If the server does not let the client connect: what is wrong with the server at the endpoint, and what helps. In
    /// the words of `ztl`: options of its commands, which have the same names in its files.
    #[must_use]
    pub fn advice(&self) -> Option<(String, &'static str)> {
        match self {
            Self::NotConnected { obstacle, .. } => obstacle.map(advice),
            _ => None,
        }
    }

    /// Whether the server does not serve the scope (yet).
    #[must_use]
    pub fn is_no_scope(&self) -> bool {
        matches!(self, Self::NotTold { state, text } if client::is_no_scope(*state, text))
    }

    /// Whether the server answered without telling the task's state. Asking again would bring the same answer, so
    /// it ends a wait; the task may still run.
    #[must_use]
    pub const fn was_answered(&self) -> bool {
        matches!(
            self,
            Self::UnknownTask { .. }
                | Self::NotTold { .. }
                | Self::UnknownOutcome { .. }
                | Self::OtherTask { .. }
                | Self::UndefinedState { .. }
                | Self::Unreadable { .. }
        )
    }
}

impl std::fmt::Display for RequestError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotConnected {
                endpoint,
                waited,
                obstacle,
            } => match obstacle {
                Some(obstacle) => {
                    let (problem, remedy) = advice(*obstacle);
                    write!(f, "the server at {endpoint} {problem}: {remedy}")
                }
                None => write!(
                    f,
                    "no answer from {endpoint} within {:.1} s",
                    waited.as_secs_f32()
                ),
            },
            Self::TooLong {
                endpoint,
                bytes,
                most,
            } => write!(
                f,
                "the message has {bytes} bytes, and the server at {endpoint} takes at most {most}; a \
                 goal can have somewhat less than {}, because it is sent as base64",
                most / 4 * 3
            ),
            Self::NoAnswer { endpoint, waited } => write!(
                f,
                "no answer from {endpoint} within {:.1} s; whether it acted is unknown",
                waited.as_secs_f32()
            ),
            Self::UnknownTask { id, .. } => write!(
                f,
                "the server does not know task {id}: it was restarted or has dropped the task, so the outcome is unknown"
            ),
            Self::NotTold { text, .. } => {
                let text = quoted(text);
                write!(f, "the server did not report the task's state: {text}")
            }
            Self::UnknownOutcome { text } => {
                let why = quoted(text.strip_prefix(UNKNOWN_OUTCOME).unwrap_or(text));
                write!(f, "the server could not learn how the task ended: {why}")
            }
            Self::OtherTask { about, text, .. } => write!(
                f,
                "the server answered about {}, so what this task does is unknown: {}",
                quoted(about),
                quoted(text)
            ),
            Self::UndefinedState { state, text } => write!(
                f,
                "the server answered state {state}, which ZTL does not define: {}",
                quoted(text)
            ),
            Self::Unreadable { answer } => write!(
                f,
                "the server's answer is not a ZTL message, so what it did is unknown: {:?}",
                quoted(answer)
            ),
            Self::Undescribed { answer } => write!(
                f,
                "the server does not say in readable YAML what it offers: {:?}",
                quoted(answer)
            ),
            Self::Scope(mistake) => f.write_str(mistake),
            Self::NoCurve => KeyError::NoCurve.fmt(f),
            Self::Endpoint { endpoint, why } => write!(f, "cannot connect to {endpoint}: {why}"),
            Self::System(cause) => write!(f, "cannot connect: {cause}"),
        }
    }
}

impl std::error::Error for RequestError {}

/// What is wrong with a server that does not let a client connect, and the remedy.
pub(crate) fn advice(obstacle: Obstacle) -> (String, &'static str) {
    let (problem, remedy) = match obstacle {
        Obstacle::PeerEncrypts => (
            "encrypts, and this client has no keys",
            "give --key and --server-key (in a configuration file: key and server-key)",
        ),
        Obstacle::PeerIsPlain => (
            "does not encrypt, and this client has keys",
            "start the server with --key, or connect without keys",
        ),
        Obstacle::OtherMechanism => (
            "demands a password or a ticket",
            "ZTL knows only keys (see `ztl keys`)",
        ),
        Obstacle::OtherKey => (
            "does not have the key that this client expects",
            "the client's --server-key must be the NAME.key of this server",
        ),
        Obstacle::KeyNotAdmitted => (
            "does not admit this client",
            "the server's --client-key must name this client's key, and its --allow, if any, this machine's address",
        ),
        Obstacle::NotAdmitted => (
            "does not admit this client",
            "the server's --allow must name this machine's address",
        ),
        Obstacle::Fault(fault) => {
            let problem = format!("does not speak to this client ({fault})");
            return (problem, "is it a ZTL server, and its port for tasks?");
        }
        // The list may grow.
        _ => ("does not let this client connect", "see the server's log"),
    };
    (problem.to_owned(), remedy)
}

impl From<io::Error> for RequestError {
    fn from(cause: io::Error) -> Self {
        Self::System(cause.to_string())
    }
}

/// Why a task was not started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TriggerError {
    /// The server rejected it; nothing was done.
    Rejected {
        /// The id in the answer: 0 or below.
        id: RemoteId,
        /// The server's reason.
        reason: String,
    },
    /// The server has not received it, and will reject it from now on: it does not run.
    NeverCame,
    /// It was no longer wanted before it was sent; nothing was done.
    GivenUp,
    /// There is no usable answer. Unless [nothing was sent](RequestError::nothing_was_sent), the task may
    /// run.
    Request(RequestError),
}

impl std::fmt::Display for TriggerError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Rejected { reason, .. } => write!(f, "rejected: {reason}"),
            Self::NeverCame => f.write_str("it never reached the server and was not started"),
            Self::GivenUp => f.write_str("it was cancelled before it was sent"),
            Self::Request(cause) if cause.nothing_was_sent() => {
                write!(f, "{cause}; nothing was sent")
            }
            Self::Request(cause) => cause.fmt(f),
        }
    }
}

impl std::error::Error for TriggerError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Rejected { .. } | Self::NeverCame | Self::GivenUp => None,
            Self::Request(cause) => Some(cause),
        }
    }
}

/// The task did not end within the limit of the wait.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WaitError {
    /// The last status, or why the last request has none.
    pub last: Result<Status, RequestError>,
}

impl std::fmt::Display for WaitError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.last {
            Ok(status) => write!(f, "still {} ({})", status.state, status.text),
            Err(cause) => write!(f, "unknown: {cause}"),
        }
    }
}

impl std::error::Error for WaitError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.last.as_ref().err().map(|cause| cause as _)
    }
}

/// Why a task that was started and waited for has no final state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunError {
    /// It was not started, or its INIT has no usable answer.
    NotStarted(TriggerError),
    /// It was started; its end is unknown.
    NotEnded(WaitError),
}

impl std::fmt::Display for RunError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotStarted(error) => error.fmt(f),
            Self::NotEnded(error) => error.fmt(f),
        }
    }
}

impl std::error::Error for RunError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::NotStarted(error) => error.source(),
            Self::NotEnded(error) => error.source(),
        }
    }
}
