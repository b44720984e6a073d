//! What other threads hold of a server that runs: they end it, feel its pulse, or own it.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::Limits;
use super::access::{Access, Present};
use super::report::Waker;

/// Ends a server from another thread.
#[derive(Clone)]
pub struct Stopper(pub(super) Arc<Waker>);

impl Stopper {
    /// Ends the server; what it serves at the moment is still answered.
    pub fn stop(&self) {
        self.0.stop();
    }
}

impl std::fmt::Debug for Stopper {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Stopper")
    }
}

/// Changes a server that runs, from another thread.
#[derive(Clone)]
pub struct Control {
    pub(super) access: Present,
    pub(super) limits: Arc<Mutex<Option<Limits>>>,
    pub(super) waker: Arc<Waker>,
}

impl Control {
    /// Changes who may use the server, for those who are connected, too; subscribers of readings stay. Says
    /// whether that was possible: with other keys of its own, or where everybody was let in so far, a server has
    /// to be bound anew.
    #[must_use]
    pub fn set_access(&self, access: Access) -> bool {
        self.access.change(access)
    }

    /// Changes what the server allows at most, as far as [`Limits::for_running`] says. Tasks that run stay.
    pub fn set_limits(&self, limits: Limits) {
        let mut next = self.limits.lock().unwrap_or_else(PoisonError::into_inner);
        *next = Some(limits);
        drop(next);
        self.waker.on_posted();
    }
}

impl std::fmt::Debug for Control {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Control")
    }
}

/// Feels whether a server's thread goes its rounds, in which it answers its clients.
#[derive(Clone)]
pub struct Pulse(pub(super) Arc<Waker>);

impl Pulse {
    /// Whether it does so within `limit`.
    #[must_use]
    pub fn is_felt(&self, limit: Duration) -> bool {
        self.0.beats(limit)
    }
}

impl std::fmt::Debug for Pulse {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Pulse")
    }
}

/// A server on a thread of its own; stops when it is dropped.
#[derive(Debug)]
pub struct RunningServer {
    pub(super) endpoint: String,
    pub(super) stopper: Stopper,
    pub(super) thread: Option<JoinHandle<()>>,
}

impl RunningServer {
    /// Where it listens.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Whether its thread still serves.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.thread
            .as_ref()
            .is_some_and(|thread| !thread.is_finished())
    }
}

impl Drop for RunningServer {
    fn drop(&mut self) {
        self.stopper.stop();
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
