//! Tasks without the link: for a ZeroMQ server in the same firmware, which stores the outcomes itself.

use ztl_core::link::LinkId;
use ztl_core::{Instant, State, TaskId};

use super::refusal::Refusal;
use super::runner::{TaskRunner, kept_result};
use crate::component::Components;

impl<C: Components, const TASKS: usize> TaskRunner<C, TASKS> {
    /// Starts a task on the component with this index.
    ///
    /// # Errors
    /// The reason for a refusal.
    pub(crate) fn start_local(
        &mut self,
        now: Instant,
        id: TaskId,
        component: u8,
        goal: &str,
    ) -> Result<(), &str> {
        match self.start(now, LinkId(id.get()), component, goal) {
            Ok(()) => Ok(()),
            Err(Refusal::ByComponent) => Err(&self.reason),
            Err(refusal) => Err(refusal.as_str()),
        }
    }

    /// Begins to abort a task.
    pub(crate) fn abort_local(&mut self, now: Instant, id: TaskId) {
        // An unknown task has ended, and its end was reported or will be.
        let _ = self.abort(LinkId(id.get()), now);
    }

    /// Reports each task that changed since the last call, and drops the ended ones.
    pub(crate) fn report_changes(&mut self, mut report: impl FnMut(TaskId, State, &str)) {
        for task in self.tasks.held_mut().filter(|task| task.is_due()) {
            task.changed = false;
            let end = task.end();
            let kept = kept_result(&self.components, task);
            if end.is_some() {
                task.forget();
            }
            // The text of a waiting task is its goal.
            let mut text = if task.waits() { "" } else { task.text.as_str() };
            if let Some(result) = kept {
                text = result;
            }
            if let Some(id) = TaskId::new(task.id.0) {
                report(id, end.unwrap_or(State::Accepted), text);
            }
        }
    }
}
