//! What can go wrong between a client and a server, by who can mend it.

use std::time::Duration;

use ztl_core::State;
use ztl_core::dispatcher::UNKNOWN_END;

use super::{RemoteId, Status};
use crate::keys::KeyError;
use crate::terminal::quoted;

/// Why a request got no answer that could be used.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RequestError {
    /// No connection within the time: nothing was sent.
    NotConnected {
        /// The server.
        endpoint: String,
        /// How long it was tried.
        waited: Duration,
    },
    /// Longer than the server says that it takes: nothing was sent.
    TooLong {
        /// The server.
        endpoint: String,
        /// How long the message is.
        bytes: usize,
        /// How long one may be that the server takes.
        most: usize,
    },
    /// Sent, and not answered within the time: whether it was acted on is unknown.
    NoAnswer {
        /// The server.
        endpoint: String,
        /// How long it was waited for.
        waited: Duration,
    },
    /// The server does not know the task: it was started anew, or has forgotten it. How the task
    /// ended, or whether, is unknown.
    UnknownTask {
        /// Which.
        id: RemoteId,
        /// The server's text.
        text: String,
    },
    /// The server answered that something went wrong with the request: its scope has no controller
    /// (yet), or its controller raised an exception. The task may still run.
    NotTold {
        /// The state in the answer, which is not the task's.
        state: State,
        /// The server's text.
        text: String,
    },
    /// The server ended the task as FAILED without having learnt how it ended. It may still run.
    UnknownEnd {
        /// The server's text.
        text: String,
    },
    /// The server answered for another scope or another task than the request named: what the task does is
    /// unknown. An INIT that is answered so may have started its task.
    OtherTask {
        /// The state in the answer, if ZTL defines it.
        state: Option<State>,
        /// Which task the answer is about, in words.
        about: String,
        /// The server's text.
        text: String,
    },
    /// The server answered with a state that ZTL does not define: what the task does is unknown.
    UndefinedState {
        /// The number.
        state: RemoteId,
        /// The server's text.
        text: String,
    },
    /// The answer is not a ZTL message. An INIT that is answered so may have started its task.
    Unreadable {
        /// The answer, as far as it is text.
        answer: String,
    },
    /// The server is ours, but does not describe itself in a way that can be read.
    Undescribed {
        /// The answer.
        answer: String,
    },
    /// Nothing can be sent to this scope; the text says why.
    Scope(String),
    /// Keys were given, and this build cannot encrypt.
    NoCurve,
    /// ZeroMQ failed.
    Transport(zmq::Error),
}

impl RequestError {
    /// Whether nothing was sent: then nothing was done.
    #[must_use]
    pub const fn nothing_was_sent(&self) -> bool {
        matches!(
            self,
            Self::NotConnected { .. } | Self::TooLong { .. } | Self::Scope(_)
        )
    }

    /// Whether the server answered, and did not say where the task is. To ask again at once would
    /// bring the same answer, so a wait ends with it; the task may still run.
    #[must_use]
    pub const fn was_answered(&self) -> bool {
        matches!(
            self,
            Self::UnknownTask { .. }
                | Self::NotTold { .. }
                | Self::UnknownEnd { .. }
                | Self::OtherTask { .. }
                | Self::UndefinedState { .. }
                | Self::Unreadable { .. }
        )
    }
}

impl std::fmt::Display for RequestError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotConnected { endpoint, waited } => write!(
                f,
                "no answer from {endpoint} within {:.1} s",
                waited.as_secs_f32()
            ),
            Self::TooLong {
                endpoint,
                bytes,
                most,
            } => write!(
                f,
                "the message has {bytes} bytes, and the server at {endpoint} takes at most {most}, of which a \
                 goal can be somewhat less than {}, since it goes as base64",
                most / 4 * 3
            ),
            Self::NoAnswer { endpoint, waited } => write!(
                f,
                "no answer from {endpoint} within {:.1} s; whether it acted is unknown",
                waited.as_secs_f32()
            ),
            Self::UnknownTask { id, .. } => write!(
                f,
                "the server does not know task {id}: it was started anew or has forgotten it, and how the task ended is unknown"
            ),
            Self::NotTold { text, .. } => {
                let text = quoted(text);
                write!(f, "the server did not say how the task is: {text}")
            }
            Self::UnknownEnd { text } => {
                let why = quoted(text.strip_prefix(UNKNOWN_END).unwrap_or(text));
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
            Self::Transport(cause) => write!(f, "ZeroMQ: {}", cause.message()),
        }
    }
}

impl std::error::Error for RequestError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Transport(cause) => Some(cause),
            _ => None,
        }
    }
}

impl From<zmq::Error> for RequestError {
    fn from(cause: zmq::Error) -> Self {
        Self::Transport(cause)
    }
}

/// Why a task was not started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TriggerError {
    /// The server refused it; nothing was done.
    Refused {
        /// The id of the answer: 0 or below.
        id: RemoteId,
        /// The server's reason.
        reason: String,
    },
    /// The server has not got it, and will refuse it if it still comes: it does not run.
    NeverCame,
    /// It was not wanted any more before it was sent: nothing was done.
    GivenUp,
    /// There was no usable answer: it does not run if [nothing was sent](RequestError::nothing_was_sent), else
    /// it may.
    Request(RequestError),
}

impl std::fmt::Display for TriggerError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Refused { reason, .. } => write!(f, "refused: {reason}"),
            Self::NeverCame => f.write_str("it never came to the server, and was not started"),
            Self::GivenUp => f.write_str("it was given up before it was sent"),
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
            Self::Refused { .. } | Self::NeverCame | Self::GivenUp => None,
            Self::Request(cause) => Some(cause),
        }
    }
}

/// The task had not ended when the limit of the wait had passed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WaitError {
    /// What the server said last: `Err` when it did not answer the last question.
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
