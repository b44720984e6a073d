//! What takes the tasks of a scope: the trait that a handler implements, and what one may know from
//! before a restart.

use std::time::Duration;

use ztl_core::{State, TaskId, TaskSpec};

use super::TaskReporter;

/// Answers questions of clients to `$ztl` that are not the protocol's own: in JSON, or `None`
/// where the question is not known.
pub type Answers = Box<dyn Fn(&str) -> Option<String> + Send>;

/// How long a server that is stopped goes on answering while its handlers stop their tasks, at most,
/// unless they say otherwise.
const STOPPING: Duration = Duration::from_millis(1500);

/// What takes the tasks of a scope, on the server's own thread: it must return at once and work
/// elsewhere. For tasks that run on threads there is [`TaskController`](crate::TaskController).
pub trait TaskHandler: Send {
    /// A client asks for a task. The decision and all that follows go to `task`, from any thread;
    /// an INIT without a decision is answered after 1.5 s, with the id.
    fn start(&mut self, task: TaskReporter, payload: &str);

    /// After one or more calls of [`start`](Self::start), before anything is waited for: a handler that
    /// has to wake somebody can do it once for all of them. Default: nothing.
    fn all_started(&mut self) {}

    /// A client asks to stop a task that this handler was given and that has not ended.
    fn abort(&mut self, id: TaskId);

    /// The tasks from before a restart that this handler still knows; asked once, when it is
    /// registered. Default: none.
    fn restored(&mut self) -> Restored {
        Restored::default()
    }

    /// One of those tasks has not ended: from now on what becomes of it goes to `task`. Its decision
    /// has been told, or never will be. Default: it ends as FAILED.
    fn resume(&mut self, task: TaskReporter) {
        drop(task);
    }

    /// What will tell a client that asks `$ztl` which handlers and components there are: a mapping
    /// in YAML's flow style, `{gripper: [finger]}`. Called often, from the server's thread, so it
    /// must be quick. Default: nothing is told.
    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        Box::new(|| "{}".to_owned())
    }

    /// Whether the answer about an id that is not known names that id: `Invalid ID '7'`, as the original's
    /// `TaskController` says it, or `Invalid ID`, as its simple server does. Default: it names the id.
    fn names_unknown_ids(&self) -> bool {
        true
    }

    /// The server is about to stop, and drops its handlers: begin to stop the tasks, and say how long
    /// clients may wait to hear of their ends. Default: nothing, 1.5 s.
    fn stop(&mut self) -> Duration {
        STOPPING
    }

    /// What will answer questions about this handler, as `devices`. Called from the server's
    /// thread, so it must be quick. Default: no question is known.
    fn answers(&self) -> Answers {
        Box::new(|_| None)
    }
}

/// What a handler knows from before a restart.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Restored {
    /// The tasks.
    pub tasks: Vec<RestoredTask>,
    /// No task is given an id up to this one.
    pub last_id: Option<TaskId>,
}

/// A task from before a restart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RestoredTask {
    /// The id that its client knows.
    pub id: TaskId,
    /// Its payload, to be shown to people.
    pub payload: String,
    /// Where it is in its life.
    pub state: State,
    /// Progress, result or reason.
    pub text: String,
    /// How long ago it ended; `None` when it has not.
    pub ended: Option<Duration>,
}

/// Answers the question `takes PAYLOAD`: whether a handler would take this task, as far as it can tell
/// without starting it; JSON's `null`, or the reason why not.
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
