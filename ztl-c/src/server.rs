//! A task server for C.

pub mod functions;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ffi::{c_char, c_int, c_uint, c_void};
use std::path::Path;
use std::ptr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_std::describe::{self, ScopeDescriptions};
use ztl_std::keys::{KeyPair, PublicKey};
use ztl_std::scope;
use ztl_std::{Access, Limits, RunningServer, TaskServer};

use crate::border::{Context, copy_out, guard, null, text};
use crate::error::{
    Failure, ZTL_E_ADDRESS, ZTL_E_ARGUMENT, ZTL_E_BUSY, ZTL_E_NULL, ZTL_E_PANIC, ZTL_E_STATE,
    ZTL_E_SYSTEM, ZTL_OK,
};
use crate::signals;
use crate::tasks::{CRequest, Call, Execution, Handler, Tasks, Work};

/// Longest message of a client, in bytes. Default and most: 1048576.
pub const ZTL_MAX_MESSAGE: c_int = 1;
/// Tasks that have not ended. Default 10000.
pub const ZTL_MAX_RUNNING: c_int = 2;
/// Tasks in the task table, running or ended. Default 10000.
pub const ZTL_MAX_REMEMBERED: c_int = 3;
/// How long a task is kept after its end, in milliseconds. Default 3600000 (an hour).
pub const ZTL_KEEP_MS: c_int = 4;
/// Requests whose answer is held. Default 10000.
pub const ZTL_MAX_HELD: c_int = 5;
/// Clients whose last started task is remembered. Default 10000.
pub const ZTL_MAX_CLIENTS: c_int = 6;
/// Messages per connection that wait. Default 256.
pub const ZTL_MAX_QUEUE: c_int = 7;
/// Connections at a time. Default 4096, or what the limit on open files leaves.
pub const ZTL_MAX_CONNECTIONS: c_int = 8;
/// Longest time for the handshake of a connection, in milliseconds. Default 5000.
pub const ZTL_HANDSHAKE_MS: c_int = 9;
/// How often a running task's `poll` is called, in milliseconds. Default 10.
pub const ZTL_POLL_MS: c_int = 10;

/// A task server, from ztl_server_new to ztl_server_free. Its functions may be called from any thread.
pub struct Server {
    setup: Mutex<Setup>,
    running: Mutex<Option<Running>>,
    /// Set once the server is started.
    tasks: Mutex<Option<Arc<Tasks>>>,
    /// Held while calls are made.
    turn: Mutex<()>,
    error: Mutex<String>,
}

/// A client's request. It and its texts belong to the library and are valid during the call.
#[repr(C)]
pub struct Request {
    /// The task's id.
    pub task: c_uint,
    /// Who is to do it, such as "robot".
    pub handler: *const c_char,
    /// The part to use, such as "head".
    pub component: *const c_char,
    /// What to achieve, such as "left".
    pub goal: *const c_char,
}

/// Carries out a whole task on a thread of its own. Reports about the task with ztl_task_...(server, request->task,
/// ...), ends it with ztl_task_end, and returns. It should call ztl_task_is_aborted often, or sleep with
/// ztl_task_sleep. If it returns without ending the task, the task ends as FAILED.
pub type WorkCall = Option<
    unsafe extern "C" fn(context: *mut c_void, server: *mut Server, request: *const Request),
>;

/// Starts a task and returns at once. The task is accepted, unless it was ended with ztl_task_end.
pub type StartCall = Option<
    unsafe extern "C" fn(context: *mut c_void, server: *mut Server, request: *const Request),
>;

/// Advances a running task and returns at once. Called regularly until the task has ended.
pub type PollCall =
    Option<unsafe extern "C" fn(context: *mut c_void, server: *mut Server, task: c_uint)>;

/// Stops a task, or begins to stop it, and returns at once. Called at most once per task, after its `start`; a task that
/// is aborted before that ends as ABORTED, and neither function is called. When the task has stopped, call
/// ztl_task_end, here or later.
pub type AbortCall =
    Option<unsafe extern "C" fn(context: *mut c_void, server: *mut Server, task: c_uint)>;

#[derive(Default)]
struct Setup {
    limits: Limits,
    access: Access,
    poll_every: Option<Duration>,
    scopes: Vec<(String, Callbacks)>,
    /// What the components of each scope say of themselves.
    described: BTreeMap<String, ScopeDescriptions>,
}

struct Running {
    server: RunningServer,
    calls: Arc<Calls>,
    /// The thread that makes the calls, unless the program does.
    caller: Option<JoinHandle<()>>,
}

/// The server as it is passed to callbacks.
#[derive(Clone, Copy)]
struct Handle(*mut Server);

// SAFETY: it is only passed to callbacks, which may use it on any thread. It outlives them, since freeing a
// server waits for its callbacks.
unsafe impl Send for Handle {}
// SAFETY: as above.
unsafe impl Sync for Handle {}

/// The program's functions for one scope.
#[derive(Clone, Copy)]
enum Functions {
    Worker(WorkCall),
    Handler {
        start: StartCall,
        poll: PollCall,
        abort: AbortCall,
    },
}

