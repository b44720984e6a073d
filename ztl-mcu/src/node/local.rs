//! A node's tasks without the link: for a server in the same firmware, which keeps their ends itself.

use ztl_core::link::LinkId;
use ztl_core::{Instant, State, TaskId};

use super::Components;
use super::commands::NOT_TAKEN;
use super::runner::Runner;

impl<C: Components, const TASKS: usize> Runner<C, TASKS> {
    /// Starts a task on the component of this number.
    ///
    /// # Errors
    /// Why it is refused.
    pub(crate) fn start_local(
        &mut self,
        now: Instant,
        id: TaskId,
        component: u8,
        goal: &str,
    ) -> Result<(), &str> {
        match self.start(now, LinkId(id.get()), component, goal) {
            Err(NOT_TAKEN) => Err(&self.reason),
            started => started,
        }
    }

    /// Stops a task, or begins to.
    pub(crate) fn abort_local(&mut self, now: Instant, id: TaskId) {
        // One that has ended was told about, or will be.
        let _ = self.abort(LinkId(id.get()), now);
    }

    /// Tells of each task of which something has changed since the last time; what has ended is let go.
    pub(crate) fn tell_news(&mut self, mut tell: impl FnMut(TaskId, State, &str)) {
        for task in self.tasks.held_mut().filter(|task| task.is_due()) {
            task.news = false;
            let end = task.end();
            if end.is_some() {
                task.forget();
            }
            // One that waits keeps its goal there.
            let text = if task.waits() { "" } else { task.text.as_str() };
            if let Some(id) = TaskId::new(task.id.0) {
                tell(id, end.unwrap_or(State::Accepted), text);
            }
        }
    }
}
