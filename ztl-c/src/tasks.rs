//! The running tasks of a server by id, and the calls to the program that are due.
//!
//! The library owns a task from its INIT to its end, and C has only the id. So there is nothing to free, and a
//! call for an ended task is an error.

use std::collections::{HashMap, VecDeque};
use std::ffi::CString;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_core::{State, TaskId};
use ztl_std::TaskRequest;
use ztl_std::describe::{Descriptions, ScopeDescriptions};
use ztl_std::server::{TaskHandler, TaskReporter};

use crate::border::for_c;
use crate::error::{Failure, ZTL_E_ABORTED, ZTL_E_ENDED};

/// How long tasks may take to stop when their server is freed, before they end as FAILED. The server answers
/// its clients for 1.5 s.
const STOPPING: Duration = Duration::from_millis(1400);

/// How the tasks of a scope are carried out.
#[derive(Clone, Copy)]
pub(crate) enum Execution {
    /// Each by one call, on a thread of its own.
    Thread,
    /// By short calls, one at a time.
    Calls {
        /// Whether running tasks are polled.
        polls: bool,
        /// Whether the program is told of an abort.
        aborts: bool,
    },
}

/// A request with texts for C.
pub(crate) struct CRequest {
    pub(crate) id: TaskId,
    pub(crate) handler: CString,
    pub(crate) component: CString,
    pub(crate) goal: CString,
}

/// A call that is due.
pub(crate) enum Call {
    Start(CRequest),
    Poll(TaskId),
    Abort(TaskId),
}

/// A task that has not ended.
struct RunningTask {
    reporter: TaskReporter,
    scope: usize,
    /// The text that answers the INIT; `None` once the task is accepted.
    reply: Option<String>,
    abort: bool,
    /// Whether the program knows the task. If not, there is nothing to stop.
    started: bool,
    /// When it is polled next; `None` before its start, or if it is never polled.
    poll: Option<Instant>,
}

impl RunningTask {
    /// Reports the end of the task.
    fn end(self, end: State, text: &str) {
        let Self {
            reporter, reply, ..
        } = self;
        if let Some(reply) = reply {
            // Nothing was reported yet, so it can still be rejected.
            if end == State::Rejected {
                return reporter.rejected(text);
            }
            reporter.accepted(reply);
        }
        match end {
            State::Completed => reporter.completed(text),
            State::Aborted => reporter.aborted(text),
            _ => reporter.failed(text),
        }
    }
}

#[derive(Default)]
struct TaskStates {
    running: HashMap<TaskId, RunningTask>,
    calls: VecDeque<(usize, Call)>,
    workers: Vec<JoinHandle<()>>,
    stopping: Option<Instant>,
    done: bool,
}

impl TaskStates {
    /// Whether a call is still to be made. A task that is aborted before its start ends here, so that the robot
    /// does not move.
    fn is_due(&mut self, call: &Call) -> bool {
        match call {
            Call::Start(request) => match self.running.remove(&request.id) {
                None => false,
                Some(task) if task.abort => {
                    task.end(State::Aborted, "stopped before it had begun");
                    false
                }
                Some(task) => {
                    let task = RunningTask {
                        started: true,
                        ..task
                    };
                    self.running.insert(request.id, task);
                    true
                }
            },
            Call::Poll(id) | Call::Abort(id) => {
                self.running.get(id).is_some_and(|task| task.started)
            }
        }
    }
}

/// All tasks of one server.
pub(crate) struct Tasks {
    states: Mutex<TaskStates>,
    changed: Condvar,
    /// How the tasks of each scope are carried out.
    scopes: Vec<Execution>,
    poll_every: Duration,
}

impl Tasks {
    pub(crate) fn new(scopes: Vec<Execution>, poll_every: Duration) -> Self {
        Self {
            states: Mutex::default(),
            changed: Condvar::new(),
            scopes,
            poll_every,
        }
    }

    pub(crate) const fn poll_every(&self) -> Duration {
        self.poll_every
    }

    // Reports of the program.

    pub(crate) fn accept(&self, id: TaskId) -> Result<(), Failure> {
        self.with(id, |_| ())
    }