#[derive(Clone, Copy)]
struct Callbacks {
    functions: Functions,
    context: Context,
}

impl Callbacks {
    fn execution(&self) -> Execution {
        match self.functions {
            Functions::Worker(_) => Execution::Thread,
            Functions::Handler { poll, abort, .. } => Execution::Calls {
                polls: poll.is_some(),
                aborts: abort.is_some(),
            },
        }
    }

    /// The call that carries out a task, if tasks run on threads.
    fn work(self, handle: Handle) -> Option<Work> {
        let Functions::Worker(Some(work)) = self.functions else {
            return None;
        };
        let context = self.context;
        Some(Arc::new(move |request: &CRequest| {
            // Captures the wrappers, which may be sent to threads, and not the pointers in them.
            let (handle, context) = (&handle, &context);
            let request = Request::of(request);
            // SAFETY: the program's function, called as the header says: the server outlives its tasks'
            // threads, and the request the call.
            call(*handle, || unsafe {
                work(context.0, handle.0, &raw const request)
            });
        }))
    }
}

impl Request {
    /// The texts live as long as `request`.
    fn of(request: &CRequest) -> Self {
        Self {
            task: request.id.get(),
            handler: request.handler.as_ptr(),
            component: request.component.as_ptr(),
            goal: request.goal.as_ptr(),
        }
    }
}

/// Makes the calls to handlers.
struct Calls {
    tasks: Arc<Tasks>,
    scopes: Vec<Callbacks>,
    handle: Handle,
}

impl Calls {
    /// Makes the next call, after waiting for it until `deadline`; returns whether there was one.
    fn make_next(&self, deadline: Instant) -> bool {
        let Some((scope, next)) = self.tasks.next_call(deadline) else {
            return false;
        };
        let Some(Callbacks {
            functions: Functions::Handler { start, poll, abort },
            context: Context(context),
        }) = self.scopes.get(scope).copied()
        else {
            return true;
        };
        let Handle(server) = self.handle;
        match next {
            Call::Start(request) => {
                let id = request.id;
                let shown = Request::of(&request);
                if let Some(start) = start {
                    // SAFETY: the program's function, called as the header says: the server outlives the
                    // calls, and the request this one.
                    call(self.handle, || unsafe {
                        start(context, server, &raw const shown)
                    });
                }
                self.tasks.on_started(id);
            }
            Call::Poll(id) => {
                if let Some(poll) = poll {
                    // SAFETY: as above.
                    call(self.handle, || unsafe { poll(context, server, id.get()) });
                }
            }
            Call::Abort(id) => {
                if let Some(abort) = abort {
                    // SAFETY: as above.
                    call(self.handle, || unsafe { abort(context, server, id.get()) });
                }
            }
        }
        true
    }
}

thread_local! {
    /// The servers whose callbacks run on this thread. It must not wait for their end.
    static CALLED: RefCell<Vec<*mut Server>> = const { RefCell::new(Vec::new()) };
}

impl Server {
    /// Does something with a server, and keeps the message of an error.
    ///
    /// # Safety
    /// `server` is NULL, or was made by `ztl_server_new` and is not freed.
    pub(crate) unsafe fn with(
        server: *const Self,
        work: impl FnOnce(&Self) -> Result<(), Failure>,
    ) -> c_int {
        // SAFETY: as the caller promises; all references to it are shared ones.
        let Some(server) = (unsafe { server.as_ref() }) else {
            return ZTL_E_NULL;
        };
        let panicked = || Failure::new(ZTL_E_PANIC, "a mistake in the library; see stderr");
        match guard(Err(panicked()), || work(server)) {
            Ok(()) => ZTL_OK,
            Err(failure) => {
                *lock(&server.error) = failure.text;
                failure.code
            }
        }
    }

    /// Its tasks, once it is started.
    pub(crate) fn tasks(&self) -> Result<Arc<Tasks>, Failure> {
        lock(&self.tasks).clone().ok_or_else(not_started)
    }

    /// Changes the setup of a server that is not started.
    fn set_up(&self, work: impl FnOnce(&mut Setup) -> Result<(), Failure>) -> Result<(), Failure> {
        if lock(&self.running).is_some() {
            let text = "the server is already started; call this before";
            return Err(Failure::new(ZTL_E_STATE, text));
        }
        work(&mut lock(&self.setup))
    }

    fn add(&self, scope: &str, functions: Functions, context: *mut c_void) -> Result<(), Failure> {
        if let Some(mistake) = scope::cannot_be_served(scope) {
            return Err(Failure::new(ZTL_E_ARGUMENT, mistake));
        }
        self.set_up(|setup| {
            if setup.scopes.iter().any(|(known, _)| known == scope) {
                let text = format!("the scope '{scope}' is served already");
                return Err(Failure::new(ZTL_E_ARGUMENT, text));
            }
            let context = Context(context);
            let callbacks = Callbacks { functions, context };
            setup.scopes.push((scope.to_owned(), callbacks));
            Ok(())
        })
    }

