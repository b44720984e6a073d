//! The tasks that a server's callbacks carry out, by their ids; and the calls that are due.
//!
//! A task is the server's from its INIT to its end, and C has only its id: there is nothing to free
//! twice or too late, and a call for a task that has ended says so.

use std::collections::{HashMap, VecDeque};
use std::ffi::{CString, c_void};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_core::{State, TaskId, TaskSpec};
use ztl_std::server::{TaskHandler, TaskReporter};

use crate::border::for_c;
use crate::error::{Failure, ZTL_E_ABORTED, ZTL_E_ENDED};
use crate::server::{AbortCall, PollCall, Request, Server, StartCall, WorkCall};

/// How long tasks have to stop when their server is freed, before they end as FAILED. The server
/// answers its clients for 1.5 s then.
const STOPPING: Duration = Duration::from_millis(1400);

/// What belongs to the program: nothing here looks into it.
#[derive(Clone, Copy)]
pub(crate) struct Context(pub(crate) *mut c_void);

// SAFETY: it is only handed back to the program's callbacks; that they may be called from other threads
// is what the header says of them.
unsafe impl Send for Context {}
// SAFETY: as above.
unsafe impl Sync for Context {}

/// The server's handle, as callbacks are given it.
#[derive(Clone, Copy)]
pub(crate) struct Handle(pub(crate) *mut Server);

// SAFETY: it is only handed to callbacks, whose functions take it on any thread; it outlives them, since
// freeing a server waits for its callbacks.
unsafe impl Send for Handle {}
// SAFETY: as above.
unsafe impl Sync for Handle {}

/// How the tasks of a scope are carried out.
#[derive(Clone, Copy)]
pub(crate) enum Way {
    /// Each by one call, on a thread of its own.
    Threads(WorkCall),
    /// By short calls, one at a time.
    Calls {
        start: StartCall,
        poll: PollCall,
        abort: AbortCall,
    },
}

#[derive(Clone, Copy)]
pub(crate) struct Scope {
    pub(crate) way: Way,
    pub(crate) context: Context,
}

/// A request as C is shown it; it lies still while C looks at it.
pub(crate) struct Asked {
    id: TaskId,
    handler: CString,
    component: CString,
    goal: CString,
}

impl Asked {
    pub(crate) fn request(&self) -> Request {
        Request {
            task: self.id.get(),
            handler: self.handler.as_ptr(),
            component: self.component.as_ptr(),
            goal: self.goal.as_ptr(),
        }
    }
}

/// A call that is due.
pub(crate) enum Call {
    Start(Asked),
    Poll(TaskId),
    Abort(TaskId),
}

struct Open {
    reporter: TaskReporter,
    scope: usize,
    /// What the client is told when the task is accepted; `None` once it was.
    welcome: Option<String>,
    abort: bool,
    /// Whether the program was told of it: of what was not, nothing has to be stopped.
    begun: bool,
    /// When it is polled next; `None` before its start and where there is no `poll`.
    poll: Option<Instant>,
}

impl Open {
    /// Tells the end of the task, as its first word if need be.
    fn end(self, end: State, text: &str) {
        let Self {
            reporter, welcome, ..
        } = self;
        if let Some(welcome) = welcome {
            // Nothing was told yet, so it can still be refused.
            if end == State::Rejected {
                return reporter.rejected(text);
            }
            reporter.accepted(welcome);
        }
        match end {
            State::Completed => reporter.completed(text),
            State::Aborted => reporter.aborted(text),
            _ => reporter.failed(text),
        }
    }
}

#[derive(Default)]
struct Book {
    open: HashMap<TaskId, Open>,
    calls: VecDeque<(usize, Call)>,
    workers: Vec<JoinHandle<()>>,
    stopping: Option<Instant>,
    done: bool,
}

impl Book {
    /// Whether a call is still to be made. What was to stop before it has begun ends here: a robot must not
    /// begin to move for that.
    fn is_due(&mut self, call: &Call) -> bool {
        match call {
            Call::Start(asked) => match self.open.remove(&asked.id) {
                None => false,
                Some(open) if open.abort => {
                    open.end(State::Aborted, "stopped before it had begun");
                    false
                }
                Some(open) => {
                    let begun = Open {
                        begun: true,
                        ..open
                    };
                    self.open.insert(asked.id, begun);
                    true
                }
            },
            Call::Poll(id) | Call::Abort(id) => self.open.get(id).is_some_and(|open| open.begun),
        }
    }
}

/// All tasks of one server.
pub(crate) struct Tasks {
    book: Mutex<Book>,
    changed: Condvar,
    scopes: Vec<Scope>,
    handle: Handle,
    poll_every: Duration,
}

