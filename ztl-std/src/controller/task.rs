//! What a user of the library implements: a controller and its tasks, like the original's `TaskController`
//! and `ExecutableTask`.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ztl_core::TaskId;

use crate::describe::ScopeDescriptions;
use crate::offers::Offers;
use crate::server::TaskReporter;
use crate::task_request::TaskRequest;

/// Turns requests into tasks.
pub trait TaskController: Send + Sync + 'static {
    /// Returns the task for a request. Runs on the task's own thread, so it may take its time; an INIT that is
    /// undecided after 1.5 s is answered with the id.
    ///
    /// # Errors
    /// What is wrong and what is expected. The INIT is rejected with `Controller threw exception:` and this
    /// text, like in the original. So is an INIT whose controller panics.
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError>;

    /// The handlers and their components, for `ztl describe` and others. Called once, on registration.
    /// Default: an empty list.
    fn offers(&self) -> Offers {
        Offers::new()
    }

    /// What the components say of themselves, for `ztl describe`, `ztl check` and others. Called once, on registration.
    /// [`parse`](crate::describe::parse) reads a description; with the feature `schemars`,
    /// `ztl_std::describe::of_type` makes it from a type. Default: nothing.
    ///
    /// ```
    /// use ztl_std::describe::{ScopeDescriptions, parse};
    ///
    /// fn describe() -> ScopeDescriptions {
    ///     let tts = parse("{goal: {type: text, longest: 200}, about: speaks, examples: [hello there]}");
    ///     let robot = [("tts".to_owned(), tts.expect("a description"))];
    ///     ScopeDescriptions::from([("robot".to_owned(), robot.into())])
    /// }
    /// # assert_eq!(describe()["robot"]["tts"].goal.to_string(), "a text of at most 200 characters");
    /// ```
    fn describe(&self) -> ScopeDescriptions {
        ScopeDescriptions::new()
    }
}

/// A task that can be executed.
pub trait ExecutableTask: Send + 'static {
    /// Executes the task on a thread of its own, and returns the result. A panic counts as an error.
    ///
    /// A task that can be stopped asks `context` whether it should; see [`TaskContext::sleep`].
    ///
    /// # Errors
    /// Why the goal was not reached (FAILED), or [`TaskError::aborted`] if the task was stopped on request
    /// (ABORTED).
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError>;

    /// Whether the task can be stopped. If not, an ABORT is answered at once and the task continues. Default:
    /// yes.
    fn can_abort(&self) -> bool {
        true
    }

    /// How long the client may be silent before the task is aborted, see
    /// [`TaskReporter::needs_client`]. Default: the task continues without its client.
    fn needs_client(&self) -> Option<Duration> {
        None
    }
}

impl<F> ExecutableTask for F
where
    F: FnOnce(&TaskContext) -> Result<String, TaskError> + Send + 'static,
{
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError> {
        self(context)
    }
}

/// Why a task did not reach its goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskError {
    pub(super) message: String,
    pub(super) aborted: bool,
}

impl TaskError {
    /// The task was stopped on request; `place`, where it stopped, becomes the result.
    pub fn aborted(place: impl Into<String>) -> Self {
        Self {
            message: place.into(),
            aborted: true,
        }
    }
}

impl std::fmt::Display for TaskError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for TaskError {}

impl From<String> for TaskError {
    fn from(message: String) -> Self {
        Self {
            message,
            aborted: false,
        }
    }
}

impl From<&str> for TaskError {
    fn from(message: &str) -> Self {
        message.to_owned().into()
    }
}

impl From<Aborted> for TaskError {
    fn from(_: Aborted) -> Self {
        Self::aborted("aborted")
    }
}

/// The task was asked to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Aborted;

impl std::fmt::Display for Aborted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("aborted")
    }
}

impl std::error::Error for Aborted {}

/// What a running task uses to report and to learn of an abort.
#[derive(Debug)]
pub struct TaskContext {
    pub(super) reporter: TaskReporter,
    pub(super) abort: Arc<AbortRequest>,
}

impl TaskContext {
    /// The task's id.
    #[must_use]
    pub const fn id(&self) -> TaskId {
        self.reporter.id()
    }

    /// Sets the progress that clients see in STATUS.
    pub fn progress(&self, text: impl Into<String>) {
        self.reporter.progress(text);
    }

    /// Whether the task is asked to stop.
    #[must_use]
    pub fn is_aborted(&self) -> bool {
        self.abort.lock().requested
    }

    /// Sleeps, unless the task is asked to stop.
    ///
    /// # Errors
    /// [`Aborted`] as soon as the task is asked to stop; with `?` the task ends as ABORTED.
    pub fn sleep(&self, time: Duration) -> Result<(), Aborted> {
        // `None` if it is beyond what the clock can represent.
        let end = Instant::now().checked_add(time);
        let mut state = self.abort.lock();
        loop {
            if state.requested {
                return Err(Aborted);
            }
            let left = end.map_or(Duration::from_secs(3600), |end| {
                end.saturating_duration_since(Instant::now())
            });
            if left.is_zero() {
                return Ok(());
            }
            let waited = self.abort.changed.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// An ABORT on its way from the server's thread to the task's.
#[derive(Debug, Default)]
pub(super) struct AbortRequest {
    state: Mutex<AbortState>,
    pub(super) changed: Condvar,
}

#[derive(Debug, Default)]
pub(super) struct AbortState {
    pub(super) requested: bool,
    /// `None` until the task is assigned.
    pub(super) can_abort: Option<bool>,
}

impl AbortRequest {
    pub(super) fn lock(&self) -> MutexGuard<'_, AbortState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
