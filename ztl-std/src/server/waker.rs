//! Wakes the server's thread, which sleeps while it waits for a message.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

#[cfg(feature = "libzmq")]
use crate::libzmq::server::Waking;

/// How a sleeping thread is woken.
pub(crate) enum Signal {
    Native(mio::Waker),
    #[cfg(feature = "libzmq")]
    Libzmq(Waking),
}

impl Signal {
    fn wake(&self) {
        match self {
            Self::Native(waker) => {
                let _ = waker.wake();
            }
            #[cfg(feature = "libzmq")]
            Self::Libzmq(waking) => waking.wake(),
        }
    }
}

/// Wakes the server's thread.
pub(crate) struct Waker {
    /// The server's thread sleeps or is about to, and has not been woken.
    asleep: AtomicBool,
    /// Something was posted since the thread last looked.
    posted: AtomicBool,
    /// Open [`WakeBatch`]es; dropping the last one wakes the thread.
    batches: AtomicUsize,
    stop: AtomicBool,
    signal: Signal,
    /// Someone waits for the thread's next turn.
    probed: AtomicBool,
    /// Turns of the thread that were waited for.
    turns: Mutex<u64>,
    turned: Condvar,
}

impl Waker {
    /// Wakes a thread that receives `signal`.
    pub(crate) fn new(signal: Signal) -> Arc<Self> {
        Arc::new(Self {
            asleep: AtomicBool::new(false),
            posted: AtomicBool::new(false),
            batches: AtomicUsize::new(0),
            stop: AtomicBool::new(false),
            signal,
            probed: AtomicBool::new(false),
            turns: Mutex::new(0),
            turned: Condvar::new(),
        })
    }

    /// Something was posted. Wakes the thread, unless a batch is open.
    pub(crate) fn on_posted(&self) {
        self.posted.store(true, Ordering::SeqCst);
        if self.batches.load(Ordering::SeqCst) == 0 {
            self.wake();
        }
    }

    fn wake(&self) {
        if self.asleep.swap(false, Ordering::SeqCst) {
            self.signal.wake();
        }
    }

    /// The server's thread is about to sleep: returns whether it may, which is so if nothing was posted
    /// since [`on_awake`](Self::on_awake).
    pub(crate) fn may_sleep(&self) -> bool {
        self.asleep.store(true, Ordering::SeqCst);
        if self.posted.load(Ordering::SeqCst) {
            self.asleep.store(false, Ordering::SeqCst);
        }
        self.asleep.load(Ordering::SeqCst)
    }

    /// The server's thread has woken, and is about to look at all that was posted.
    pub(crate) fn on_awake(&self) {
        self.asleep.store(false, Ordering::SeqCst);
        self.posted.store(false, Ordering::SeqCst);
        if self.probed.swap(false, Ordering::SeqCst) {
            let mut turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
            *turns = turns.wrapping_add(1);
            self.turned.notify_all();
        }
    }

    /// Whether the server's thread begins a turn within `limit`.
    pub(super) fn turns_within(&self, limit: Duration) -> bool {
        let turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        let before = *turns;
        self.probed.store(true, Ordering::SeqCst);
        self.on_posted();
        let waited = self
            .turned
            .wait_timeout_while(turns, limit, |turns| *turns == before);
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }

    pub(crate) fn stop(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.posted.store(true, Ordering::SeqCst);
        self.wake();
    }

    pub(crate) fn stopped(&self) -> bool {
        self.stop.load(Ordering::SeqCst)
    }

    /// Opens a batch.
    pub(super) fn batch(self: &Arc<Self>) -> WakeBatch {
        self.batches.fetch_add(1, Ordering::SeqCst);
        WakeBatch(Arc::clone(self))
    }
}

/// While held, reports do not wake the server; the last one that is dropped wakes it if there were any. A
/// task holds one while it waits for a thread, so that the server takes the reports of quick tasks together.
/// Without it, the rate of INITs (16 clients, two cores) is about 10 % lower.
#[must_use = "dropping it wakes the server"]
pub(crate) struct WakeBatch(Arc<Waker>);

impl Drop for WakeBatch {
    fn drop(&mut self) {
        let last = self.0.batches.fetch_sub(1, Ordering::SeqCst) == 1;
        if last && self.0.posted.load(Ordering::SeqCst) {
            self.0.wake();
        }
    }
}