impl Tasks {
    pub(crate) fn new(scopes: Vec<Scope>, handle: Handle, poll_every: Duration) -> Self {
        Self {
            book: Mutex::default(),
            changed: Condvar::new(),
            scopes,
            handle,
            poll_every,
        }
    }

    pub(crate) const fn handle(&self) -> Handle {
        self.handle
    }

    pub(crate) fn scope(&self, index: usize) -> Option<Scope> {
        self.scopes.get(index).copied()
    }

    pub(crate) const fn poll_every(&self) -> Duration {
        self.poll_every
    }

    // What callbacks tell.

    pub(crate) fn accept(&self, id: TaskId) -> Result<(), Failure> {
        self.with(id, |_| ())
    }

    pub(crate) fn progress(&self, id: TaskId, text: &str) -> Result<(), Failure> {
        self.with(id, |open| open.reporter.progress(text))
    }

    pub(crate) fn refuse_abort(&self, id: TaskId) -> Result<(), Failure> {
        self.with(id, |open| open.reporter.abort_refused())
    }

    pub(crate) fn needs_client(&self, id: TaskId, silence: Duration) -> Result<(), Failure> {
        self.with(id, |open| open.reporter.needs_client(silence))
    }

    /// Ends the task in a final state.
    pub(crate) fn end(&self, id: TaskId, end: State, text: &str) -> Result<(), Failure> {
        let open = self.lock().open.remove(&id).ok_or_else(|| ended(id))?;
        open.end(end, text);
        self.changed.notify_all();
        Ok(())
    }

    pub(crate) fn is_aborted(&self, id: TaskId) -> bool {
        self.lock().open.get(&id).is_none_or(|open| open.abort)
    }