    pub(crate) fn progress(&self, id: TaskId, text: &str) -> Result<(), Failure> {
        self.with(id, |task| task.reporter.progress(text))
    }

    pub(crate) fn reject_abort(&self, id: TaskId) -> Result<(), Failure> {
        self.with(id, |task| task.reporter.abort_rejected())
    }

    pub(crate) fn needs_client(&self, id: TaskId, silence: Duration) -> Result<(), Failure> {
        self.with(id, |task| task.reporter.needs_client(silence))
    }

    /// Ends the task in a final state.
    pub(crate) fn end(&self, id: TaskId, end: State, text: &str) -> Result<(), Failure> {
        let task = self.lock().running.remove(&id).ok_or_else(|| ended(id))?;
        task.end(end, text);
        self.changed.notify_all();
        Ok(())
    }

    pub(crate) fn is_aborted(&self, id: TaskId) -> bool {
        self.lock().running.get(&id).is_none_or(|task| task.abort)
    }

    /// Sleeps, unless the task has ended or is asked to stop.
    pub(crate) fn sleep(&self, id: TaskId, time: Duration) -> Result<(), Failure> {
        let end = Instant::now() + time;
        let mut states = self.lock();
        loop {
            match states.running.get(&id) {
                None => return Err(ended(id)),
                Some(task) if task.abort => {
                    let text = format!("task {id} is to be stopped");
                    return Err(Failure::new(ZTL_E_ABORTED, text));
                }
                Some(_) => {}
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            states = self.wait(states, left);
        }
    }

    /// Accepts a running task and does something with it.
    fn with(&self, id: TaskId, work: impl FnOnce(&RunningTask)) -> Result<(), Failure> {
        let mut states = self.lock();
        let task = states.running.get_mut(&id).ok_or_else(|| ended(id))?;
        if let Some(reply) = task.reply.take() {
            task.reporter.accepted(reply);
        }
        work(task);
        Ok(())
    }

    // Calls that are due.

    /// Waits until `deadline` for the next call; returns its scope as well.
    pub(crate) fn next_call(&self, deadline: Instant) -> Option<(usize, Call)> {
        let mut states = self.lock();
        loop {
            while let Some((scope, call)) = states.calls.pop_front() {
                if states.is_due(&call) {
                    return Some((scope, call));
                }
            }
            let now = Instant::now();
            let polled = states.running.iter_mut();
            let polled = polled.filter_map(|(id, task)| task.poll.map(|at| (at, *id, task)));
            let next = polled.min_by_key(|(at, ..)| *at);
            let mut wake = deadline;
            if let Some((at, id, task)) = next {
                if at <= now {
                    task.poll = Some(now + self.poll_every);
                    return Some((task.scope, Call::Poll(id)));
                }
                wake = wake.min(at);
            }
            let left = wake.saturating_duration_since(now);
            if left.is_zero() || states.done {
                return None;
            }
            states = self.wait(states, left);
        }
    }

    /// The program has started the task: accepts it, and polls it from now on.
    pub(crate) fn on_started(&self, id: TaskId) {
        // Fails if the task has already ended.
        let _ = self.accept(id);
        let mut states = self.lock();
        if let Some(task) = states.running.get_mut(&id)
            && let Some(Execution::Calls { polls: true, .. }) = self.scopes.get(task.scope)
        {
            task.poll = Some(Instant::now());
        }
    }

    // The end of the server.

    /// Asks all tasks to stop.
    pub(crate) fn stop(&self) {
        let mut states = self.lock();
        states.stopping.get_or_insert_with(Instant::now);
        let ids: Vec<TaskId> = states.running.keys().copied().collect();
        for id in ids {
            self.request_abort(&mut states, id);
        }
        self.changed.notify_all();
    }

    /// Makes no more calls.
    pub(crate) fn finish(&self) {
        self.lock().done = true;
        self.changed.notify_all();
    }

    pub(crate) fn is_finished(&self) -> bool {
        self.lock().done
    }

    /// Waits for the threads of all tasks, however long that takes.
    pub(crate) fn join(&self) {
        loop {
            let Some(worker) = self.lock().workers.pop() else {
                return;
            };
            // A panic there has been printed.
            let _ = worker.join();
        }
    }

    /// Waits for the tasks of a scope to stop; those that do not end as FAILED.
    fn end_scope(&self, scope: usize) {
        let mut states = self.lock();
        let begin = *states.stopping.get_or_insert_with(Instant::now);
        loop {
            let left = (begin + STOPPING).saturating_duration_since(Instant::now());
            if left.is_zero() || !states.running.values().any(|task| task.scope == scope) {
                break;
            }
            states = self.wait(states, left);
        }
        // Dropped reporters end their tasks.
        states.running.retain(|_, task| task.scope != scope);
        self.changed.notify_all();
    }

    fn request_abort(&self, states: &mut TaskStates, id: TaskId) {
        let Some(task) = states.running.get_mut(&id) else {
            return;
        };
        let first = !std::mem::replace(&mut task.abort, true);
        let scope = task.scope;
        if first && let Some(Execution::Calls { aborts: true, .. }) = self.scopes.get(scope) {
            states.calls.push_back((scope, Call::Abort(id)));
        }
    }

    fn lock(&self) -> MutexGuard<'_, TaskStates> {
        self.states.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(
        &self,
        states: MutexGuard<'a, TaskStates>,
        time: Duration,
    ) -> MutexGuard<'a, TaskStates> {
        let waited = self.changed.wait_timeout(states, time);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }
}

