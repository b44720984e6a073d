//! Runs a controller's tasks on threads.

use std::any::Any;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ztl_core::TaskId;

use super::pool::{Job, Pool};
use super::task::{AbortRequest, TaskContext, TaskController};
use crate::describe::Descriptions;
use crate::offers::offered;
use crate::server::{AbortRejection, TaskHandler, TaskReporter, TaskServer, WakeBatch};
use crate::task_request::TaskRequest;

/// The tasks that have not ended, with what an ABORT needs.
type Running = Arc<Mutex<HashMap<TaskId, (Arc<AbortRequest>, AbortRejection)>>>;

/// Runs each task of a controller on a thread of its own.
struct Threads<C: TaskController> {
    controller: Arc<C>,
    running: Running,
    /// Started tasks that the pool does not have yet.
    new: Vec<NewTask<C>>,
    pool: Pool<NewTask<C>>,
}

/// A task that waits for a thread.
struct NewTask<C> {
    controller: Arc<C>,
    running: Running,
    reporter: TaskReporter,
    abort: Arc<AbortRequest>,
    request: TaskRequest,
    batch: WakeBatch,
}

impl TaskServer {
    /// Serves a scope with tasks that run on threads. A second registration replaces the first.
    pub fn register(&mut self, scope: &str, controller: impl TaskController) {
        let threads = Threads {
            controller: Arc::new(controller),
            running: Running::default(),
            new: Vec::new(),
            pool: Pool::new(),
        };
        self.register_handler(scope, threads);
    }
}

impl<C: TaskController> Job for NewTask<C> {
    fn run(self) {
        let id = self.reporter.id();
        drop(self.batch);
        run(&*self.controller, self.reporter, &self.abort, &self.request);
        lock(&self.running).remove(&id);
    }

    fn reject(self) {
        lock(&self.running).remove(&self.reporter.id());
        self.reporter
            .rejected("the system has no more threads; run fewer tasks at a time");
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

    fn describe(&self) -> Descriptions {
        let all = Arc::new(self.controller.describe());
        Box::new(move || Arc::clone(&all))
    }

    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        let abort = Arc::new(AbortRequest::default());
        lock(&self.running).insert(task.id(), (Arc::clone(&abort), task.abort_rejection()));
        self.new.push(NewTask {
            controller: Arc::clone(&self.controller),
            running: Arc::clone(&self.running),
            batch: task.wake_batch(),
            reporter: task,
            abort,
            request,
        });
    }

    fn all_started(&mut self) {
        if !self.new.is_empty() {
            self.pool.run(&mut self.new);
        }
    }

    fn abort(&mut self, id: TaskId) {
        let running = lock(&self.running);
        let Some((abort, rejection)) = running.get(&id) else {
            return;
        };
        let mut state = abort.lock();
        if state.can_abort == Some(false) {
            rejection.send();
        } else {
            state.requested = true;
            abort.changed.notify_all();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs a task from its assignment to its end, on its thread.
fn run(
    controller: &dyn TaskController,
    task: TaskReporter,
    abort: &Arc<AbortRequest>,
    request: &TaskRequest,
) {
    // A panic ends only this task: a handler shares nothing with others but its controller, which is
    // responsible for its own locks.
    let assigned = catch_unwind(AssertUnwindSafe(|| controller.assign(request)));
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
        let mut state = abort.lock();
        state.can_abort = Some(can_abort);
        state.requested
    };
    task.accepted(request.reply());
    if aborted_already && can_abort {
        return task.aborted("aborted before it began");
    }
    if aborted_already {
        task.abort_rejected();
    }
    let context = TaskContext {
        reporter: task,
        abort: Arc::clone(abort),
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
