//! Publishes what happens to tasks, for consoles and recorders (`docs/streams.md`).

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use tracing::warn;
use ztl_core::envelope::ClientId;
use ztl_core::{State, TaskId};
use ztl_pickle::Pickle;

use super::clock::now;
use crate::log_targets::TASKS;
use crate::native::publisher::{PubMessage, PubSocket};
use crate::rate_limit::RateLimit;
use crate::task_request::TaskRequest;

/// Between the scope and the task's id in a topic.
const PATH: &str = "/$tasks/";
/// At most so many warnings at once, and then one in this time.
const WARNINGS: (u32, std::time::Duration) = (1, std::time::Duration::from_secs(10));

/// The publisher of a server's task events.
pub(super) struct TaskEvents {
    socket: Arc<PubSocket>,
    warnings: RateLimit,
}

impl TaskEvents {
    pub(super) fn new(socket: Arc<PubSocket>) -> Self {
        Self {
            socket,
            warnings: RateLimit::new(WARNINGS.0, WARNINGS.1, now()),
        }
    }

    /// A client asked for a task, whose handler has it now.
    pub(super) fn on_asked(
        &mut self,
        scope: &str,
        id: TaskId,
        payload: &str,
        client: Option<ClientId>,
    ) {
        let mut fields = Vec::new();
        let mut add = |name: &'static str, text: &str| fields.push((name, value(text)));
        match TaskRequest::decode(id, payload) {
            Ok(request) => {
                add("handler", &request.handler);
                add("component", &request.component);
                add("goal", &request.goal);
            }
            Err(_) => add("payload", payload),
        }
        if let Some(ClientId(bytes)) = client {
            let digits = bytes.iter().map(|byte| format!("{byte:02x}"));
            add("client", &digits.collect::<String>());
        }
        self.publish(scope, id, State::Initiated, fields);
    }

    /// A task has a new state, or progress.
    pub(super) fn on_changed(&mut self, scope: &str, id: TaskId, state: State, text: &str) {
        self.publish(scope, id, state, vec![("text", value(text))]);
    }

    fn publish(
        &mut self,
        scope: &str,
        id: TaskId,
        state: State,
        mut fields: Vec<(&'static str, Pickle)>,
    ) {
        let time = SystemTime::now().duration_since(UNIX_EPOCH);
        fields.push(("time", time.unwrap_or_default().as_secs_f64().into()));
        fields.push(("id", id.get().into()));
        fields.push(("state", state.name().into()));
        let Ok(value) = Pickle::dict(fields) else {
            return;
        };
        let path = format!("{PATH}{id}");
        let message = PubMessage::new(scope, &path, &value.to_bytes(), false);
        if !self.socket.publish(message) && self.warnings.take(now()) {
            warn!(target: TASKS, "Events of tasks were not published: they come faster than they can be sent.");
        }
    }
}

/// A text as a value. `None` only for one of more than a GiB, which no message has.
fn value(text: &str) -> Pickle {
    Pickle::text(text).unwrap_or_else(|_| Pickle::none())
}