    /// Waits, unless somebody asks to stop the task, or it has ended.
    pub(crate) fn sleep(&self, id: TaskId, time: Duration) -> Result<(), Failure> {
        let end = Instant::now() + time;
        let mut book = self.lock();
        loop {
            match book.open.get(&id) {
                None => return Err(ended(id)),
                Some(open) if open.abort => {
                    let text = format!("task {id} is to be stopped");
                    return Err(Failure::new(ZTL_E_ABORTED, text));
                }
                Some(_) => {}
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            book = self.wait(book, left);
        }
    }

    /// Does something with a task that has not ended, which is accepted by that.
    fn with(&self, id: TaskId, work: impl FnOnce(&Open)) -> Result<(), Failure> {
        let mut book = self.lock();
        let open = book.open.get_mut(&id).ok_or_else(|| ended(id))?;
        if let Some(welcome) = open.welcome.take() {
            open.reporter.accepted(welcome);
        }
        work(open);
        Ok(())
    }

    // Calls that are due.

    /// The next call, waited for until `deadline`.
    pub(crate) fn next_call(&self, deadline: Instant) -> Option<(Scope, Call)> {
        let mut book = self.lock();
        loop {
            while let Some((scope, call)) = book.calls.pop_front() {
                if book.is_due(&call) {
                    return self.scope(scope).map(|scope| (scope, call));
                }
            }
            let now = Instant::now();
            let polled = book.open.iter_mut();
            let polled = polled.filter_map(|(id, open)| open.poll.map(|at| (at, *id, open)));
            let next = polled.min_by_key(|(at, ..)| *at);
            let mut wake = deadline;
            if let Some((at, id, open)) = next {
                if at <= now {
                    open.poll = Some(now + self.poll_every);
                    return self.scope(open.scope).map(|scope| (scope, Call::Poll(id)));
                }
                wake = wake.min(at);
            }
            let left = wake.saturating_duration_since(now);
            if left.is_zero() || book.done {
                return None;
            }
            book = self.wait(book, left);
        }
    }

    /// The callback has begun the task: it is accepted unless that was told already, and polled.
    pub(crate) fn begun(&self, id: TaskId) {
        // A task that has ended already needs neither.
        let _ = self.accept(id);
        let mut book = self.lock();
        if let Some(open) = book.open.get_mut(&id)
            && let Some(Scope {
                way: Way::Calls { poll: Some(_), .. },
                ..
            }) = self.scopes.get(open.scope)
        {
            open.poll = Some(Instant::now());
        }
    }

    // The server's end.

    /// Asks all tasks to stop.
    pub(crate) fn stop(&self) {
        let mut book = self.lock();
        book.stopping.get_or_insert_with(Instant::now);
        let ids: Vec<TaskId> = book.open.keys().copied().collect();
        for id in ids {
            self.ask_to_stop(&mut book, id);
        }
        self.changed.notify_all();
    }

    /// No call is made any more.
    pub(crate) fn finish(&self) {
        self.lock().done = true;
        self.changed.notify_all();
    }

    pub(crate) fn is_finished(&self) -> bool {
        self.lock().done
    }

    /// Waits for the threads of tasks to end, however long that takes.
    pub(crate) fn join(&self) {
        loop {
            let Some(worker) = self.lock().workers.pop() else {
                return;
            };
            // A panic there has been printed.
            let _ = worker.join();
        }
    }

    /// The tasks of a scope that do not stop end as FAILED.
    fn leave(&self, scope: usize) {
        let mut book = self.lock();
        let begin = *book.stopping.get_or_insert_with(Instant::now);
        loop {
            let left = (begin + STOPPING).saturating_duration_since(Instant::now());
            if left.is_zero() || !book.open.values().any(|open| open.scope == scope) {
                break;
            }
            book = self.wait(book, left);
        }
        // Reporters that are dropped say so to their clients.
        book.open.retain(|_, open| open.scope != scope);
        self.changed.notify_all();
    }

    fn ask_to_stop(&self, book: &mut Book, id: TaskId) {
        let Some(open) = book.open.get_mut(&id) else {
            return;
        };
        let first = !std::mem::replace(&mut open.abort, true);
        let scope = open.scope;
        if first
            && let Some(Scope {
                way: Way::Calls { abort: Some(_), .. },
                ..
            }) = self.scopes.get(scope)
        {
            book.calls.push_back((scope, Call::Abort(id)));
        }
    }

    fn lock(&self) -> MutexGuard<'_, Book> {
        self.book.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, book: MutexGuard<'a, Book>, time: Duration) -> MutexGuard<'a, Book> {
        let waited = self.changed.wait_timeout(book, time);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }
}

fn ended(id: TaskId) -> Failure {
    let text = format!("task {id} has ended, or this server never had it");
    Failure::new(ZTL_E_ENDED, text)
}

/// What the server gives the tasks of a scope to.
pub(crate) struct Handler {
    pub(crate) tasks: Arc<Tasks>,
    pub(crate) scope: usize,
    /// Makes the call that is a task.
    pub(crate) work: fn(&Tasks, Scope, Asked),
}

impl Handler {
    /// Admits a task; `Err` gives its reporter back with the reason.
    fn take(&self, task: TaskReporter, payload: &str) -> Option<Asked> {
        let id = task.id();
        let mut buffer = vec![0; payload.len()];
        let spec = match TaskSpec::decode(payload, &mut buffer) {
            Ok(spec) => spec,
            Err(error) => {
                task.threw(error.to_string());
                return None;
            }
        };
        if [spec.handler, spec.component, spec.goal]
            .iter()
            .any(|part| part.contains('\0'))
        {
            task.threw("a task must not contain a zero byte");
            return None;
        }
        let mut welcome = Vec::new();
        spec.put_initiated(id, &mut |bytes: &[u8]| welcome.extend_from_slice(bytes));
        let asked = Asked {
            id,
            handler: for_c(spec.handler),
            component: for_c(spec.component),
            goal: for_c(spec.goal),
        };
        let mut book = self.tasks.lock();
        let open = Open {
            reporter: task,
            scope: self.scope,
            welcome: Some(String::from_utf8_lossy(&welcome).into_owned()),
            // It may have come while the server is being freed.
            abort: book.stopping.is_some(),
            begun: false,
            poll: None,
        };
        book.open.insert(id, open);
        drop(book);
        Some(asked)
    }
}

impl TaskHandler for Handler {
    fn start(&mut self, task: TaskReporter, payload: &str) {
        let Some(asked) = self.take(task, payload) else {
            return;
        };
        let Some(scope) = self.tasks.scope(self.scope) else {
            return;
        };
        let mut book = self.tasks.lock();
        if let Way::Calls { .. } = scope.way {
            book.calls.push_back((self.scope, Call::Start(asked)));
            self.tasks.changed.notify_all();
            return;
        }
        let id = asked.id;
        let (tasks, work) = (Arc::clone(&self.tasks), self.work);
        let spawned = std::thread::Builder::new()
            .name(format!("ztl-task-{id}"))
            .spawn(move || {
                work(&tasks, scope, asked);
                let text = "the handler returned without an end of the task";
                // Only where that is so.
                let _ = tasks.end(id, State::Failed, text);
            });
        book.workers.retain(|worker| !worker.is_finished());
        match spawned {
            Ok(worker) => book.workers.push(worker),
            Err(error) => {
                drop(book);
                let text = format!("the system gives no thread: {error}");
                // It was put in just before.
                let _ = self.tasks.end(id, State::Rejected, &text);
            }
        }
    }

    fn abort(&mut self, id: TaskId) {
        let mut book = self.tasks.lock();
        self.tasks.ask_to_stop(&mut book, id);
        self.tasks.changed.notify_all();
    }
}

impl Drop for Handler {
    fn drop(&mut self) {
        self.tasks.leave(self.scope);
    }
}
