//! Backpressure from a device's thread to the thread that reads its line.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Most chunks of at most 1 KiB in the queue.
const MAX_CHUNKS: usize = 64;

/// Allows one chunk to be queued, until it is dropped.
pub(in crate::gateway) struct Permit(Arc<Backpressure>);

/// Limits how many chunks are queued for a device's thread.
#[derive(Default)]
pub(super) struct Backpressure {
    chunks: Mutex<usize>,
    fewer: Condvar,
}

impl Backpressure {
    /// Waits for a moment until another chunk may be queued.
    pub(super) fn permit(self: &Arc<Self>) -> Option<Permit> {
        let chunks = self.chunks.lock().unwrap_or_else(PoisonError::into_inner);
        let full = |chunks: &mut usize| *chunks >= MAX_CHUNKS;
        let waited = self
            .fewer
            .wait_timeout_while(chunks, Duration::from_millis(50), full);
        let (mut chunks, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        if timeout.timed_out() {
            return None;
        }
        *chunks += 1;
        Some(Permit(Arc::clone(self)))
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut chunks = self.0.chunks.lock().unwrap_or_else(PoisonError::into_inner);
        *chunks = chunks.saturating_sub(1);
        self.0.fewer.notify_one();
    }
}
