//! What the scope `$ztl` tells of a server's tasks: `tasks`, for `ztl ps` and friends.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;
use ztl_core::{Instant, TaskSpec};

use crate::RemoteId;

/// Longest payload that is kept to be shown, in bytes: base64, so a multiple of four.
const SHOWN: usize = 400;
/// Longest text of a task that is told, in bytes.
const TEXT: usize = 200;
/// Most tasks that are told: all of them fit a message.
const MOST: usize = 1000;

/// A task as `$ztl` tells it when it is asked for `tasks`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListedTask {
    /// Its id.
    pub id: RemoteId,
    /// The scope that it belongs to.
    pub scope: String,
    /// `handler:component:goal`, or the payload where it is no such thing; long ones are cut.
    pub task: String,
    /// The state's number.
    pub state: u8,
    /// Progress, result or reason; long ones are cut.
    pub text: String,
    /// How long ago its client asked for it, in milliseconds.
    pub age_ms: u64,
    /// How long ago it ended, in milliseconds; `null` while it runs.
    pub ended_ms: Option<u64>,
}

/// What `$ztl` answers to `tasks`: the running ones, then the ended ones, latest first.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(from = "Answer")]
pub struct Listing {
    /// The tasks.
    pub tasks: Vec<ListedTask>,
    /// How many more are remembered; `None` if the answer does not tell it in a readable way.
    pub more: Option<usize>,
    /// How many more the server listed in a way that cannot be read. They may run.
    #[serde(skip)]
    pub unread: usize,
}

/// A listing as another server writes it: what cannot be read must not hide the rest.
#[derive(Deserialize)]
struct Answer {
    tasks: Vec<Value>,
    #[serde(default)]
    more: Value,
}

impl From<Answer> for Listing {
    fn from(Answer { tasks, more }: Answer) -> Self {
        let listed = tasks.len();
        let read = |task| serde_json::from_value(task).ok();
        let tasks = tasks.into_iter().filter_map(read);
        let named = |task: &ListedTask| task.id.names_task();
        let tasks: Vec<ListedTask> = tasks.filter(named).collect();
        Self {
            unread: listed - tasks.len(),
            tasks,
            more: serde_json::from_value(more).ok(),
        }
    }
}

impl Listing {
    /// Sorts, cuts to what a message carries, and writes it as JSON.
    pub(super) fn into_json(mut self) -> Option<String> {
        self.tasks.sort_by_key(|task| (task.ended_ms, task.age_ms));
        self.more = Some(self.tasks.len().saturating_sub(MOST));
        self.tasks.truncate(MOST);
        serde_json::to_string(&self).ok()
    }
}

/// What is kept of an INIT to be shown.
#[derive(Debug)]
pub(super) struct Asked {
    payload: String,
    at: Instant,
}

impl Asked {
    pub(super) fn new(payload: &str, at: Instant) -> Self {
        let payload = cut(payload, SHOWN).to_owned();
        Self { payload, at }
    }

    pub(super) fn age(&self, now: Instant) -> Duration {
        now.since(self.at)
    }

    /// The task's specification as people write it.
    pub(super) fn task(&self) -> String {
        let mut buffer = vec![0; self.payload.len()];
        match TaskSpec::decode(&self.payload, &mut buffer) {
            Ok(spec) => cut(&spec.to_string(), TEXT).to_owned(),
            Err(_) => cut(&self.payload, TEXT).to_owned(),
        }
    }
}

/// What is told of a text.
pub(super) fn told(text: &str) -> String {
    cut(text, TEXT).to_owned()
}

fn cut(text: &str, most: usize) -> &str {
    text.get(..text.floor_char_boundary(most)).unwrap_or(text)
}