    fn start(&self, handle: Handle, endpoint: &str, on_thread: bool) -> Result<(), Failure> {
        let mut running = lock(&self.running);
        if running.is_some() {
            return Err(Failure::new(ZTL_E_STATE, "the server is started already"));
        }
        let setup = lock(&self.setup);
        let scopes: Vec<Callbacks> = setup.scopes.iter().map(|(_, scope)| *scope).collect();
        let poll_every = setup.poll_every.unwrap_or(Duration::from_millis(10));
        let execution = scopes.iter().map(Callbacks::execution).collect();
        let tasks = Arc::new(Tasks::new(execution, poll_every));
        let calls = Arc::new(Calls {
            tasks: Arc::clone(&tasks),
            scopes,
            handle,
        });
        let system = |error: std::io::Error| {
            Failure::new(ZTL_E_SYSTEM, format!("the system gives no thread: {error}"))
        };
        *running = Some(signals::blocked(|| {
            let mut server = TaskServer::builder()
                .access(setup.access.clone())
                .limits(setup.limits)
                .bind(endpoint)
                .map_err(|error| match error.into() {
                    // Not an address of any form, so the usual hint does not apply.
                    Failure { code, .. } if code == ZTL_E_ADDRESS && !endpoint.contains("://") => {
                        let text = format!(
                            "'{endpoint}' is not an address; write it as tcp://0.0.0.0:12345"
                        );
                        Failure::new(ZTL_E_ARGUMENT, text)
                    }
                    failure => failure,
                })?;
            for (index, (scope, callbacks)) in setup.scopes.iter().enumerate() {
                let described = setup.described.get(scope).cloned();
                let handler = Handler {
                    described: Arc::new(described.unwrap_or_default()),
                    tasks: Arc::clone(&tasks),
                    scope: index,
                    work: callbacks.work(handle),
                };
                server.register_handler(scope, handler);
            }
            let caller = if on_thread {
                let calls = Arc::clone(&calls);
                let caller = std::thread::Builder::new().name("ztl-calls".to_owned());
                let caller = caller.spawn(move || {
                    while !calls.tasks.is_finished() {
                        calls.make_next(Instant::now() + Duration::from_secs(60));
                    }
                });
                Some(caller.map_err(system)?)
            } else {
                None
            };
            // Callbacks may run before this returns.
            *lock(&self.tasks) = Some(Arc::clone(&tasks));
            let server = server
                .spawn()
                .map_err(system)
                .inspect_err(|_| tasks.finish())?;
            Ok::<_, Failure>(Running {
                server,
                calls,
                caller,
            })
        })?);
        Ok(())
    }

    /// Waits for the first due call, and makes all due calls.
    fn poll(&self, wait: Duration) -> Result<(), Failure> {
        let (calls, polled) = {
            let running = lock(&self.running);
            let running = running.as_ref().ok_or_else(not_started)?;
            if !running.server.is_running() {
                let text = "the server has ended: ZeroMQ could no longer wait";
                return Err(Failure::new(ZTL_E_SYSTEM, text));
            }
            (Arc::clone(&running.calls), running.caller.is_none())
        };
        let deadline = Instant::now() + wait;
        if !polled {
            std::thread::sleep(wait);
            return Ok(());
        }
        let Ok(_turn) = self.turn.try_lock() else {
            let text =
                "ztl_server_poll is under way already, in another thread or around this callback";
            return Err(Failure::new(ZTL_E_BUSY, text));
        };
        let begin = Instant::now();
        let mut made = calls.make_next(deadline);
        // Only the calls that are due now, since they may cause others.
        while made && begin.elapsed() < calls.tasks.poll_every() {
            made = calls.make_next(begin);
        }
        Ok(())
    }

    /// Stops the server, and waits for all its threads.
    fn stop(&self) {
        let running = lock(&self.running).take();
        let Some(Running {
            server,
            calls,
            caller,
        }) = running
        else {
            return;
        };
        let tasks = &calls.tasks;
        tasks.stop();
        if caller.is_some() {
            drop(server);
        } else {
            // Makes the calls on this thread, so that tasks can stop.
            let stopping = || std::thread::Builder::new().spawn(move || drop(server));
            let stopping = signals::blocked(stopping);
            while stopping
                .as_ref()
                .is_ok_and(|stopping| !stopping.is_finished())
            {
                calls.make_next(Instant::now() + Duration::from_millis(5));
            }
        }
        tasks.finish();
        tasks.join();
        // A panic there was printed.
        let _ = caller.map(JoinHandle::join);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn not_started() -> Failure {
    Failure::new(ZTL_E_STATE, "the server is not started")
}

fn millis(time: c_uint) -> Duration {
    Duration::from_millis(time.into())
}

/// Calls the program. Meanwhile this thread must not free the server.
fn call(handle: Handle, callback: impl FnOnce()) {
    CALLED.with_borrow_mut(|called| called.push(handle.0));
    callback();
    CALLED.with_borrow_mut(Vec::pop);
}

/// Reads a key pair.
pub(crate) fn read_keys(file: &str) -> Result<KeyPair, Failure> {
    Ok(KeyPair::read(Path::new(file))?)
}
