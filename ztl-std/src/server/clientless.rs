//! Takes tasks that no client asked for into the task table.

use ztl_core::memory::{Memory as _, Scope};
use ztl_core::tasks::{StoredText as _, Task, Tasks as _};
use ztl_core::{State, TaskId};

use super::clock::now;
use super::engine::Engine;
use super::reporter::Ready;
use super::task_table::HeapText;

/// The texts of a task without a client until it reports progress.
const BY_DEVICE: &str = "started by the device";
const BY_GATEWAY: &str = "started by the gateway";

impl Engine {
    /// Reserves an id for a task of a handler itself.
    pub(super) fn reserve(&mut self, Ready(ready): Ready) {
        if let Some(id) = self.dispatcher.next_id() {
            self.dispatcher.skip_to(id);
            self.dispatcher.memory().give(id);
            ready(id);
        }
    }

    /// Takes a task that runs into the task table. It is admitted even if clients could start no further task, because it runs already.
    pub(super) fn on_begun(&mut self, id: TaskId, scope: Scope, payload: &str, by_device: bool) {
        let text = if by_device { BY_DEVICE } else { BY_GATEWAY };
        let mut task = Task::<_, HeapText>::new(scope);
        task.state = State::Accepted;
        task.text.set(text);
        let tasks = self.dispatcher.memory_mut().tasks_mut();
        tasks.make_room();
        tasks.insert(id, task);
        let memory = self.dispatcher.memory_mut();
        memory.note_payload(id, payload, now());
        if by_device {
            memory.note_by_device(id);
        }
        #[cfg(feature = "publish")]
        if let Some(events) = &mut self.events {
            let name = self.dispatcher.memory().scope_name(scope);
            events.on_asked(name, id, payload, None);
            events.on_changed(name, id, State::Accepted, text);
        }
    }
}
