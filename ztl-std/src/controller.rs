//! Handlers whose tasks run on threads: the counterpart of the original's `TaskController` and
//! `ExecutableTask`.

mod pool;

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::string::FromUtf8Error;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ztl_core::{TaskId, TaskSpec};

use crate::Offers;
use crate::server::{AbortRefusal, ById, Hush, TaskHandler, TaskReporter, offered};
use pool::{Job, Pool};

/// What a client asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskRequest {
    /// The id that the client is given.
    pub id: TaskId,
    /// Who is to do it. `cob`
    pub handler: String,
    /// With which part. `head`
    pub component: String,
    /// To what end. `left`
    pub goal: String,
}

/// Decides what a request means.
pub trait TaskController: Send + Sync + 'static {
    /// The task for a request. Runs on the task's own thread, so it may take its time; an INIT that
    /// is undecided after 1.5 s is answered with the id all the same.
    ///
    /// # Errors
    /// What was wrong and what would be right. The client is refused with `Controller threw
    /// exception:` and this text, as the original does. A panic is refused in the same way.
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError>;

    /// The handlers and their components, for clients that ask what the server offers (`ztl describe`).
    /// Asked once, when the controller is registered. Default: nothing is told.
    fn offers(&self) -> Offers {
        Offers::new()
    }
}

/// A task that can be executed.
pub trait ExecutableTask: Send + 'static {
    /// Does it, on a thread that is its own until it has ended, and says what came of it. A panic is an
    /// error too.
    ///
    /// A task that can be stopped asks `context` whether it should; see [`TaskContext::sleep`].
    ///
    /// # Errors
    /// Why the goal was not reached (FAILED), or that it was stopped as asked
    /// ([`TaskError::aborted`], ABORTED).
    fn execute(self: Box<Self>, context: &TaskContext) -> Result<String, TaskError>;

    /// Whether the task heeds an abort at all; if not, the client is told so at once and the
    /// task goes on. Default: yes.
    fn can_abort(&self) -> bool {
        true
    }

    /// For how long the client that started the task may be silent before the task is aborted, see
    /// [`TaskReporter::needs_client`]. Default: the task is carried on without it.
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
    message: String,
    aborted: bool,
}

impl TaskError {
    /// The task has stopped because it was asked to; `place` is where, and becomes the result.
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

/// Somebody asked to stop the task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Aborted;

impl std::fmt::Display for Aborted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("aborted")
    }
}

impl std::error::Error for Aborted {}

/// A running task's view of the world.
#[derive(Debug)]
pub struct TaskContext {
    reporter: TaskReporter,
    wish: Arc<Wish>,
}

impl TaskContext {
    /// The task's id.
    #[must_use]
    pub const fn id(&self) -> TaskId {
        self.reporter.id()
    }

    /// Tells where the task is now; clients see it in STATUS.
    pub fn progress(&self, text: impl Into<String>) {
        self.reporter.progress(text);
    }

    /// Whether somebody asked to stop the task.
    #[must_use]
    pub fn is_aborted(&self) -> bool {
        self.wish.lock().abort
    }

    /// Waits, unless somebody asks to stop the task.
    ///
    /// # Errors
    /// [`Aborted`] as soon as somebody did; with `?` the task ends as ABORTED.
    pub fn sleep(&self, time: Duration) -> Result<(), Aborted> {
        // `None` is later than any clock can tell.
        let end = Instant::now().checked_add(time);
        let mut wish = self.wish.lock();
        loop {
            if wish.abort {
                return Err(Aborted);
            }
            let left = end.map_or(Duration::from_secs(3600), |end| {
                end.saturating_duration_since(Instant::now())
            });
            if left.is_zero() {
                return Ok(());
            }
            wish = self
                .wish
                .changed
                .wait_timeout(wish, left)
                .map_or_else(|poisoned| poisoned.into_inner().0, |(wish, _)| wish);
        }
    }
}

