//! The task server: a ZeroMQ ROUTER around `ztl-core`'s dispatcher.
//!
//! The thread that answers runs no handler's code that could block: handlers take a task and
//! return at once, and report from wherever they work.

mod access;
mod bind;
mod connections;
mod dropped;
mod handler;
mod limits;
mod listing;
mod memory;
mod report;
mod requests;
mod rounds;
mod router;
mod running;
mod touch;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tracing::{info, warn};
use ztl_core::dispatcher::{Config, Dispatcher};
use ztl_core::memory::Scope;
use ztl_core::tasks::{Task, Text};
use ztl_core::{Instant, Request, TaskId};

use crate::controller::{TaskController, Threads};
use crate::keys::can_encrypt;
use crate::random;
use crate::time;

pub use access::Access;
use access::Door;
pub use bind::BindError;
use bind::{bind, try_port};
use dropped::DroppedLog;
pub use handler::would_take;
pub use handler::{Answers, Restored, RestoredTask, TaskHandler};
pub use limits::{LIMITS, Limits, bytes};
pub use listing::{ListedTask, Listing};
pub(crate) use memory::ById;
pub use memory::offered;
use memory::{About, Grown, Heap};
pub(crate) use report::{AbortRefusal, Hush};
pub use report::{Claim, TaskReporter};
use report::{Inbox, Mailbox, Waker};
use router::Router;
pub use running::{Control, Pulse, RunningServer, Stopper};
use touch::Touch;

/// Longest message that clients and servers of this crate take from the network, in bytes.
pub const MAX_MESSAGE: usize = 1 << 20;

/// How long a task that has ended is remembered, counted from its end.
pub const KEEP: Duration = Config::new(random::FIRST, 0).keep;

/// How long before the process began the server's time does, so that the end of a task from before
/// a restart is a moment, too.
const BEFORE: Duration = Duration::from_secs(24 * 3600);

/// Now, by the server's time.
fn now() -> Instant {
    time::now() + BEFORE
}

/// Name under which the original logs.
const LOG: &str = "remote-task";

/// Where the server hears that it is to wake up.
const BELL: &str = "inproc://bell";

/// What is shown the requests about tasks.
type Witness = Box<dyn FnMut(Request, TaskId, &str) + Send>;

/// A task server that is bound and does not serve yet.
///
/// Register what it is to serve, then [`listen`](Self::listen) or [`spawn`](Self::spawn).
pub struct TaskServer {
    router: Router,
    door: Door,
    /// After the sockets: a context ends when its sockets are closed.
    context: zmq::Context,
    endpoint: String,
    dispatcher: Dispatcher<Heap>,
    /// By scope.
    handlers: Vec<Box<dyn TaskHandler>>,
    waker: Arc<Waker>,
    mailbox: Mailbox,
    inbox: Inbox,
    touch: Touch,
    /// Claims by the time at which their tasks are refused, and the reason.
    claims: BTreeMap<(Instant, TaskId), (Claim, &'static str)>,
    /// Limits that somebody wants from now on.
    next_limits: Arc<Mutex<Option<Limits>>>,
    /// Is shown what is asked of tasks.
    witness: Option<Witness>,
    dropped: DroppedLog,
    /// Whether it was said that all task ids are used up.
    said_used_up: bool,
    /// Whether the last turn took a report.
    reported: bool,
    /// Whether a handler was given a task since it was last told that these are all.
    started: bool,
}

impl TaskServer {
    /// Listens at a ZeroMQ endpoint: `tcp://127.0.0.1:12345`, `tcp://*:12345` for every interface
    /// (nobody is asked who they are), `tcp://127.0.0.1:*` for any free port.
    ///
    /// # Errors
    /// As [`BindError`] says.
    pub fn bind(endpoint: &str) -> Result<Self, BindError> {
        Self::bind_for(endpoint, Access::everybody())
    }

    /// Listens as [`bind`](Self::bind) does, for those who are allowed.
    ///
    /// # Errors
    /// As [`BindError`] says: keys without encryption are one.
    pub fn bind_for(endpoint: &str, access: Access) -> Result<Self, BindError> {
        Self::bind_with(endpoint, access, Limits::default())
    }

    /// The same, with limits of one's own.
    ///
    /// # Errors
    /// As [`bind_for`](Self::bind_for).
    pub fn bind_with(endpoint: &str, access: Access, limits: Limits) -> Result<Self, BindError> {
        if access.encrypts() && !can_encrypt() {
            return Err(BindError::NoCurve);
        }
        let context = zmq::Context::new();
        let socket = context.socket(zmq::ROUTER)?;
        socket.set_linger(0)?;
        limits.set(&socket)?;
        let door = Door::new(access, limits.connections, &context, &socket)?;
        // The bell rings among the requests.
        socket.bind(BELL)?;
        let bell = context.socket(zmq::DEALER)?;
        bell.set_linger(0)?;
        bell.connect(BELL)?;
        let waker = Waker::new(bell);
        let bound = bind(&socket, endpoint)?;
        let (mailbox, inbox) = Mailbox::new(Arc::clone(&waker));
        // As the original says it, and with the port that was chosen.
        let named = endpoint
            .rsplit_once(':')
            .map_or(endpoint, |(address, _)| address);
        let port = bound.rsplit_once(':').map_or("", |(_, port)| port);
        info!(target: LOG, "Task Server listening at '{named}:{port}'");
        let mut config = Config::new(random::first_task_id(), random::nonzero());
        config.keep = limits.keep;
        Ok(Self {
            router: Router::new(socket),
            door,
            context,
            endpoint: bound,
            dispatcher: Dispatcher::new(Heap::new(limits), config),
            handlers: Vec::new(),
            waker,
            mailbox,
            inbox,
            touch: Touch::default(),
            claims: BTreeMap::new(),
            next_limits: Arc::default(),
            witness: None,
            dropped: DroppedLog::default(),
            said_used_up: false,
            reported: false,
            started: false,
        })
    }

