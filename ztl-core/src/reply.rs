//! Answers as views over what is remembered; nothing is copied before it is written.

use crate::TaskId;
use crate::dispatcher::RESERVED_SCOPE;
use crate::integer::Integer;
use crate::lifecycle::State;
use crate::sink::{Sink, put_decimal};

/// The text that answers an `outcome` about an INIT that never came; the boot id follows.
pub const NEVER_SEEN: &str = "never seen since boot ";

/// What is wrong with a request that no handler gets to see; a server logs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RefusalOf {
    /// It is no message.
    Protocol,
    /// Its scope is not served.
    Scope,
}

pub(crate) const UNKNOWN_PROTOCOL: &str = "Unknown protocol";
pub(crate) const NO_CONTROLLER: &str = "No controller for scope: ";

/// An answer, as a view; [`put`](Self::put) writes it.
#[derive(Clone, Copy)]
pub struct Reply<'a> {
    pub(crate) scope: &'a str,
    pub(crate) state: State,
    pub(crate) id: ReplyId<'a>,
    pub(crate) text: ReplyText<'a>,
}

#[derive(Clone, Copy)]
pub(crate) enum ReplyId<'a> {
    Asked(Integer<'a>),
    Task(TaskId),
}

#[derive(Clone, Copy)]
pub(crate) enum ReplyText<'a> {
    Plain(&'a str),
    /// A fixed beginning, then what it is about.
    About(&'static str, &'a str),
    InvalidId(Integer<'a>),
    Undecided(TaskId),
    NeverSeen {
        boot: u32,
    },
    Probe(&'a dyn Put),
}

/// Something that writes itself.
pub(crate) trait Put {
    fn put(&self, sink: &mut dyn Sink);
}

impl<'a> Reply<'a> {
    /// State 2, id -1.
    pub(crate) fn refusal(scope: &'a str, text: ReplyText<'a>) -> Self {
        Self {
            scope,
            state: State::Rejected,
            id: ReplyId::Asked(Integer::MINUS_ONE),
            text,
        }
    }

    /// What the reserved scope says for itself: id 0, which no answer to an INIT has.
    pub(crate) fn reserved(state: State, text: ReplyText<'a>) -> Self {
        Self {
            scope: RESERVED_SCOPE,
            state,
            id: ReplyId::Asked(Integer::ZERO),
            text,
        }
    }

    /// About a task.
    pub(crate) fn about(scope: &'a str, id: TaskId, state: State, text: ReplyText<'a>) -> Self {
        Self {
            scope,
            state,
            id: ReplyId::Task(id),
            text,
        }
    }

    /// What was wrong with the request as such, if anything was.
    #[must_use]
    pub fn refusal_of(&self) -> Option<RefusalOf> {
        match self.text {
            ReplyText::Plain(UNKNOWN_PROTOCOL) => Some(RefusalOf::Protocol),
            ReplyText::About(NO_CONTROLLER, _) => Some(RefusalOf::Scope),
            _ => None,
        }
    }

    /// The scope it is under.
    #[must_use]
    pub fn scope(&self) -> &'a str {
        self.scope
    }

    /// The state it tells.
    #[must_use]
    pub fn state(&self) -> State {
        self.state
    }

    /// The task it is about, when that was given an id.
    #[must_use]
    pub fn task(&self) -> Option<TaskId> {
        match self.id {
            ReplyId::Asked(_) => None,
            ReplyId::Task(id) => Some(id),
        }
    }

    /// Writes the message.
    pub fn put(&self, sink: &mut dyn Sink) {
        sink.put(self.scope.as_bytes());
        sink.put(b";");
        put_decimal(sink, u32::from(self.state.code()));
        sink.put(b";");
        match self.id {
            ReplyId::Asked(id) => id.put(sink),
            ReplyId::Task(id) => put_decimal(sink, id.get()),
        }
        sink.put(b";");
        match self.text {
            ReplyText::Plain(text) => sink.put(text.as_bytes()),
            ReplyText::About(beginning, about) => {
                sink.put(beginning.as_bytes());
                sink.put(about.as_bytes());
            }
            ReplyText::InvalidId(id) => {
                sink.put(b"Invalid ID '");
                id.put(sink);
                sink.put(b"'");
            }
            ReplyText::Undecided(id) => {
                sink.put(b"Initiated task '");
                put_decimal(sink, id.get());
                sink.put(b"', nobody has taken it yet");
            }
            ReplyText::NeverSeen { boot } => {
                sink.put(NEVER_SEEN.as_bytes());
                put_decimal(sink, boot);
            }
            ReplyText::Probe(probe) => probe.put(sink),
        }
    }
}

impl core::fmt::Debug for Reply<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Reply")
            .field("scope", &self.scope)
            .field("state", &self.state)
            .finish_non_exhaustive()
    }
}
