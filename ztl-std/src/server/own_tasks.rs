//! Tasks that no client asked for: a handler finds them running, such as those that a device starts itself.

use ztl_core::TaskId;
use ztl_core::memory::Scope;

use super::reporter::{Mailbox, Ready, Report, TaskReporter};
use crate::random;

/// Gives a scope's handler ids for tasks that no client asked for.
#[derive(Clone)]
pub struct OwnTasks {
    scope: Scope,
    mailbox: Mailbox,
}

impl OwnTasks {
    pub(super) const fn new(scope: Scope, mailbox: Mailbox) -> Self {
        Self { scope, mailbox }
    }

    /// Reserves an id. `ready` gets it on the server's thread, so it must return at once; it is dropped if all ids are used
    /// up, or the server has ended.
    pub fn reserve(&self, ready: impl FnOnce(ReservedId) + Send + 'static) {
        let (scope, mailbox) = (self.scope, self.mailbox.clone());
        let ready = move |id| ready(ReservedId { id, scope, mailbox });
        let report = Report::Reserve(Ready(Box::new(ready)));
        // No task has this id yet.
        self.mailbox.post(random::FIRST, report);
    }
}

impl std::fmt::Debug for OwnTasks {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("OwnTasks").field(&self.scope).finish()
    }
}

/// The id of a task that no client knows yet.
pub struct ReservedId {
    id: TaskId,
    scope: Scope,
    mailbox: Mailbox,
}

impl ReservedId {
    /// The id.
    #[must_use]
    pub const fn id(&self) -> TaskId {
        self.id
    }

    /// Shows the running task to clients. `payload` is the payload of the INIT that would have started it.
    #[must_use = "dropping the reporter ends the task"]
    pub fn begin(self, payload: String) -> TaskReporter {
        self.show(payload, true)
    }

    /// The same for a task that the handler starts, not a device.
    #[must_use = "dropping the reporter ends the task"]
    pub fn begin_here(self, payload: String) -> TaskReporter {
        self.show(payload, false)
    }

    fn show(self, payload: String, by_device: bool) -> TaskReporter {
        let begun = Report::Begun(self.scope, payload, by_device);
        self.mailbox.post(self.id, begun);
        TaskReporter::new(self.id, self.mailbox, None)
    }
}

impl std::fmt::Debug for ReservedId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("ReservedId").field(&self.id).finish()
    }
}