fn ended(id: TaskId) -> Failure {
    let text = format!("task {id} has ended, or this server never had it");
    Failure::new(ZTL_E_ENDED, text)
}

/// Carries out a task by one call.
pub(crate) type Work = Arc<dyn Fn(&CRequest) + Send + Sync>;

/// The handler of one scope.
pub(crate) struct Handler {
    pub(crate) tasks: Arc<Tasks>,
    pub(crate) scope: usize,
    /// The call that carries out a task, if tasks run on threads.
    pub(crate) work: Option<Work>,
    pub(crate) described: Arc<ScopeDescriptions>,
}

impl TaskHandler for Handler {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        let id = request.id;
        let texts = [&request.handler, &request.component, &request.goal];
        if texts.iter().any(|text| text.contains('\0')) {
            return task.threw("a task must not contain a zero byte");
        }
        let reply = Some(request.reply());
        let [handler, component, goal] = texts.map(|text| for_c(text));
        let request = CRequest {
            id,
            handler,
            component,
            goal,
        };
        let mut states = self.tasks.lock();
        let running = RunningTask {
            reporter: task,
            scope: self.scope,
            reply,
            // The server may be about to be freed.
            abort: states.stopping.is_some(),
            started: false,
            poll: None,
        };
        states.running.insert(id, running);
        let Some(work) = self.work.clone() else {
            states.calls.push_back((self.scope, Call::Start(request)));
            self.tasks.changed.notify_all();
            return;
        };
        let tasks = Arc::clone(&self.tasks);
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-task-{id}"))
            .spawn(move || {
                work(&request);
                let text = "the handler returned without an end of the task";
                // Fails if the task has ended.
                let _ = tasks.end(id, State::Failed, text);
            });
        states.workers.retain(|worker| !worker.is_finished());
        match spawned {
            Ok(worker) => states.workers.push(worker),
            Err(error) => {
                drop(states);
                let text = format!("the system gives no thread: {error}");
                // Cannot fail: the task was inserted just before.
                let _ = self.tasks.end(id, State::Rejected, &text);
            }
        }
    }

    fn describe(&self) -> Descriptions {
        let described = Arc::clone(&self.described);
        Box::new(move || Arc::clone(&described))
    }

    fn abort(&mut self, id: TaskId) {
        let mut states = self.tasks.lock();
        self.tasks.request_abort(&mut states, id);
        self.tasks.changed.notify_all();
    }
}

impl Drop for Handler {
    fn drop(&mut self) {
        self.tasks.end_scope(self.scope);
    }
}
