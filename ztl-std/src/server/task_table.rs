//! The server's task table, on the heap.

use std::collections::{HashMap, VecDeque};

use ztl_core::memory::Scope;
use ztl_core::tasks::{StoredText, Task, Tasks};
use ztl_core::{Instant, TaskId};

use super::limits::{Limits, MAX_MESSAGE};
use crate::task_list::{self, ListedTask};
use crate::time::millis;

/// Longest text that is kept, in bytes: an answer must fit in a message.
const MAX_TEXT: usize = MAX_MESSAGE - 1024;

/// A text of any length up to what a message can carry.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct HeapText(String);

impl AsRef<str> for HeapText {
    fn as_ref(&self) -> &str {
        &self.0
    }
}

impl StoredText for HeapText {
    fn set(&mut self, text: &str) {
        self.0.clear();
        if text.len() <= MAX_TEXT {
            self.0.push_str(text);
        } else {
            let fitting = text.floor_char_boundary(MAX_TEXT);
            self.0.push_str(text.get(..fitting).unwrap_or_default());
            self.0.push('…');
        }
    }
}

/// A task in the table.
#[derive(Debug)]
struct TableSlot {
    task: Task<Scope, HeapText>,
    /// The request, for the list of tasks.
    summary: Option<Summary>,
    /// Bytes of its goal.
    goal: usize,
    /// Bytes counted for it: of its goal and its text while it runs, of its result afterwards.
    bytes: usize,
}

/// The part of an INIT that the list of tasks shows.
#[derive(Debug)]
struct Summary {
    payload: String,
    at: Instant,
    /// Whether a device started it.
    by_device: bool,
}

/// Tasks by id, and the ended ones in order of their end.
#[derive(Debug)]
pub(super) struct TaskTable {
    limits: Limits,
    tasks: HashMap<TaskId, TableSlot>,
    /// Ends, sorted by time. New ones are added at or near the back.
    ends: VecDeque<(Instant, TaskId)>,
    /// Bytes of the goals and texts of running tasks.
    goals: usize,
    /// Bytes of the results of ended tasks.
    results: usize,
    /// Bytes of the answers to INITs, which cannot be evicted.
    answers: usize,
    /// Scopes that the client being served may not use.
    hidden: Vec<Scope>,
}

impl TaskTable {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits,
            tasks: HashMap::new(),
            ends: VecDeque::new(),
            goals: 0,
            results: 0,
            answers: 0,
            hidden: Vec::new(),
        }
    }

    /// Changes the limits for tasks that come from now on.
    pub(super) fn set_limits(&mut self, limits: Limits) {
        self.limits = limits;
    }

    /// Hides scopes from the request that is served next.
    pub(super) fn hide(&mut self, scopes: Vec<Scope>) {
        self.hidden = scopes;
    }

    pub(super) fn hides_any(&self) -> bool {
        !self.hidden.is_empty()
    }

    pub(super) fn hides(&self, scope: Scope) -> bool {
        self.hidden.contains(&scope)
    }

    /// Counts the bytes of an answer to an INIT that is kept.
    pub(super) fn count_answer(&mut self, bytes: usize) {
        self.answers += bytes;
    }

    /// Reverts [`count_answer`](Self::count_answer).
    pub(super) fn forget_answer(&mut self, bytes: usize) {
        self.answers -= bytes;
    }

    /// Keeps what a task was asked for. While the task runs, its handler keeps the whole payload, so all of
    /// it counts.
    pub(super) fn note_payload(&mut self, id: TaskId, payload: &str, now: Instant) {
        if let Some(slot) = self.tasks.get_mut(&id) {
            slot.summary = Some(Summary {
                payload: task_list::cut_payload(payload).to_owned(),
                at: now,
                by_device: false,
            });
            if !slot.task.state.is_final() {
                slot.goal = payload.len();
            }
            self.recount(id);
        }
    }

    /// Counts a running task's bytes again: its text may be another one.
    pub(super) fn recount(&mut self, id: TaskId) {
        if let Some(slot) = self.tasks.get_mut(&id)
            && !slot.task.state.is_final()
        {
            let bytes = slot.goal + slot.task.text.as_ref().len();
            self.goals -= std::mem::replace(&mut slot.bytes, bytes);
            self.goals += bytes;
        }
    }

    /// A device started this task, not a client.
    pub(super) fn note_by_device(&mut self, id: TaskId) {
        let slot = self.tasks.get_mut(&id);
        if let Some(summary) = slot.and_then(|slot| slot.summary.as_mut()) {
            summary.by_device = true;
        }
    }

    /// The tasks that the client being served may see.
    pub(super) fn list<'t>(
        &'t self,
        now: Instant,
        scope_name: impl Fn(Scope) -> &'t str + 't,
    ) -> impl Iterator<Item = ListedTask> + 't {
        let shown = self.tasks.iter();
        let shown = shown.filter(|(_, slot)| !self.hides(slot.task.extra));
        shown.map(move |(id, TableSlot { task, summary, .. })| {
            let summary = summary.as_ref();
            ListedTask {
                id: (*id).into(),
                scope: scope_name(task.extra).to_owned(),
                task: summary
                    .map(|of| task_list::shown_task(&of.payload))
                    .unwrap_or_default(),
                state: task.state.code(),
                text: task_list::cut_text(task.text.as_ref()).to_owned(),
                age_ms: summary.map_or(0, |of| millis(now.since(of.at))),
                by_device: summary.is_some_and(|of| of.by_device),
                ended_ms: (task.ended != Instant::NEVER).then(|| millis(now.since(task.ended))),
            }
        })
    }

    /// How many tasks run that the client being served may not see.
    pub(super) fn running_elsewhere(&self) -> usize {
        let tasks = self.tasks.values().map(|slot| &slot.task);
        let running = tasks.filter(|task| !task.state.is_final());
        running.filter(|task| self.hides(task.extra)).count()
    }

    /// Evicts the oldest ends until all bytes fit, but never `last`, which no client has been told yet.
    fn forget_surplus(&mut self, last: TaskId) {
        while self.goals + self.results + self.answers > self.limits.memory
            && let Some((_, oldest)) = self.ends.front().copied()
            && oldest != last
        {
            self.remove(oldest);
        }
    }
}

