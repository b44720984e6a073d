//! Aborts a task when the part of a program that started it ends.

use super::remote_task::RemoteTask;
use crate::remote_id::RemoteId;

/// Aborts its task when dropped, unless it was [released](Self::release).
#[derive(Debug)]
#[must_use = "dropping it aborts the task"]
pub struct AbortOnDrop {
    /// A client of its own, since the other one may be busy.
    remote: RemoteTask,
    id: Option<RemoteId>,
}

impl RemoteTask {
    /// Returns a value that aborts a task when it is dropped, also by `?` or a panic. It is a client of its
    /// own, so this one stays free. Dropping it takes as long as [`abort`](Self::abort).
    pub fn abort_on_drop(&self, id: impl Into<RemoteId>) -> AbortOnDrop {
        AbortOnDrop {
            remote: self.clone(),
            id: Some(id.into()),
        }
    }
}

impl AbortOnDrop {
    /// Lets the task continue.
    pub fn release(mut self) {
        self.id = None;
    }
}

impl Drop for AbortOnDrop {
    fn drop(&mut self) {
        if let Some(id) = self.id.take() {
            // The client has logged any error.
            let _ = self.remote.send_abort(id);
        }
    }
}
