//! Controls a running server from other threads.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::access::{Access, CurrentAccess};
use super::limits::Limits;
use super::waker::Waker;

/// Controls a server from other threads.
#[derive(Clone)]
pub struct ServerHandle {
    pub(super) access: CurrentAccess,
    /// Limits to be applied by the server's thread.
    pub(super) limits: Arc<Mutex<Option<Limits>>>,
    pub(super) waker: Arc<Waker>,
}

impl ServerHandle {
    /// Ends the server, after it has answered the request it is serving.
    pub fn stop(&self) {
        self.waker.stop();
    }

    /// Whether the server's thread, which answers clients, completes a turn within `limit`.
    #[must_use]
    pub fn responds_within(&self, limit: Duration) -> bool {
        self.waker.turns_within(limit)
    }

    /// Changes who may use the server, also for clients that are connected; subscribers of readings stay.
    /// Returns `false` if that needs a new socket: with other server keys, or if the server was open to everyone.
    #[must_use]
    pub fn set_access(&self, access: Access) -> bool {
        self.access.change(access)
    }

    /// Changes the limits, as far as [`Limits::for_running`] says. Running tasks stay.
    pub fn set_limits(&self, limits: Limits) {
        let mut next = self.limits.lock().unwrap_or_else(PoisonError::into_inner);
        *next = Some(limits);
        drop(next);
        self.waker.on_posted();
    }
}

impl std::fmt::Debug for ServerHandle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ServerHandle")
    }
}

/// A server on a thread of its own; stops when dropped.
#[derive(Debug)]
pub struct RunningServer {
    pub(super) endpoint: String,
    pub(super) handle: ServerHandle,
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
        self.handle.stop();
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}
