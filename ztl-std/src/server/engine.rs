//! What the server's thread owns.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use ztl_core::dispatcher::Dispatcher;
use ztl_core::reply::Reply;
use ztl_core::{Instant, Request, TaskId};

use super::client_liveness::ClientLiveness;
use super::dropped::DroppedLog;
use super::handler::TaskHandler;
use super::incoming::ReturnPath;
use super::limits::Limits;
use super::memory::ServerMemory;
use super::reporter::{Claim, Inbox, Mailbox};
use super::router::Router;
#[cfg(feature = "publish")]
use super::task_events::TaskEvents;
use super::waker::Waker;
use crate::rate_limit::RateLimit;

/// Sees the requests about tasks.
pub(super) type Observer = Box<dyn FnMut(Request, TaskId, &str) + Send>;

/// The server's sockets and state. [`rounds`](super::rounds) and [`requests`](super::requests) run it.
pub(super) struct Engine {
    pub(super) router: Router,
    pub(super) dispatcher: Dispatcher<ServerMemory>,
    /// By scope.
    pub(super) handlers: Vec<Box<dyn TaskHandler>>,
    pub(super) waker: Arc<Waker>,
    pub(super) mailbox: Mailbox,
    pub(super) inbox: Inbox,
    pub(super) clients: ClientLiveness,
    /// INITs to reject at this time, with this reason, unless the gateway journals them before.
    pub(super) claims: BTreeMap<(Instant, TaskId), (Claim, &'static str)>,
    /// Limits to be applied in the next turn.
    pub(super) next_limits: Arc<Mutex<Option<Limits>>>,
    pub(super) observer: Option<Observer>,
    /// Publishes what happens to tasks.
    #[cfg(feature = "publish")]
    pub(super) events: Option<TaskEvents>,
    pub(super) dropped: DroppedLog,
    /// Limits the log lines about refused requests, because anyone can send any number of them.
    pub(super) refusals: RateLimit,
    /// Whether it was logged that all task ids are used up.
    pub(super) logged_used_up: bool,
    /// Whether the last turn took a report.
    pub(super) reported: bool,
    /// While the server stops: tasks whose end no client has been told yet.
    pub(super) untold: Vec<TaskId>,
    /// Whether a handler was given a task since `all_started` was called.
    pub(super) started: bool,
}

/// Sends a reply; a task whose end it tells is no longer `untold`.
pub(super) fn answer(
    router: &mut Router,
    untold: &mut Vec<TaskId>,
    path: ReturnPath,
    reply: &Reply<'_>,
) {
    if reply.state().is_final() {
        untold.retain(|id| reply.task() != Some(*id));
    }
    router.answer(path, reply);
}
