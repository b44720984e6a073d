//! Events of tasks.

use serde_json::{Map, Value};
use ztl_core::State;

/// What is between a scope and a task's id in the topics of its events.
pub const TASKS: &str = "/$tasks/";

/// What happened to a task. `docs/streams.md` describes the events.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct TaskEvent {
    /// The scope of the task's controller.
    pub scope: String,
    /// The task's id on its server.
    pub id: String,
    /// `INITIATED`, `ACCEPTED` or a final state.
    pub state: String,
    /// What was asked for; with `INITIATED` only.
    pub request: Option<[String; 3]>,
    /// The request, if it is not a handler, component and goal; with `INITIATED` only.
    pub payload: Option<String>,
    /// Progress, result or the reason of a rejection.
    pub text: String,
}

impl TaskEvent {
    /// Reads an event from its JSON.
    pub(crate) fn read(scope: &str, json: &Map<String, Value>) -> Option<Self> {
        let text = |key| json.get(key).and_then(Value::as_str).map(str::to_owned);
        let request = (text("handler"), text("component"), text("goal"));
        let request = match request {
            (Some(handler), Some(component), Some(goal)) => Some([handler, component, goal]),
            _ => None,
        };
        Some(Self {
            scope: scope.to_owned(),
            id: id_text(json.get("id")?)?,
            state: text("state")?,
            request,
            payload: text("payload"),
            text: text("text").unwrap_or_default(),
        })
    }

    /// Its state, if it is one that this version knows.
    #[must_use]
    pub fn state(&self) -> Option<State> {
        let mut states = State::ALL.into_iter();
        states.find(|state| state.name() == self.state)
    }

    /// Whether the task has ended.
    #[must_use]
    pub fn is_final(&self) -> bool {
        self.state().is_some_and(State::is_final)
    }
}

/// A task's id: a number, or a text if it is longer than one.
fn id_text(id: &Value) -> Option<String> {
    match id {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) if !number.is_f64() => Some(number.to_string()),
        _ => None,
    }
}
