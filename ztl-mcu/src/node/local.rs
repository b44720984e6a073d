//! A node's tasks without the link: for a server in the same firmware, which keeps their ends itself.

use ztl_core::link::LinkId;
use ztl_core::{Instant, State, TaskId};

use super::commands::NOT_TAKEN;
use super::tasks::Wanted;
use super::{Components, Identity, Inner};

/// The components of a node, and their tasks by the same rules, with no room for frames.
#[derive(Debug)]
pub(crate) struct LocalTasks<'a, C, const TASKS: usize>(Inner<'a, C, TASKS, 0>);

impl<'a, C: Components, const TASKS: usize> LocalTasks<'a, C, TASKS> {
    pub(crate) const fn new(identity: Identity<'a>, components: C) -> Self {
        Self(Inner::new(identity, components))
    }

    /// Starts a task on the component of this number.
    ///
    /// # Errors
    /// Why it is refused.
    pub(crate) fn start(
        &mut self,
        now: Instant,
        id: TaskId,
        component: u8,
        goal: &str,
    ) -> Result<(), &str> {
        let wanted = Wanted {
            task: LinkId(id.get()),
            component,
            goal,
            before_ms: u64::MAX,
        };
        match self.0.start(&wanted, now) {
            Err(NOT_TAKEN) => Err(&self.0.reason),
            started => started,
        }
    }

    /// Stops a task, or begins to.
    pub(crate) fn abort(&mut self, now: Instant, id: TaskId) {
        // One that has ended was told about, or will be.
        let _ = self.0.abort(LinkId(id.get()), now);
    }

    /// Moves the components on.
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        self.0.handle_timeout(now);
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do.
    pub(crate) fn next_move(&self, now: Instant) -> Option<Instant> {
        Some(self.0.next_move(now)).filter(|at| *at != Instant::NEVER)
    }

    /// A task of which something has changed since it was told; to be followed by
    /// [`told`](Self::told).
    pub(crate) fn news(&self) -> Option<(TaskId, State, &str)> {
        let task = self.0.tasks.held().find(|task| task.is_due())?;
        // One that waits keeps its goal there.
        let text = if task.waits() { "" } else { task.text.as_str() };
        let state = task.end().unwrap_or(State::Accepted);
        Some((TaskId::new(task.id.0)?, state, text))
    }

    /// What was new of a task is told; its end is let go.
    pub(crate) fn told(&mut self, id: TaskId) {
        let id = LinkId(id.get());
        if let Some(task) = self.0.tasks.get_mut(id) {
            task.news = false;
        }
        self.0.tasks.acknowledge(id);
    }

    pub(crate) fn stop_everything(&mut self, now: Instant) {
        self.0.stop_everything(now);
    }

    pub(crate) const fn clear_stop(&mut self) {
        self.0.stopped = false;
    }

    pub(crate) const fn is_stopped(&self) -> bool {
        self.0.stopped
    }

    pub(crate) const fn components(&self) -> &C {
        &self.0.components
    }

    pub(crate) const fn components_mut(&mut self) -> &mut C {
        &mut self.0.components
    }
}
