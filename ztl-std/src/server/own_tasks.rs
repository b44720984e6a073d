//! Tasks that no client asked for: a handler finds them running, such as those that a device starts itself.

use ztl_core::memory::Scope;

use super::reporter::{Mailbox, Ready, Report, ReservedId};
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
        let report = Report::Reserve(self.scope, Ready(Box::new(ready)));
        // No task has this id yet.
        self.mailbox.post(random::FIRST, report);
    }
}

impl std::fmt::Debug for OwnTasks {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("OwnTasks").field(&self.scope).finish()
    }
}
