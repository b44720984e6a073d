//! Threads that answer queries, of which a few wait for the next ones.

use std::sync::atomic::Ordering;
use std::sync::mpsc::{SendError, Sender, channel};
use std::sync::{Arc, MutexGuard, PoisonError};

use super::Shared;
use super::requests::{MOST_ABORTS, MOST_WAITING};

/// Most queries at a time; each has a thread. Beside requests and ABORTs that wait (`requests.rs`), there is room for `stop`.
const MOST: usize = MOST_WAITING + MOST_ABORTS + 64;
/// Most threads that wait for a query: starting one takes longer than to wake one.
const MOST_IDLE: usize = 4;

/// What a thread does.
pub(super) type Job = (Arc<Shared>, Box<dyn FnOnce(&Arc<Shared>) + Send>);

/// Does this job, and then others, until there are enough threads or the agent ends.
fn work(job: Job) {
    let mut next = Some(job);
    while let Some((shared, act)) = next.take() {
        act(&shared);
        shared.busy.fetch_sub(1, Ordering::SeqCst);
        let (sender, jobs) = channel();
        let mut idle = shared.idle();
        if idle.len() >= MOST_IDLE {
            return;
        }
        idle.push(sender);
        drop(idle);
        // While it waits, it does not keep the agent.
        drop(shared);
        next = jobs.recv().ok();
    }
}

impl Shared {
    fn idle(&self) -> MutexGuard<'_, Vec<Sender<Job>>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Acts on a thread of its own, unless there are too many; returns whether it does.
    pub(super) fn spawn_busy(
        self: &Arc<Self>,
        act: impl FnOnce(&Arc<Self>) + Send + 'static,
    ) -> bool {
        if self.busy.fetch_add(1, Ordering::SeqCst) < MOST {
            let mut job: Job = (Arc::clone(self), Box::new(act));
            // The one that waits the shortest is woken the fastest.
            let worker = self.idle().pop();
            if let Some(worker) = worker {
                match worker.send(job) {
                    Ok(()) => return true,
                    Err(SendError(unsent)) => job = unsent,
                }
            }
            let thread = std::thread::Builder::new().name("ztl-fleet-query".to_owned());
            if thread.spawn(move || work(job)).is_ok() {
                return true;
            }
        }
        self.busy.fetch_sub(1, Ordering::SeqCst);
        false
    }
}
