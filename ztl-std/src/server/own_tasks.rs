//! Tasks that no client asked for: a handler finds them running, such as those that a device starts itself.

use ztl_core::memory::{Memory as _, Scope};
use ztl_core::tasks::{StoredText as _, Task, Tasks as _};
use ztl_core::{State, TaskId};

use super::clock::now;
use super::engine::Engine;
use super::reporter::{Mailbox, Ready, Report, TaskReporter};
use super::task_table::HeapText;
use crate::random;

/// The text of a task without a client until it reports progress.
const TEXT: &str = "started by the device";

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
        let begun = Report::Begun(self.scope, payload);
        self.mailbox.post(self.id, begun);
        TaskReporter::new(self.id, self.mailbox, None)
    }
}

impl std::fmt::Debug for ReservedId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("ReservedId").field(&self.id).finish()
    }
}

impl Engine {
    /// Reserves an id for a task of a handler itself.
    pub(super) fn reserve(&mut self, scope: Scope, Ready(ready): Ready) {
        if let Some(id) = self.dispatcher.next_id() {
            self.dispatcher.skip_to(id);
            ready(ReservedId {
                id,
                scope,
                mailbox: self.mailbox.clone(),
            });
        }
    }

    /// Takes a task that runs into the task table. It is admitted even if clients could start no further task, because it runs already.
    pub(super) fn on_begun(&mut self, id: TaskId, scope: Scope, payload: &str) {
        let mut task = Task::<_, HeapText>::new(scope);
        task.state = State::Accepted;
        task.text.set(TEXT);
        let tasks = self.dispatcher.memory_mut().tasks_mut();
        tasks.make_room();
        tasks.insert(id, task);
        let memory = self.dispatcher.memory_mut();
        memory.note_payload(id, payload, now());
        memory.note_by_device(id);
        #[cfg(feature = "publish")]
        if let Some(events) = &mut self.events {
            let name = self.dispatcher.memory().scope_name(scope);
            events.on_asked(name, id, payload, None);
            events.on_changed(name, id, State::Accepted, TEXT);
        }
    }
}