    /// Tries all that [`bind_with`](Self::bind_with) does at this address and port, without taking the port
    /// from a server that is started meanwhile.
    ///
    /// # Errors
    /// As [`bind_with`](Self::bind_with).
    pub fn check(bind: &str, port: u16, access: Access, limits: Limits) -> Result<(), BindError> {
        let endpoint = format!("tcp://{bind}:{port}");
        // At any free port, so that nobody else is disturbed.
        let server = Self::bind_with(&format!("tcp://{bind}:*"), access, limits);
        let server = server.map_err(|error| error.at(&endpoint))?;
        let address = server.endpoint.strip_prefix("tcp://");
        match address.and_then(|address| address.parse::<SocketAddr>().ok()) {
            Some(mut address) => {
                address.set_port(port);
                try_port(address, &endpoint)
            }
            None => Ok(()),
        }
    }

    /// Opens another socket to whoever may connect to this one, and says where.
    #[cfg(feature = "gateway")]
    pub(crate) fn bind_another(
        &self,
        kind: zmq::SocketType,
        endpoint: &str,
    ) -> Result<(zmq::Socket, String), BindError> {
        let socket = self.context.socket(kind)?;
        socket.set_linger(0)?;
        socket.set_maxmsgsize(MAX_MESSAGE as i64)?;
        self.door.guard(&socket)?;
        let bound = bind(&socket, endpoint)?;
        Ok((socket, bound))
    }

    /// Where it listens, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Serves a scope with tasks that run on threads. A second registration replaces the first.
    pub fn register(&mut self, scope: &str, controller: impl TaskController) {
        self.register_handler(scope, Threads::new(controller));
    }

    /// Serves a scope with a handler of any kind. A second registration replaces the first.
    pub fn register_handler(&mut self, scope: &str, mut handler: impl TaskHandler + 'static) {
        info!(target: LOG, "Registering controller for scope '{scope}'.");
        let restored = handler.restored();
        let about = About {
            describe: handler.description(),
            answer: handler.answers(),
            names_unknown_ids: handler.names_unknown_ids(),
        };
        let scope = self.dispatcher.memory_mut().register(scope, about);
        self.restore(scope, restored, &mut handler);
        let place = usize::from(scope.0);
        match self.handlers.get_mut(place) {
            Some(known) => *known = Box::new(handler),
            None => self.handlers.push(Box::new(handler)),
        }
    }

    /// Takes up a handler's tasks from before a restart; those that have not ended first, so that
    /// there is room for them.
    fn restore(&mut self, scope: Scope, mut restored: Restored, handler: &mut dyn TaskHandler) {
        if let Some(last) = restored.last_id {
            self.dispatcher.skip_to(last);
        }
        restored.tasks.sort_by_key(|task| task.ended);
        let now = now();
        for task in restored.tasks {
            let id = task.id;
            let mut known = Task::<_, Grown>::new(scope);
            known.state = task.state;
            known.text.set(&task.text);
            let ago = task.ended.unwrap_or_default();
            let ago = u64::try_from(ago.as_micros()).unwrap_or(u64::MAX);
            let at = Instant::from_micros(now.as_micros().saturating_sub(ago));
            known.ended = task.ended.map_or(Instant::NEVER, |_| at);
            if self.dispatcher.restore(id, known) {
                let heap = self.dispatcher.memory_mut();
                heap.note_payload(id, &task.payload, at);
            }
            if task.ended.is_none() {
                handler.resume(TaskReporter::new(id, self.mailbox.clone(), None));
            }
        }
    }

    /// Shows each STATUS and ABORT of a task that is remembered to `witness`, before it is answered: the
    /// task and the request's payload, which no handler sees. Called on the server's thread, so it must
    /// be quick.
    pub fn show_requests(&mut self, witness: impl FnMut(Request, TaskId, &str) + Send + 'static) {
        self.witness = Some(Box::new(witness));
    }

    /// A handle that ends [`listen`](Self::listen) from another thread.
    #[must_use]
    pub fn stopper(&self) -> Stopper {
        Stopper(Arc::clone(&self.waker))
    }

    /// A handle that tells from another thread whether [`listen`](Self::listen) goes its rounds.
    #[must_use]
    pub fn pulse(&self) -> Pulse {
        Pulse(Arc::clone(&self.waker))
    }

    /// A handle that changes the server from another thread.
    #[must_use]
    pub fn control(&self) -> Control {
        Control {
            access: self.door.access(),
            limits: Arc::clone(&self.next_limits),
            waker: Arc::clone(&self.waker),
        }
    }

    /// Serves until it is stopped.
    ///
    /// # Errors
    /// When ZeroMQ can no longer wait; no request can cause it.
    pub fn listen(mut self) -> Result<(), zmq::Error> {
        let mut more = false;
        while !self.waker.stopped() {
            let longest = if more { Duration::ZERO } else { Duration::MAX };
            more = self.turn(longest)?;
        }
        self.stop_handlers()
    }

    /// Serves on a thread of its own, until the returned server is dropped or stopped.
    ///
    /// # Errors
    /// When the system gives no more threads.
    pub fn spawn(self) -> std::io::Result<RunningServer> {
        let endpoint = self.endpoint.clone();
        let stopper = self.stopper();
        let thread = std::thread::Builder::new()
            .name("ztl-server".to_owned())
            .spawn(move || {
                if let Err(cause) = self.listen() {
                    warn!(target: LOG, "the server has ended: {}", cause.message());
                }
            })?;
        Ok(RunningServer {
            endpoint,
            stopper,
            thread: Some(thread),
        })
    }
}
