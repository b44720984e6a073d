//! The state of a dispatcher, and of the request that it handles.

use super::interface::Action;
use crate::envelope::Envelope;
use crate::integer::Integer;
use crate::memory::Awaited;
use crate::reply::Reply;
use crate::{Instant, TaskId};

/// The rules of a server, over any [`Memory`](crate::memory::Memory).
///
/// *Inputs*: [`handle_request`](Self::handle_request), [`handle_event`](Self::handle_event),
/// [`handle_timeout`](Self::handle_timeout). *Outputs*: replies through the `out` argument, immediately or
/// later, and an [`Action`] for the handler. *Next wake-up*: [`poll_timeout`](Self::poll_timeout); ask again
/// after each input.
///
/// For each reply that it sends and each task that it drops, a call searches the held replies, the tasks and
/// the stored INITs. `probe` and other questions write what the memory holds. So the memory's capacities
/// bound the work; a memory with indexes makes the searches short.
// The order of fields saves 136 bytes in the image `standard`.
#[derive(Debug)]
#[repr(C)]
pub struct Dispatcher<M> {
    /// Time of the current input.
    pub(super) now: Instant,
    /// The durations of [`Config`](super::Config) in microseconds, converted once.
    pub(super) hold: u64,
    pub(super) early: u64,
    pub(super) keep: u64,
    pub(super) boot: u32,
    pub(super) next: Option<TaskId>,
    pub(super) memory: M,
}

/// A request in progress: its reply is a rejection until a rule replaces it.
///
/// The rules fill in one shared value, because returning values costs flash on a Cortex-M0.
pub(super) struct Asked<'r, 'a> {
    pub(super) envelope: Option<&'r Envelope>,
    /// Number from which on an INIT of this client is new, if the client has no record.
    pub(super) new_from: u64,
    /// The reply, unless the request waits.
    pub(super) reply: Reply<'r>,
    /// The reply waits for this event of this task, until `deadline`.
    pub(super) wait: Option<(TaskId, Awaited)>,
    pub(super) deadline: Instant,
    pub(super) action: Option<Action<'a>>,
}

/// The number after `word` in a payload.
pub(super) fn argument(payload: &str, word: &str) -> Option<u64> {
    let number = Integer::parse(payload.strip_prefix(word)?).ok()?.natural();
    (number != u64::MAX).then_some(number)
}
