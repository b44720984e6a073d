//! The tasks of a recording.

use std::collections::{BTreeSet, HashMap};

use ztl_core::State;
use ztl_script::event::{RunEvent, RunStarted, TaskState};
use ztl_script::record::Record;

use crate::task::TaskEvent;

/// Most tasks that are shown.
const TASKS: usize = 2000;
/// Longest text that is kept, in bytes.
const TEXT: usize = 500;

/// A task.
#[derive(Debug, Clone)]
pub(super) struct Task {
    pub(super) scope: String,
    pub(super) id: String,
    /// What was asked for, if that is recorded.
    pub(super) name: Option<String>,
    pub(super) from: u64,
    pub(super) accepted: Option<u64>,
    /// When it ended; `None` if the recording ends before.
    pub(super) to: Option<u64>,
    pub(super) state: String,
    pub(super) text: String,
}

/// All tasks, in the order of their first events.
#[derive(Debug, Default)]
pub(super) struct Tasks {
    pub(super) shown: Vec<Task>,
    /// Index of the newest task of each publisher, scope and id.
    newest: HashMap<(String, String, String), usize>,
    /// Events of tasks that are not shown.
    pub(super) hidden: u64,
}

impl Tasks {
    pub(super) fn on_event(&mut self, event: &TaskEvent, publisher: &str, at: u64) {
        let key = (publisher.to_owned(), event.scope.clone(), event.id.clone());
        let known = self.newest.get(&key).copied();
        // A server that was restarted may use an id again.
        let index = match known.filter(|_| event.state() != Some(State::Initiated)) {
            Some(index) => index,
            None if self.shown.len() >= TASKS => {
                self.hidden += 1;
                return;
            }
            None => {
                self.newest.insert(key, self.shown.len());
                self.shown.push(Task {
                    scope: event.scope.clone(),
                    id: event.id.clone(),
                    name: name(event),
                    from: at,
                    accepted: None,
                    to: None,
                    state: String::new(),
                    text: String::new(),
                });
                self.shown.len() - 1
            }
        };
        let Some(task) = self.shown.get_mut(index) else {
            return;
        };
        task.state = cut(&event.state);
        task.text = cut(&event.text);
        if event.state() == Some(State::Accepted) {
            task.accepted.get_or_insert(at);
        }
        if event.is_final() {
            task.to = Some(at);
        }
    }

    /// Adds the tasks of a run whose first event was at this time, if no server has told of them.
    pub(super) fn add_run(&mut self, run: &Record, first: u64) {
        let mut told: BTreeSet<usize> = (0..self.shown.len()).collect();
        let mut tasks: HashMap<u32, Task> = HashMap::new();
        for event in &run.events {
            let begin = run.events.first().map_or(event.at, |first| first.at);
            let at = event.at.saturating_sub(begin).as_nanos();
            let at = first.saturating_add(u64::try_from(at).unwrap_or(u64::MAX));
            match &event.event {
                RunEvent::TaskStarting {
                    task,
                    scene,
                    step,
                    part,
                    ..
                } => {
                    let planned = planned(&run.started, (*scene, *step, *part));
                    let (name, scope) = planned.unwrap_or_default();
                    let new = Task {
                        scope: scope.to_owned(),
                        id: String::new(),
                        name: Some(name),
                        from: at,
                        accepted: None,
                        to: None,
                        state: String::new(),
                        text: String::new(),
                    };
                    tasks.insert(task.0, new);
                }
                RunEvent::TaskState {
                    task,
                    state,
                    id,
                    text,
                    ..
                } => {
                    let Some(task) = tasks.get_mut(&task.0) else {
                        continue;
                    };
                    task.state = state.to_string().to_uppercase();
                    task.text = cut(text);
                    if let Some(id) = id {
                        task.id = id.to_string();
                    }
                    if *state == TaskState::Accepted {
                        task.accepted.get_or_insert(at);
                    }
                    task.to = state.is_over().then_some(at);
                }
                _ => {}
            }
        }
        let mut new: Vec<Task> = tasks.into_values().collect();
        new.sort_by_key(|task| task.from);
        new.retain(|task| {
            let is_it = |other: &Task| match task.id.is_empty() {
                false => other.scope == task.scope && other.id == task.id,
                // A client learns no id of a task that was rejected at once.
                true => {
                    let is_same = other.scope == task.scope && other.name == task.name;
                    is_same && other.state == State::Rejected.name() && other.from >= task.from
                }
            };
            let is_told = |index: &&usize| self.shown.get(**index).is_some_and(is_it);
            match told.iter().find(is_told).copied() {
                Some(index) => !told.remove(&index),
                None => true,
            }
        });
        let room = TASKS.saturating_sub(self.shown.len());
        self.shown.extend(new.into_iter().take(room));
        self.shown.sort_by_key(|task| task.from);
        // Their indices have changed.
        self.newest.clear();
    }
}

/// A task of a run, by the numbers of its scene, step and part: its name, and the scope of its server.
fn planned(run: &RunStarted, (scene, step, part): (usize, usize, usize)) -> Option<(String, &str)> {
    let scene = run.outline.scenes.get(scene)?;
    let task = scene.steps.get(step)?.tasks.get(part)?;
    let remote = run.remotes.iter().find(|remote| remote.name == task.remote);
    let name = format!("{}:{}:{}", task.handler, task.component, task.goal);
    Some((cut(&name), remote.map_or("", |remote| &remote.scope)))
}

fn name(event: &TaskEvent) -> Option<String> {
    let request = event.request.as_ref().map(|request| request.join(":"));
    request
        .or_else(|| event.payload.clone())
        .as_deref()
        .map(cut)
}

fn cut(text: &str) -> String {
    let short = text.get(..text.floor_char_boundary(TEXT));
    short.unwrap_or(text).to_owned()
}
