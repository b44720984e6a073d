//! Jobs on threads of their own, for kinds that block.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::kind::{Effect, Job, JobContext, Outcome, STOP_TIME, Start, StopReason};

struct ThreadJob {
    abort: Arc<AtomicBool>,
    /// When the server stops without waiting for the thread.
    leave_at: Option<Instant>,
}

/// Runs `work` on a thread. It may send progress through the context, and ends early when the flag is set.
pub(crate) fn start(
    task: JobContext,
    work: impl FnOnce(&JobContext, &AtomicBool) -> Outcome + Send + 'static,
) -> Start {
    let abort = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&abort);
    let thread = std::thread::Builder::new().name(format!("ztl-task-{}", task.id));
    let spawned = thread.spawn(move || {
        let outcome = work(&task, &flag);
        task.effect(Effect::End(outcome));
    });
    match spawned {
        Ok(_) => Start::Running(Box::new(ThreadJob {
            abort,
            leave_at: None,
        })),
        Err(error) => Start::Ended(Outcome::Rejected(format!("cannot start a thread: {error}"))),
    }
}

impl Job for ThreadJob {
    fn stop(&mut self, now: Instant, why: StopReason, _: &mut Vec<Effect>) {
        self.abort.store(true, Ordering::Relaxed);
        if why == StopReason::Server {
            self.leave_at = now.checked_add(STOP_TIME);
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.leave_at
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.leave_at.is_some_and(|at| at <= now) {
            effects.push(Effect::Leave);
        }
    }
}
