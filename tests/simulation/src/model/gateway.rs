//! A gateway of the model: the journal of the real session, and the replies to its clients.

use ztl_core::link::LinkId;
use ztl_core::{State, TaskId};

use super::ends::link::{Entry, Restored, Sent, SessionJournal};

/// A journal that survives its gateway.
#[derive(Debug, Clone, Default)]
pub(super) struct Journal {
    /// Whether entries are written.
    pub(super) kept: bool,
    open: Vec<Line>,
    /// Final states by task.
    pub(super) ends: Vec<(TaskId, State)>,
    /// The boot and the id on the link of the last task that the device has started itself.
    latest_own: Option<(u32, LinkId)>,
}

#[derive(Debug, Clone)]
struct Line {
    id: TaskId,
    component: String,
    goal: String,
    sent: Sent,
    accepted: bool,
}

impl Journal {
    /// The tasks without a final state, which a restarted gateway restores.
    pub(super) fn restored(&self) -> Vec<Restored> {
        let restored = |line: &Line| Restored {
            id: line.id,
            component: line.component.clone(),
            goal: line.goal.clone(),
            sent: line.sent,
            accepted: line.accepted,
        };
        self.open.iter().map(restored).collect()
    }
}

impl SessionJournal for Journal {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        if self.kept
            && let Some(sent) = task.sent
        {
            if sent.link.is_local() {
                self.latest_own = Some((sent.boot, sent.link));
            }
            self.open.push(Line {
                id: task.id,
                component: task.component.to_owned(),
                goal: task.goal.to_owned(),
                sent,
                accepted: false,
            });
        }
        Ok(())
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        for line in self.open.iter_mut().filter(|line| line.id == task.id) {
            line.accepted = true;
        }
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, _text: &str) -> Result<(), String> {
        if self.kept {
            self.open.retain(|line| line.id != task.id);
            self.ends.push((task.id, state));
        }
        Ok(())
    }

    fn latest_own(&self) -> Option<(u32, LinkId)> {
        self.latest_own
    }
}

/// The reply to the client of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Told {
    /// It has not started the task.
    #[default]
    Unasked,
    /// Nothing yet.
    Nothing,
    /// The task runs.
    Accepted,
    /// The task was not started and never will be.
    Rejected,
    /// The task has this final state.
    Ended(State),
}

impl Told {
    pub(super) fn is_final(self) -> bool {
        matches!(self, Self::Rejected | Self::Ended(_))
    }
}
