//! The interface between a server and what carries out the tasks of a scope.

use std::sync::Arc;
use std::time::Duration;

use ztl_core::{State, TaskId, TaskSpec};

use super::own_tasks::OwnTasks;
use super::reporter::TaskReporter;
use super::reserved_ids::ReservedIds;
use crate::describe::Descriptions;
use crate::task_request::TaskRequest;

/// Answers questions to `$ztl` that the protocol does not define, in JSON; `None` for an unknown question.
pub type Answers = Box<dyn Fn(&str) -> Option<String> + Send>;

/// Default time for which a stopping server keeps answering while its handlers stop their tasks.
const STOPPING: Duration = Duration::from_millis(1500);

/// Carries out the tasks of a scope. Its methods run on the server's thread, so they must return at once and
/// work elsewhere. For tasks on threads of their own, use [`TaskController`](crate::TaskController).
pub trait TaskHandler: Send {
    /// A client asks for a task. The decision and everything after it is reported to `task`, from any
    /// thread. An INIT that is undecided after 1.5 s is answered with the id.
    fn start(&mut self, task: TaskReporter, request: TaskRequest);

    /// The same with the payload as it was sent. Default: decodes it and calls [`start`](Self::start), or
    /// rejects the task as the original does.
    fn start_payload(&mut self, task: TaskReporter, payload: &str) {
        match TaskRequest::decode(task.id(), payload) {
            Ok(request) => self.start(task, request),
            Err(error) => task.threw(error),
        }
    }

    /// Called after one or more tasks were [started](Self::start), before the server waits: a handler that
    /// wakes threads can do it once for all of them. Default: nothing.
    fn all_started(&mut self) {}

    /// A client asks to stop a task of this handler that has not ended.
    fn abort(&mut self, id: TaskId);

    /// The tasks from before a restart that this handler still knows. Called once, on registration.
    /// Default: none.
    fn restored(&mut self) -> Restored {
        Restored::default()
    }

    /// What reserves the ids of all the server's tasks. Called once, on registration. Default: nothing, all ids may be given.
    fn reserved_ids(&self) -> Option<Arc<ReservedIds>> {
        None
    }

    /// Gets the source of ids for tasks that the handler finds running without a client. Called once, on registration.
    /// The default does nothing.
    fn connect(&mut self, own_tasks: OwnTasks) {
        drop(own_tasks);
    }

    /// Takes up a restored task that has not ended. Its decision has already been reported, or never will
    /// be. Default: the task ends as FAILED.
    fn resume(&mut self, task: TaskReporter) {
        drop(task);
    }

    /// Returns what describes the handlers and components to clients: a mapping in YAML flow style such as
    /// `{gripper: [finger]}`. Called often on the server's thread, so it must be quick. Default: an empty
    /// mapping.
    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        Box::new(|| "{}".to_owned())
    }

    /// Returns what tells what the components say of themselves, for the question `describe`. Default: nothing.
    fn describe(&self) -> Descriptions {
        Box::new(Arc::default)
    }

    /// Whether the answer about an unknown id names the id: `Invalid ID '7'`, like the original's
    /// `TaskController`, or `Invalid ID`, like its simple server. Default: yes.
    fn names_unknown_ids(&self) -> bool {
        true
    }

    /// The server is about to stop and drop its handlers. Begins to stop the tasks, and returns how long
    /// clients may wait to learn their ends. Default: nothing, 1.5 s.
    fn stop(&mut self) -> Duration {
        STOPPING
    }

    /// Returns what answers further questions about this handler, such as `devices`. Called on the server's
    /// thread, so it must be quick. Default: knows no question.
    fn answers(&self) -> Answers {
        Box::new(|_| None)
    }
}

/// What a handler knows from before a restart.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Restored {
    /// The tasks.
    pub tasks: Vec<RestoredTask>,
    /// New tasks get ids above this one.
    pub last_id: Option<TaskId>,
}

/// A task from before a restart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RestoredTask {
    /// The id that its client knows.
    pub id: TaskId,
    /// Its payload, to be shown to people.
    pub payload: String,
    /// Its state.
    pub state: State,
    /// Progress, result or reason.
    pub text: String,
    /// How long ago it ended; `None` if it has not.
    pub ended: Option<Duration>,
    /// Whether a device started it, not a client.
    pub by_device: bool,
}

/// Answers the question `takes PAYLOAD`: whether a handler would take this task, as far as it can tell
/// without starting it. The answer is JSON's `null`, or the reason.
pub fn would_take(takes: impl Fn(&TaskSpec<'_>) -> Result<(), String> + Send + 'static) -> Answers {
    Box::new(move |question| {
        let payload = question.strip_prefix("takes ")?;
        let mut buffer = vec![0; payload.len()];
        let spec = TaskSpec::decode(payload, &mut buffer);
        let why = spec
            .map_err(|error| error.to_string())
            .and_then(|spec| takes(&spec));
        serde_json::to_string(&why.err()).ok()
    })
}
