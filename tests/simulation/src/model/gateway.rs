//! A gateway: the real session with its book, and what its clients were told.

use ztl_core::{State, TaskId};

use super::ends::session::{Entry, Restored, Sent, SessionJournal};

/// A journal that survives its gateway.
#[derive(Debug, Clone, Default)]
pub(super) struct Journal {
    /// Without one, nothing is written.
    pub(super) kept: bool,
    open: Vec<Line>,
    /// Ends, by task.
    pub(super) ends: Vec<(TaskId, State)>,
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
    /// What a new gateway reads: tasks without an end.
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
}

/// What a task's client has been told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Told {
    /// It has not asked.
    #[default]
    Unasked,
    /// Nothing yet.
    Nothing,
    /// That it runs.
    Accepted,
    /// That it was not started and never will be.
    Rejected,
    /// That it has come to this end.
    Ended(State),
}

impl Told {
    pub(super) fn is_final(self) -> bool {
        matches!(self, Self::Rejected | Self::Ended(_))
    }
}
