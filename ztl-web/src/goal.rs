//! A goal that a client has asked for: what every thread that deals with it shares.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

use ztl_std::RemoteId;

use crate::clock;
use crate::robots::Target;

/// How long after its arrival a goal may be sent to its robot, in ms. The client can demand less.
pub(crate) const LATEST_MS: u64 = 5000;
/// After the last moment at which a goal may be sent, how long its answer may take.
const ANSWER_MS: u64 = 5000;

/// A goal that was asked for.
pub(crate) struct Goal {
    pub(crate) target: Target,
    pub(crate) goal: String,
    /// Who asked for it.
    pub(crate) by: String,
    /// Until when it may be sent, by the console's clock.
    pub(crate) not_after_ms: u64,
    id: OnceLock<RemoteId>,
    cancelled: AtomicBool,
    settled: AtomicBool,
    ended: AtomicBool,
    left: AtomicBool,
    lost: AtomicBool,
}

impl Goal {
    pub(crate) fn new(target: Target, goal: String, by: String, not_after_ms: u64) -> Self {
        Self {
            target,
            goal,
            by,
            not_after_ms,
            id: OnceLock::new(),
            cancelled: AtomicBool::new(false),
            settled: AtomicBool::new(false),
            ended: AtomicBool::new(false),
            left: AtomicBool::new(false),
            lost: AtomicBool::new(false),
        }
    }

    /// The id of its task, once the server has told it.
    pub(crate) fn id(&self) -> Option<&RemoteId> {
        self.id.get()
    }

    pub(crate) fn set_id(&self, id: RemoteId) {
        // The goal's own thread sets it once.
        let _ = self.id.set(id);
        self.settle();
    }

    /// Notes that no task can start from now on whose id is not known.
    pub(crate) fn settle(&self) {
        self.settled.store(true, Ordering::SeqCst);
    }

    pub(crate) fn is_settled(&self) -> bool {
        self.settled.load(Ordering::SeqCst)
    }

    /// Keeps it from being sent, or lets its thread abort it when it is accepted.
    pub(crate) fn give_up(&self) {
        self.cancelled.store(true, Ordering::SeqCst);
    }

    pub(crate) fn is_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::SeqCst)
    }

    /// Whether it is too late to send it.
    pub(crate) fn is_late(&self) -> bool {
        clock::now_ms() > self.not_after_ms
    }

    /// Whether a task of which nobody has heard yet is to be aborted.
    pub(crate) fn is_answer_late(&self) -> bool {
        clock::now_ms() > self.not_after_ms.saturating_add(ANSWER_MS)
    }

    /// Notes that nothing is waited for any more.
    pub(crate) fn end(&self) {
        self.ended.store(true, Ordering::SeqCst);
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.ended.load(Ordering::SeqCst)
    }

    /// Notes that its task may run although nobody waits for its final state any more.
    pub(crate) fn lose(&self) {
        self.lost.store(true, Ordering::SeqCst);
    }

    pub(crate) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::SeqCst)
    }

    /// Notes whether its client has gone: its thread then does not wait for a server that is gone, too.
    pub(crate) fn set_left(&self, left: bool) {
        self.left.store(left, Ordering::SeqCst);
    }

    pub(crate) fn is_left(&self) -> bool {
        self.left.load(Ordering::SeqCst)
    }
}
