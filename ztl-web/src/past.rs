//! The tasks of the last hours that this console has seen end.

use std::collections::{HashMap, VecDeque};
use std::sync::Mutex;

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use ztl_std::RemoteId;

use crate::clock::now_ms;
use crate::lock::locked;
use crate::task::Task;

/// Most tasks that are kept, and for how long, in ms.
const KEPT: usize = 2000;
const AGE: u64 = 12 * 60 * 60 * 1000;
/// How much of a text is kept, in bytes.
const TEXT: usize = 300;
/// Most tasks of an answer.
const TOLD: usize = 100;
/// Most goals whose sender is remembered until their task is seen to have ended.
const SENDERS: usize = 500;

/// Robot, scope and id of a task.
pub(crate) type Key = (String, String, RemoteId);

#[derive(Default)]
pub(crate) struct Past(Mutex<Inner>);

#[derive(Default)]
struct Inner {
    /// The oldest first.
    ended: VecDeque<Ended>,
    /// The tasks that are kept, and those of `senders`: who started them, if this console did.
    known: HashMap<Key, Known>,
    senders: VecDeque<Key>,
}

#[derive(Default)]
struct Known {
    is_kept: bool,
    by: Option<String>,
}

#[derive(Debug, Clone, Serialize)]
struct Ended {
    #[serde(flatten)]
    task: Task,
    seen_ms: u64,
}

/// What a client looks for.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Wanted {
    /// What the task, its robot, state, text or sender contain, in any case.
    filter: String,
}

impl Past {
    /// A goal of this console had this task.
    pub(crate) fn on_goal(&self, key: Key, by: &str) {
        let mut inner = locked(&self.0);
        if let Some(known) = inner.known.get_mut(&key) {
            known.by = Some(by.to_owned());
            for ended in inner.ended.iter_mut().rev() {
                if key_of(&ended.task) == key {
                    ended.task.by = Some(by.to_owned());
                    break;
                }
            }
            return;
        }
        if inner.senders.len() >= SENDERS
            && let Some(oldest) = inner.senders.pop_front()
            && inner.known.get(&oldest).is_some_and(|known| !known.is_kept)
        {
            inner.known.remove(&oldest);
        }
        inner.senders.push_back(key.clone());
        let by = Some(by.to_owned());
        inner.known.insert(key, Known { is_kept: false, by });
    }

    /// A server lists these tasks.
    pub(crate) fn on_listed(&self, tasks: &[Task]) {
        let now = now_ms();
        let mut inner = locked(&self.0);
        // A server lists the newest first.
        for task in tasks.iter().rev().filter(|task| !task.runs) {
            let known = inner.known.entry(key_of(task)).or_default();
            if known.is_kept {
                continue;
            }
            known.is_kept = true;
            let task = Task {
                by: known.by.clone(),
                text: cut(&task.text),
                task: cut(&task.task),
                ..task.clone()
            };
            inner.ended.push_back(Ended { task, seen_ms: now });
        }
        while let Some(oldest) = inner.ended.front()
            && (inner.ended.len() > KEPT || oldest.seen_ms + AGE < now)
        {
            let key = key_of(&oldest.task);
            inner.ended.pop_front();
            inner.known.remove(&key);
        }
    }

    /// The tasks that a client looks for, the newest first.
    ///
    /// # Errors
    /// What is wrong with `wanted`.
    pub(crate) fn find(&self, wanted: Value) -> Result<Value, String> {
        let wanted: Wanted = match wanted {
            Value::Null => Wanted::default(),
            wanted => serde_json::from_value(wanted).map_err(|error| error.to_string())?,
        };
        let filter = wanted.filter.to_lowercase();
        let fits = |ended: &&Ended| {
            let task = &ended.task;
            let by = task.by.as_deref().unwrap_or_default();
            let texts = [
                &task.robot,
                &task.scope,
                &task.task,
                &task.state,
                &task.text,
            ];
            let mut texts = texts.into_iter().map(String::as_str).chain([by]);
            texts.any(|text| text.to_lowercase().contains(&filter))
        };
        let inner = locked(&self.0);
        let found: Vec<&Ended> = inner.ended.iter().rev().filter(fits).collect();
        let more = found.len().saturating_sub(TOLD);
        let tasks = found.get(..TOLD).unwrap_or(&found);
        Ok(json!({ "tasks": tasks, "more": more }))
    }
}

fn key_of(task: &Task) -> Key {
    (task.robot.clone(), task.scope.clone(), task.id.clone())
}

fn cut(text: &str) -> String {
    match text.len() > TEXT {
        true => {
            let most = text.floor_char_boundary(TEXT);
            format!("{}…", text.get(..most).unwrap_or_default())
        }
        false => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn task(id: i64, runs: bool) -> Task {
        Task {
            robot: "ours".to_owned(),
            scope: "/test".to_owned(),
            id: RemoteId::from(id),
            task: format!("test:echo:{id}"),
            state: "COMPLETED".to_owned(),
            text: "ü".repeat(400),
            runs,
            started_ms: None,
            by: None,
        }
    }

    fn ids(past: &Past, filter: &str) -> Vec<i64> {
        let found = past.find(json!({ "filter": filter })).expect("an answer");
        let tasks = found["tasks"].as_array().expect("tasks");
        tasks
            .iter()
            .filter_map(|task| task["id"].as_i64())
            .collect()
    }

    #[test]
    fn each_ended_task_is_kept_once_with_its_sender_and_the_newest_comes_first() {
        let past = Past::default();
        let key = |id| key_of(&task(id, false));
        past.on_goal(key(2), "operator at 10.0.0.7");
        past.on_listed(&[task(3, true), task(2, false), task(1, false)]);
        past.on_listed(&[task(3, false), task(2, false)]);
        past.on_goal(key(3), "operator at 10.0.0.8");
        assert_eq!(ids(&past, ""), [3, 2, 1]);
        assert_eq!(ids(&past, "OPERATOR"), [3, 2]);
        assert_eq!(ids(&past, "echo:1"), [1]);
        assert!(ids(&past, "none").is_empty());
        assert!(past.find(json!({ "filter": 7 })).is_err());
    }

    #[test]
    fn what_is_kept_is_limited() {
        let past = Past::default();
        for id in 0..3000 {
            past.on_goal(key_of(&task(id + 10_000, false)), "operator");
            past.on_listed(&[task(id, false)]);
        }
        let inner = locked(&past.0);
        assert_eq!((inner.ended.len(), inner.senders.len()), (KEPT, SENDERS));
        assert_eq!(inner.known.len(), KEPT + SENDERS);
        drop(inner);
        let found = past.find(Value::Null).expect("an answer");
        assert_eq!(found["more"], json!(KEPT - TOLD));
        assert!(
            found["tasks"][0]["text"]
                .as_str()
                .is_some_and(|text| text.len() < 310)
        );
    }
}
