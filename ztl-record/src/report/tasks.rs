//! The tasks of a recording.

use std::collections::HashMap;

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
        let index = match known.filter(|_| event.state != "INITIATED") {
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
        if event.state == "ACCEPTED" {
            task.accepted.get_or_insert(at);
        }
        if event.is_final() {
            task.to = Some(at);
        }
    }
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
