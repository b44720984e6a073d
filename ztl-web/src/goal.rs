//! A goal that a client has asked for: what every thread that deals with it shares.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use ztl_std::RemoteId;

use crate::robots::Target;

/// A goal that was asked for.
pub(crate) struct Goal {
    pub(crate) target: Target,
    pub(crate) goal: String,
    /// Who asked for it.
    pub(crate) by: String,
    id: OnceLock<RemoteId>,
    cancelled: AtomicBool,
    aborting: AtomicBool,
    left: AtomicBool,
}

impl Goal {
    pub(crate) fn new(target: Target, goal: String, by: String) -> Self {
        Self {
            target,
            goal,
            by,
            id: OnceLock::new(),
            cancelled: AtomicBool::new(false),
            aborting: AtomicBool::new(false),
            left: AtomicBool::new(false),
        }
    }

    /// The id of its task, once the server has told it.
    pub(crate) fn id(&self) -> Option<&RemoteId> {
        self.id.get()
    }

    pub(crate) fn set_id(&self, id: RemoteId) {
        // The goal's own thread sets it once.
        let _ = self.id.set(id);
    }

    /// Keeps it from being sent, or lets its thread abort it when it is accepted.
    pub(crate) fn give_up(&self) {
        self.cancelled.store(true, Ordering::SeqCst);
    }

    pub(crate) fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::SeqCst)
    }

    /// Whether the caller is to send an ABORT: no other one is on its way.
    pub(crate) fn begin_abort(&self) -> bool {
        !self.aborting.swap(true, Ordering::SeqCst)
    }

    pub(crate) fn end_abort(&self) {
        self.aborting.store(false, Ordering::SeqCst);
    }

    /// Notes that its client has gone, so that its thread does not wait for a server that is gone, too.
    pub(crate) fn leave(&self) {
        self.left.store(true, Ordering::SeqCst);
    }

    pub(crate) fn is_left(&self) -> bool {
        self.left.load(Ordering::SeqCst)
    }
}
