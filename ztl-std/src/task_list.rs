//! The list of a server's tasks: its answer to the question `tasks`, which `ztl ps` and others ask.

use serde::{Deserialize, Serialize};
use serde_json::Value;
use ztl_core::{State, TaskSpec};

use crate::remote_id::RemoteId;
use ztl_core::client::is_unknown_outcome;

/// Longest payload that is kept for the list, in bytes: base64, so a multiple of four.
const MAX_PAYLOAD: usize = 400;
/// Longest text of a listed task, in bytes.
const MAX_TEXT: usize = 200;
/// Most tasks in a list, so that it fits in a message.
const MAX_TASKS: usize = 1000;

/// A task in a server's list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListedTask {
    /// Its id.
    pub id: RemoteId,
    /// Its scope.
    pub scope: String,
    /// `handler:component:goal`, or the payload if it is something else; truncated.
    pub task: String,
    /// The state's number.
    pub state: u8,
    /// Progress, result or reason; truncated.
    pub text: String,
    /// Milliseconds since its client asked for it.
    pub age_ms: u64,
    /// Whether a device started it, not a client.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub by_device: bool,
    /// Milliseconds since it ended; `null` while it runs.
    pub ended_ms: Option<u64>,
}

impl ListedTask {
    /// Whether the task ended as FAILED because the server could not learn its end. It may still run.
    #[must_use]
    pub fn end_is_unknown(&self) -> bool {
        let state = State::from_code(i64::from(self.state));
        state.is_some_and(|state| is_unknown_outcome(state, &self.text))
    }

    /// Whether the list says that it runs, or does not say for certain that it has ended.
    #[cfg(feature = "config")]
    pub(crate) fn may_run(&self) -> bool {
        let state = State::from_code(i64::from(self.state));
        let ended = self.ended_ms.is_some() && state.is_some_and(State::is_final);
        !ended || self.end_is_unknown()
    }
}

/// The answer to `tasks`: running tasks, then ended ones, the latest first.
#[derive(Debug, Serialize, Deserialize)]
#[serde(from = "UncheckedList")]
pub(crate) struct TaskList {
    pub(crate) tasks: Vec<ListedTask>,
    /// How many more tasks the server keeps; `None` if the answer does not say.
    pub(crate) more: Option<usize>,
    /// How many tasks run in scopes that the client may not use.
    pub(crate) elsewhere: usize,
    /// How many entries of the answer cannot be read. These tasks may run.
    #[serde(skip)]
    #[cfg_attr(
        not(feature = "config"),
        expect(dead_code, reason = "only the client reads it")
    )]
    pub(crate) unread: usize,
}

/// A list as another server writes it. An unreadable entry must not hide the others.
#[derive(Deserialize)]
struct UncheckedList {
    tasks: Vec<Value>,
    #[serde(default)]
    more: Value,
    #[serde(default)]
    elsewhere: Value,
}

impl From<UncheckedList> for TaskList {
    fn from(list: UncheckedList) -> Self {
        let UncheckedList {
            tasks,
            more,
            elsewhere,
        } = list;
        let listed = tasks.len();
        let read = |task| serde_json::from_value(task).ok();
        let tasks = tasks.into_iter().filter_map(read);
        let tasks: Vec<ListedTask> = tasks
            .filter(|task: &ListedTask| task.id.names_task())
            .collect();
        Self {
            unread: listed - tasks.len(),
            tasks,
            more: serde_json::from_value(more).ok(),
            elsewhere: serde_json::from_value(elsewhere).unwrap_or(0),
        }
    }
}

impl TaskList {
    /// Sorts the tasks and keeps as many as fit in a message; `elsewhere` more run where the client may not look.
    pub(crate) fn of(mut tasks: Vec<ListedTask>, elsewhere: usize) -> Self {
        tasks.sort_by_key(|task| (task.ended_ms, task.age_ms));
        let more = tasks.len().saturating_sub(MAX_TASKS);
        tasks.truncate(MAX_TASKS);
        Self {
            tasks,
            more: Some(more),
            elsewhere,
            unread: 0,
        }
    }

    pub(crate) fn into_json(self) -> Option<String> {
        serde_json::to_string(&self).ok()
    }
}

/// The part of a payload that is kept for the list.
pub(crate) fn cut_payload(payload: &str) -> &str {
    cut(payload, MAX_PAYLOAD)
}

/// The part of a text that the list shows.
pub(crate) fn cut_text(text: &str) -> &str {
    cut(text, MAX_TEXT)
}

/// The specification in a payload as people write it.
pub(crate) fn shown_task(payload: &str) -> String {
    let mut buffer = vec![0; payload.len()];
    match TaskSpec::decode(payload, &mut buffer) {
        Ok(spec) => cut_text(&spec.to_string()).to_owned(),
        Err(_) => cut_text(payload).to_owned(),
    }
}

fn cut(text: &str, most: usize) -> &str {
    text.get(..text.floor_char_boundary(most)).unwrap_or(text)
}
