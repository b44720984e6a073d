//! Classifies answers. No other code interprets their texts.

use crate::integer::Integer;
use crate::lifecycle::{Request, State};
use crate::message::Message;
use crate::reply::{RESERVED_SCOPE, UNKNOWN_OUTCOME};

/// The meaning of an answer to a request.
///
/// An answer counts only if it has the scope of its request and, except for an INIT, its id: every server repeats both. The
/// id of the answer to an INIT then decides whether the task was accepted. The state of any other answer is the state of
/// the task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Answer<'a> {
    /// To an INIT: the server accepted the task.
    Accepted {
        /// The task's id: above 0, of any length.
        id: Integer<'a>,
        /// The final state, if the task has ended already.
        ended: Option<State>,
        /// The payload: the handler's reply or the task's result.
        text: &'a str,
    },
    /// To an INIT: the server rejected the task, and nothing was done.
    Rejected {
        /// The id: 0 or below.
        id: Integer<'a>,
        /// The payload: the reason.
        text: &'a str,
    },
    /// To STATUS or ABORT: the state of the task. To a question about the server: its answer.
    Task {
        /// The task's state.
        state: State,
        /// The payload: progress, result or reason.
        text: &'a str,
    },
    /// To STATUS or ABORT: the server does not know the task.
    UnknownTask {
        /// The payload.
        text: &'a str,
    },
    /// To STATUS or ABORT: the server did not reach the task. The state is about the request, and
    /// the task may still run.
    NotTold {
        /// The state in the answer.
        state: State,
        /// The payload: what went wrong.
        text: &'a str,
    },
    /// To STATUS or ABORT: the task is FAILED, but the server could not learn its outcome
    /// ([`UNKNOWN_OUTCOME`]). The task may still run.
    UnknownOutcome {
        /// The payload.
        text: &'a str,
    },
    /// The answer has another scope or id than the request, so it says nothing about the task.
    OtherTask {
        /// The state in the answer, if ZTL defines it.
        state: Option<State>,
        /// The scope in the answer.
        scope: &'a str,
        /// The id in the answer, which may not be a number.
        id: &'a str,
        /// The payload.
        text: &'a str,
    },
    /// To STATUS or ABORT: the state is a number that ZTL does not define.
    UndefinedState {
        /// The number.
        state: Integer<'a>,
        /// The payload.
        text: &'a str,
    },
}

impl<'a> Answer<'a> {
    /// Classifies the answer `message` to `asked`. `None` if it has no number where the request needs one.
    pub(super) fn of(request: Request, asked: &Message<'_>, message: &Message<'a>) -> Option<Self> {
        let Message {
            scope,
            id,
            payload: text,
            ..
        } = *message;
        let code = message.code();
        let state = code
            .ok()
            .and_then(Integer::value)
            .and_then(State::from_code);
        let of_scope = scope == asked.scope;
        let other_task = Self::OtherTask {
            state,
            scope,
            id,
            text,
        };
        if request == Request::Init {
            let id = message.number().ok()?;
            let ended = state.filter(|state| state.is_final() && !is_unknown_outcome(*state, text));
            return Some(match id.is_positive() {
                _ if !of_scope => other_task,
                true => Self::Accepted { id, ended, text },
                false => Self::Rejected { id, text },
            });
        }
        Some(match (state, code.ok()?) {
            (None, state) => Self::UndefinedState { state, text },
            (Some(state), _) if is_about_the_request(state, text) => Self::NotTold { state, text },
            _ if !of_scope || !is_about(asked, message) => other_task,
            (Some(State::Rejected), _) if is_unknown_task(text) => Self::UnknownTask { text },
            (Some(state), _) if is_unknown_outcome(state, text) => Self::UnknownOutcome { text },
            (Some(state), _) => Self::Task { state, text },
        })
    }

    /// The payload.
    #[must_use]
    pub const fn text(&self) -> &'a str {
        match *self {
            Self::Accepted { text, .. }
            | Self::Rejected { text, .. }
            | Self::Task { text, .. }
            | Self::UnknownTask { text }
            | Self::NotTold { text, .. }
            | Self::UnknownOutcome { text }
            | Self::OtherTask { text, .. }
            | Self::UndefinedState { text, .. } => text,
        }
    }
}

/// Whether an answer with the right scope is about the task in the request. Answers of the reserved scope are about no task
/// and have other ids.
fn is_about(asked: &Message<'_>, answer: &Message<'_>) -> bool {
    let same = || Some(asked.number().ok()? == answer.number().ok()?);
    asked.scope == RESERVED_SCOPE || same() == Some(true)
}

/// Whether a task with this state and text ended without its server knowing the outcome
/// ([`UNKNOWN_OUTCOME`]): it may still run.
#[must_use]
pub fn is_unknown_outcome(state: State, text: &str) -> bool {
    state == State::Failed && text.starts_with(UNKNOWN_OUTCOME)
}

/// Whether this text means that the server does not know the task. The original's controllers name the id, its
/// simple server does not. A relay repeats the text of the server behind it, with the id that the task has
/// there. A handler may use the same text for something else.
fn is_unknown_task(text: &str) -> bool {
    let Some(named) = text.strip_prefix("Invalid ID") else {
        return false;
    };
    let quoted = named
        .strip_prefix(" '")
        .and_then(|rest| rest.strip_suffix('\''));
    named.is_empty() || quoted.is_some_and(|id| Integer::parse(id).is_ok())
}

/// Whether an answer that does not tell the task's state means that the server does not serve the scope.
#[must_use]
pub fn is_no_scope(state: State, text: &str) -> bool {
    state == State::Rejected && text.starts_with("No controller for scope")
}

/// Whether the answer to an ABORT means that the handler cannot stop the task, which continues.
#[must_use]
pub fn is_abort_rejected(state: State, text: &str) -> bool {
    !state.is_final() && text == "False"
}

/// Whether a final state is about the request and not about the task: the scope does not exist (yet), the request was
/// invalid, or the original's controller raised an exception (`docs/protocol.md` [12.6]).
fn is_about_the_request(state: State, text: &str) -> bool {
    match state {
        State::Rejected => {
            is_no_scope(state, text) || text == "Invalid request" || text == "Unknown protocol"
        }
        State::Failed => text.starts_with("Controller threw exception: "),
        _ => false,
    }
}
