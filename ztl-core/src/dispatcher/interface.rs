//! What goes into a dispatcher, and the actions that come out.

use crate::TaskId;
use crate::memory::Scope;

/// The body of a request, as received over ZeroMQ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Body<'a> {
    /// One frame, as every client sends it.
    One(&'a [u8]),
    /// Several frames, which is invalid (`docs/protocol.md` [1.4]).
    Several,
}

/// An action for a scope's handler, which reports back through
/// [`Dispatcher::handle_event`](super::Dispatcher::handle_event).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Action<'a> {
    /// Start this task, or reject it.
    Start {
        /// The id assigned to it.
        id: TaskId,
        /// The scope it was sent to.
        scope: Scope,
        /// The INIT's payload, unchanged.
        payload: &'a str,
    },
    /// Abort this task, or reject the ABORT.
    Abort {
        /// The task.
        id: TaskId,
        /// The scope it runs in.
        scope: Scope,
    },
}

/// A handler's report about a task. The dispatcher ignores reports that can no longer change anything: a
/// second final state, progress after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum TaskEvent<'a> {
    /// The task is accepted; `reply` answers the INIT.
    Accepted {
        /// Text for the client.
        reply: &'a str,
    },
    /// The task is rejected; nothing was done.
    Rejected {
        /// What is wrong, and what would be right.
        reason: &'a str,
    },
    /// The task is rejected in the form in which the original reports an exception of its controller: state
    /// 3 and `Controller threw exception: …`.
    Threw {
        /// The exception's message.
        message: &'a str,
    },
    /// Progress; a later one replaces it.
    Progress {
        /// Text for the client.
        text: &'a str,
    },
    /// The goal is reached.
    Completed {
        /// The result.
        result: &'a str,
    },
    /// The goal will not be reached.
    Failed {
        /// The cause.
        reason: &'a str,
    },
    /// The task has stopped as requested.
    Aborted {
        /// Where or why it stopped.
        result: &'a str,
    },
    /// The task cannot be aborted and continues.
    AbortRejected,
}