impl Tasks for TaskTable {
    type Id = TaskId;
    type Extra = Scope;
    type Text = HeapText;

    fn get(&self, id: TaskId) -> Option<&Task<Scope, HeapText>> {
        self.tasks.get(&id).map(|slot| &slot.task)
    }

    fn get_mut(&mut self, id: TaskId) -> Option<&mut Task<Scope, HeapText>> {
        self.tasks.get_mut(&id).map(|slot| &mut slot.task)
    }

    fn may_run(&self) -> bool {
        // Half of the memory is reserved for results.
        self.tasks.len().saturating_sub(self.ends.len()) < self.limits.running
            && self.goals + self.answers < self.limits.memory / 2
    }

    fn make_room(&mut self) -> bool {
        if self.tasks.len() >= self.limits.remembered {
            let Some((_, oldest)) = self.ends.front().copied() else {
                return false;
            };
            self.remove(oldest);
        }
        true
    }

    fn insert(
        &mut self,
        id: TaskId,
        task: Task<Scope, HeapText>,
    ) -> Option<&mut Task<Scope, HeapText>> {
        let slot = TableSlot {
            task,
            summary: None,
            goal: 0,
            bytes: 0,
        };
        let slot = self.tasks.entry(id).insert_entry(slot);
        Some(&mut slot.into_mut().task)
    }

    fn remove(&mut self, id: TaskId) {
        let Some(slot) = self.tasks.remove(&id) else {
            return;
        };
        match slot.task.ended {
            Instant::NEVER => self.goals -= slot.bytes,
            _ => self.results -= slot.bytes,
        }
        let end = (slot.task.ended, id);
        // Usually the oldest is evicted.
        if self.ends.front() == Some(&end) {
            self.ends.pop_front();
        } else if let Ok(place) = self.ends.binary_search(&end) {
            self.ends.remove(place);
        }
    }

    fn on_ended(&mut self, id: TaskId) {
        if let Some(slot) = self.tasks.get_mut(&id) {
            let result = slot.task.text.as_ref().len();
            self.goals -= std::mem::replace(&mut slot.bytes, result);
            self.results += result;
            let end = (slot.task.ended, id);
            let later = self.ends.iter().rev().take_while(|other| **other > end);
            self.ends.insert(self.ends.len() - later.count(), end);
            self.forget_surplus(id);
        }
    }

    fn oldest_end(&self) -> Option<(TaskId, Instant)> {
        self.ends.front().map(|(ended, id)| (*id, *ended))
    }

    fn iter(&self) -> impl Iterator<Item = (TaskId, &Task<Scope, HeapText>)> {
        let tasks = self.tasks.iter().map(|(id, slot)| (*id, &slot.task));
        tasks.filter(|(_, task)| !self.hides(task.extra))
    }
}

#[cfg(test)]
mod tests {
    use ztl_core::Event;
    use ztl_core::tasks::TaskRules as _;

    use super::*;

    #[test]
    fn all_bytes_of_a_task_count_until_it_is_forgotten() {
        let mut table = TaskTable::new(Limits {
            memory: 100,
            ..Limits::default()
        });
        let (now, id) = (Instant::ZERO, TaskId::new(1).unwrap());
        table.admit(id, Task::new(Scope(0))).unwrap();
        table.note_payload(id, "0123456789", now);
        table.apply(now, id, Event::Accept, Some("accepted"));
        table.recount(id);
        assert_eq!((table.goals, table.may_run()), (18, true));
        table.progress(id, &"x".repeat(40));
        table.recount(id);
        assert_eq!((table.goals, table.may_run()), (50, false));
        table.progress(id, "x");
        table.recount(id);
        assert_eq!((table.goals, table.may_run()), (11, true));
        table.apply(now, id, Event::Complete, Some("done"));
        table.recount(id);
        assert_eq!((table.goals, table.results), (0, 4));
        table.remove(id);
        assert_eq!((table.goals, table.results), (0, 0));
    }
}
