//! A task that is not to outlive the part of a program that asked for it.

use super::{RemoteId, RemoteTask};

/// Aborts its task when it is dropped, unless it was [released](Self::release).
#[derive(Debug)]
#[must_use = "dropped at once, it aborts the task at once"]
pub struct TaskGuard {
    /// A client of its own: the other one may be busy.
    remote: RemoteTask,
    id: Option<RemoteId>,
}

impl RemoteTask {
    /// Aborts this task when the guard is dropped: also by `?` or a panic. A guard is another
    /// client, so that this one stays free to be used. Dropping it takes as long as
    /// [`abort`](Self::abort) does.
    pub fn guard(&self, id: impl Into<RemoteId>) -> TaskGuard {
        TaskGuard {
            remote: self.clone(),
            id: Some(id.into()),
        }
    }
}

impl TaskGuard {
    /// The task goes on, or has ended: it is not aborted.
    pub fn release(mut self) {
        self.id = None;
    }
}

impl Drop for TaskGuard {
    fn drop(&mut self) {
        if let Some(id) = self.id.take() {
            // There is nobody to be told; what went wrong is logged.
            let _ = self.remote.send_abort(id);
        }
    }
}
