//! Replies as views of what is stored; nothing is copied before it is written.

use crate::TaskId;
use crate::integer::Integer;
use crate::lifecycle::State;
use crate::sink::{Sink, put_decimal};
use crate::text::split_at_mark;

/// Prefix of the reply to `outcome` for an INIT that never arrived; the boot id follows.
pub const NEVER_SEEN: &str = "never seen since boot ";

/// The scope reserved for the protocol itself.
pub(crate) const RESERVED_SCOPE: &str = "$ztl";

/// Python's `None`: the original's text while no progress is known.
pub const NOTHING_KNOWN: &str = "None";

/// Begins the reason of a FAILED task whose end cannot be learned, such as one that was forwarded to
/// a server that was restarted: the task may still run. Clients take it for an unknown outcome
/// ([`Answer::UnknownOutcome`](crate::client::Answer::UnknownOutcome)).
pub const UNKNOWN_OUTCOME: &str = "unknown: ";

/// Why a request never reaches a handler; servers log it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RefusalOf {
    /// It is not a message.
    Protocol,
    /// Its scope is unknown.
    Scope,
    /// A limit of the server is reached; what its client is told.
    Limit(&'static str),
}

/// Names the reply texts and stores them in one string: an array of slices takes 8 bytes more for each.
macro_rules! texts {
    ($($name:ident => $text:expr,)*) => {
        /// Every reply text; the wording is in [`template`](Self::template).
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(crate) enum ReplyText {
            $($name,)*
        }

        /// Each text ends with a line feed.
        const TEXTS: &str = concat!($($text, "\n",)*);
    };
}

texts! {
    Words => "%",
    Threw => "Controller threw exception: %",
    Undecided => "Initiated task '#', nobody has taken it yet",
    Aborting => "aborting",
    True => "True",
    False => "False",
    UnknownProtocol => "Unknown protocol",
    UnknownScope => "No controller for scope: @",
    UnknownId => "Invalid ID '#'",
    UnknownIdAlone => "Invalid ID",
    Invalid => "Invalid request",
    ManyTasks => "too many tasks are running, wait for one to end",
    ManyWaiting => "too many requests are waiting, try again",
    ManyClients => "too many clients at a time, try again in a minute",
    NoMoreIds => "all task ids are used up; restart the server, without its journal if it has one",
    NoIdYet => "no task id is reserved, try again; the server's log says why",
    GivenUp => "this INIT was given up by its client",
    NumberTaken => "another INIT has this number",
    Settled => "settled by a later INIT",
    NeverSeen => "never seen since boot ^",
    Probed => concat!(
        "{ztl: 1, version: '",
        env!("CARGO_PKG_VERSION"),
        "', boot: ^%}}"
    ),
    InvalidReserved => "Invalid request: $ztl takes STATUS with the payload 'probe' or 'outcome N'",
}

impl ReplyText {
    /// The text with placeholders for parts of the [`Reply`]: `@` the scope, `!` the state, `#` the id, `^`
    /// the boot id, `%` the variable part.
    pub(crate) fn template(self) -> &'static str {
        let (mut text, mut rest) = ("", TEXTS);
        for _ in 0..=self as u8 {
            (text, rest) = split_at_mark(rest, '\n').unwrap_or_default();
        }
        text
    }
}

/// A reply, as a view; [`put`](Self::put) writes it.
#[derive(Clone, Copy)]
pub struct Reply<'a> {
    pub(crate) scope: &'a str,
    pub(crate) state: State,
    pub(crate) id: ReplyId<'a>,
    pub(crate) text: ReplyText,
    pub(crate) words: Words<'a>,
    /// Changes with each start of the server.
    pub(crate) boot: u32,
}

#[derive(Clone, Copy)]
pub(crate) enum ReplyId<'a> {
    Asked(Integer<'a>),
    Task(TaskId),
}

/// The variable part of a reply's text.
#[derive(Clone, Copy)]
pub(crate) enum Words<'a> {
    /// What a handler said.
    Said(&'a str),
    /// What the server reports about itself.
    Put(&'a dyn Put),
}

/// Writes itself to a sink.
pub(crate) trait Put {
    fn put(&self, sink: &mut dyn Sink);
}

impl<'a> Reply<'a> {
    /// The reply to a request that cannot be read: state 2, id -1, no scope.
    pub(crate) const fn refusal(boot: u32) -> Self {
        Self {
            scope: "",
            state: State::Rejected,
            id: ReplyId::Asked(Integer::MINUS_ONE),
            text: ReplyText::UnknownProtocol,
            words: Words::Said(""),
            boot,
        }
    }

    /// Sets the text to what a handler said.
    pub(crate) fn say(&mut self, words: &'a str) {
        self.text = ReplyText::Words;
        self.words = Words::Said(words);
    }

    /// Turns this into the reply to the INIT of `task`: accepted, or rejected with another state.
    pub(crate) fn decide(&mut self, told: State, task: TaskId, words: &'a str) {
        self.state = told;
        self.say(words);
        self.id = ReplyId::Task(task);
        if told != State::Accepted {
            self.id = ReplyId::Asked(Integer::MINUS_ONE);
        }
        if told == State::Failed {
            self.text = ReplyText::Threw;
        }
    }

    /// Why the request never reached a handler, if so.
    #[must_use]
    pub fn refusal_of(&self) -> Option<RefusalOf> {
        match self.text {
            ReplyText::UnknownProtocol => Some(RefusalOf::Protocol),
            ReplyText::UnknownScope => Some(RefusalOf::Scope),
            limit @ (ReplyText::ManyTasks | ReplyText::ManyWaiting | ReplyText::ManyClients) => {
                Some(RefusalOf::Limit(limit.template()))
            }
            _ => None,
        }
    }

    /// The reply's scope.
    #[must_use]
    pub fn scope(&self) -> &'a str {
        self.scope
    }

    /// The reply's state.
    #[must_use]
    pub fn state(&self) -> State {
        self.state
    }

    /// The task that the reply is about, if it has an id.
    #[must_use]
    pub fn task(&self) -> Option<TaskId> {
        match self.id {
            ReplyId::Asked(_) => None,
            ReplyId::Task(id) => Some(id),
        }
    }

    /// Writes the message to a sink.
    pub fn put(&self, sink: &mut dyn Sink) {
        self.fill("@;!;#;", sink);
        self.fill(self.text.template(), sink);
    }

    /// Writes a template and fills in its placeholders.
    fn fill(&self, template: &str, sink: &mut dyn Sink) {
        for byte in template.bytes() {
            match byte {
                b'@' => sink.put(self.scope.as_bytes()),
                b'!' => sink.put(&[b'0' + self.state.code()]),
                b'#' => match self.id {
                    ReplyId::Asked(id) => id.put(sink),
                    ReplyId::Task(id) => put_decimal(sink, id.get()),
                },
                b'^' => put_decimal(sink, self.boot),
                b'%' => match self.words {
                    Words::Said(words) => sink.put(words.as_bytes()),
                    Words::Put(words) => words.put(sink),
                },
                byte => sink.put(&[byte]),
            }
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