/// What clients want of a task, shared between the server's thread and the task's.
#[derive(Debug, Default)]
struct Wish {
    state: Mutex<WishState>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct WishState {
    abort: bool,
    /// Known once the task has been assigned.
    can_abort: Option<bool>,
}

impl Wish {
    fn lock(&self) -> MutexGuard<'_, WishState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

type Running = Arc<Mutex<ById<(Arc<Wish>, AbortRefusal)>>>;

/// Runs the tasks of a controller on threads, each on one that is its own as long as it runs.
pub(crate) struct Threads<C: TaskController> {
    controller: Arc<C>,
    running: Running,
    /// Those that have just come.
    new: Vec<NewTask<C>>,
    pool: Pool<NewTask<C>>,
}

/// A task that is to be run.
struct NewTask<C> {
    controller: Arc<C>,
    running: Running,
    reporter: TaskReporter,
    wish: Arc<Wish>,
    payload: String,
    hush: Hush,
}

impl<C: TaskController> Threads<C> {
    pub(crate) fn new(controller: C) -> Self {
        Self {
            controller: Arc::new(controller),
            running: Running::default(),
            new: Vec::new(),
            pool: Pool::new(),
        }
    }
}

impl<C: TaskController> Job for NewTask<C> {
    fn run(self) {
        let id = self.reporter.id();
        drop(self.hush);
        run(&*self.controller, self.reporter, &self.wish, &self.payload);
        lock(&self.running).remove(&id);
    }

    fn refuse(self) {
        lock(&self.running).remove(&self.reporter.id());
        self.reporter
            .rejected("the system gives no more threads; fewer tasks at a time may run");
    }
}

impl<C: TaskController> TaskHandler for Threads<C> {
    fn description(&self) -> Box<dyn Fn() -> String + Send> {
        let offers = self.controller.offers();
        let handlers = offers
            .iter()
            .map(|(handler, components)| (handler.as_str(), components.iter().map(String::as_str)));
        let all = offered(handlers);
        Box::new(move || all.clone())
    }

    fn start(&mut self, task: TaskReporter, payload: &str) {
        let wish = Arc::new(Wish::default());
        lock(&self.running).insert(task.id(), (Arc::clone(&wish), task.abort_refusal()));
        self.new.push(NewTask {
            controller: Arc::clone(&self.controller),
            running: Arc::clone(&self.running),
            hush: task.hush(),
            reporter: task,
            wish,
            payload: payload.to_owned(),
        });
    }

    fn all_started(&mut self) {
        if !self.new.is_empty() {
            self.pool.begin(&mut self.new);
        }
    }

    fn abort(&mut self, id: TaskId) {
        let running = lock(&self.running);
        let Some((wish, refuse)) = running.get(&id) else {
            return;
        };
        let mut state = wish.lock();
        if state.can_abort == Some(false) {
            refuse.tell();
        } else {
            state.abort = true;
            wish.changed.notify_all();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The whole life of a task, on its thread.
fn run(controller: &dyn TaskController, task: TaskReporter, wish: &Arc<Wish>, payload: &str) {
    let mut buffer = vec![0; payload.len()];
    let spec = match TaskSpec::decode(payload, &mut buffer) {
        Ok(spec) => spec,
        Err(error) => return task.threw(error.to_string()),
    };
    let request = TaskRequest {
        id: task.id(),
        handler: spec.handler.to_owned(),
        component: spec.component.to_owned(),
        goal: spec.goal.to_owned(),
    };
    // A panic of a handler ends its task; it shares nothing with others but its controller,
    // which answers for its own locks.
    let assigned = catch_unwind(AssertUnwindSafe(|| controller.assign(&request)));
    let executable = match assigned {
        Ok(Ok(executable)) => executable,
        Ok(Err(error)) => return task.threw(error.message),
        Err(panic) => return task.threw(panic_message(&*panic)),
    };
    let can_abort = executable.can_abort();
    if let Some(silence) = executable.needs_client() {
        task.needs_client(silence);
    }
    let aborted_already = {
        let mut state = wish.lock();
        state.can_abort = Some(can_abort);
        state.abort
    };
    // As long as it is where nothing has to be escaped.
    let mut reply = Vec::with_capacity(96 + payload.len());
    spec.put_initiated(task.id(), &mut |bytes: &[u8]| {
        reply.extend_from_slice(bytes)
    });
    let lossy = |error: FromUtf8Error| String::from_utf8_lossy(error.as_bytes()).into_owned();
    task.accepted(String::from_utf8(reply).unwrap_or_else(lossy));
    if aborted_already && can_abort {
        return task.aborted("aborted before it began");
    }
    if aborted_already {
        task.abort_refused();
    }
    let context = TaskContext {
        reporter: task,
        wish: Arc::clone(wish),
    };
    let outcome = catch_unwind(AssertUnwindSafe(|| executable.execute(&context)));
    let task = context.reporter;
    match outcome {
        Ok(Ok(result)) => task.completed(result),
        Ok(Err(error)) if error.aborted => task.aborted(error.message),
        Ok(Err(error)) => task.failed(error.message),
        Err(panic) => task.failed(panic_message(&*panic)),
    }
}

fn panic_message(panic: &(dyn Any + Send)) -> String {
    let message = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!("the handler panicked: {}", message.unwrap_or("no message"))
}
