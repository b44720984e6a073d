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

    /// A task of which something has changed since it was told; to be followed by
    /// [`told`](Self::told).
    pub(crate) fn news(&self) -> Option<(TaskId, State, &str)> {
        let task = self.tasks.held().find(|task| task.is_due())?;
        // One that waits keeps its goal there.
        let text = if task.waits() { "" } else { task.text.as_str() };
        let state = task.end().unwrap_or(State::Accepted);
        Some((TaskId::new(task.id.0)?, state, text))
    }

    /// What was new of a task is told; its end is let go.
    pub(crate) fn told(&mut self, id: TaskId) {
        let id = LinkId(id.get());
        if let Some(task) = self.tasks.get_mut(id) {
            task.news = false;
        }
        self.tasks.acknowledge(id);
    }
}
