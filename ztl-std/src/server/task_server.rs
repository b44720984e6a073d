//! A task server: bound, set up, and run.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use tracing::{info, warn};
use ztl_core::dispatcher::{Config, Dispatcher};
use ztl_core::memory::Scope;
use ztl_core::tasks::{StoredText, Task};
use ztl_core::{Instant, Request, TaskId};

use super::access::Access;
use super::bind::{BindError, try_port};
use super::client_liveness::ClientLiveness;
use super::clock::now;
use super::dropped::DroppedLog;
use super::engine::Engine;
use super::handle::{RunningServer, ServerHandle};
use super::handler::{Restored, TaskHandler};
use super::limits::Limits;
use super::memory::{ScopeInfo, ServerMemory};
use super::own_tasks::OwnTasks;
use super::reporter::{Mailbox, TaskReporter};
use super::router::Router;
#[cfg(feature = "publish")]
use super::router::{rules, to_bind};
#[cfg(feature = "publish")]
use super::task_events::TaskEvents;
use super::task_table::HeapText;
use super::waker::Waker;
use crate::log_targets::TASKS;
#[cfg(feature = "publish")]
use crate::native::publisher::PubSocket;
#[cfg(feature = "publish")]
use crate::publish::Publisher;
use crate::random;
use crate::rate_limit::RateLimit;
use crate::transport::Transport;

/// A task server that is bound and does not serve yet.
///
/// Register what it serves, then call [`listen`](Self::listen) or [`spawn`](Self::spawn).
pub struct TaskServer {
    endpoint: String,
    engine: Engine,
}

/// Options of a server that is to be bound.
#[derive(Debug, Clone, Default)]
#[must_use]
pub struct ServerBuilder {
    access: Access,
    limits: Limits,
    transport: Transport,
}

impl ServerBuilder {
    /// Sets how ZMTP is spoken. Default: [`Transport::Native`].
    pub fn transport(mut self, transport: Transport) -> Self {
        self.transport = transport;
        self
    }

    /// Sets who may use the server. Default: everyone who reaches it.
    pub fn access(mut self, access: Access) -> Self {
        self.access = access;
        self
    }

    /// Sets the limits. Default: [`Limits::default`].
    pub fn limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// Listens at a ZeroMQ endpoint: `tcp://127.0.0.1:12345`, `tcp://*:12345` for every interface, or
    /// `tcp://127.0.0.1:*` for any free port, or `ipc:///run/robot.sock` for a socket in the file system.
    ///
    /// # Errors
    /// [`BindError`], also if there are keys and libzmq cannot encrypt.
    pub fn bind(self, endpoint: &str) -> Result<TaskServer, BindError> {
        let Self {
            access,
            limits,
            transport,
        } = self;
        let (router, bound, signal) = Router::bind(transport, access, limits, endpoint)?;
        let waker = Waker::new(signal);
        let (mailbox, inbox) = Mailbox::new(Arc::clone(&waker));
        // Logged like the original, but with the port that was chosen.
        let named = endpoint
            .rsplit_once(':')
            .map_or(endpoint, |(address, _)| address);
        let port = bound.rsplit_once(':').map_or("", |(_, port)| port);
        info!(target: TASKS, "Task Server listening at '{named}:{port}'");
        let mut config = Config::new(random::first_task_id(), random::nonzero());
        config.keep = limits.keep;
        Ok(TaskServer {
            endpoint: bound,
            engine: Engine {
                router,
                dispatcher: Dispatcher::new(ServerMemory::new(limits), config),
                handlers: Vec::new(),
                waker,
                mailbox,
                inbox,
                clients: ClientLiveness::default(),
                claims: BTreeMap::new(),
                next_limits: Arc::default(),
                observer: None,
                #[cfg(feature = "publish")]
                events: None,
                dropped: DroppedLog::new(now()),
                refusals: RateLimit::of_refusals(now()),
                logged_used_up: false,
                reported: false,
                untold: Vec::new(),
                started: false,
            },
        })
    }

    /// Checks whether [`bind`](Self::bind) would succeed at this address and port, without taking the port from a
    /// server that starts meanwhile.
    ///
    /// # Errors
    /// Those of [`bind`](Self::bind).
    pub fn check(self, address: &str, port: u16) -> Result<(), BindError> {
        let endpoint = format!("tcp://{address}:{port}");
        // Binds any free port, so that no other server is disturbed.
        let server = self.bind(&format!("tcp://{address}:*"));
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
}

impl TaskServer {
    /// A server for everyone, with default limits: as [`ServerBuilder::bind`].
    ///
    /// # Errors
    /// [`BindError`].
    pub fn bind(endpoint: &str) -> Result<Self, BindError> {
        Self::builder().bind(endpoint)
    }

    /// Sets options before binding.
    pub fn builder() -> ServerBuilder {
        ServerBuilder::default()
    }

    /// Publishes what happens to tasks, for those who may use the server (`docs/streams.md`). Returns a publisher for
    /// other values at the same place, whose scope is empty: [`Publisher::under`] gives it one.
    ///
    /// # Errors
    /// [`BindError`].
    #[cfg(feature = "publish")]
    pub fn publish_events(&mut self, endpoint: &str) -> Result<Publisher, BindError> {
        Ok(Publisher {
            socket: self.publish_at(endpoint)?,
            scope: String::new(),
        })
    }

    /// As [`publish_events`](Self::publish_events). A handler publishes at the same socket.
    #[cfg(feature = "publish")]
    pub(crate) fn publish_at(&mut self, endpoint: &str) -> Result<Arc<PubSocket>, BindError> {
        let access = self.engine.router.access();
        let limits = self.engine.dispatcher.memory().limits().of_publisher();
        let rules = rules(&access.read(), &limits);
        let socket = PubSocket::bind(&to_bind(endpoint)?, rules, access.clone(), false)
            .map_err(|error| BindError::at_endpoint(endpoint, &error))?;
        let socket = Arc::new(socket);
        self.engine.events = Some(TaskEvents::new(Arc::clone(&socket)));
        Ok(socket)
    }

    /// Where it listens, with the port that was chosen.
    #[must_use]
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Serves a scope with a handler. A second registration replaces the first.
    pub fn register_handler(&mut self, scope: &str, mut handler: impl TaskHandler + 'static) {
        info!(target: TASKS, "Registering controller for scope '{scope}'.");
        let restored = handler.restored();
        let about = ScopeInfo {
            describe: handler.description(),
            components: handler.describe(),
            answer: handler.answers(),
            names_unknown_ids: handler.names_unknown_ids(),
        };
        let scope = self.engine.dispatcher.memory_mut().register(scope, about);
        handler.connect(OwnTasks::new(scope, self.engine.mailbox.clone()));
        self.restore(scope, restored, &mut handler);
        let handlers = &mut self.engine.handlers;
        match handlers.get_mut(usize::from(scope.0)) {
            Some(known) => *known = Box::new(handler),
            None => handlers.push(Box::new(handler)),
        }
    }

    /// Takes up a handler's tasks from before a restart, first those that have not ended, which must find
    /// room.
    fn restore(&mut self, scope: Scope, mut restored: Restored, handler: &mut dyn TaskHandler) {
        if let Some(last) = restored.last_id {
            self.engine.dispatcher.skip_to(last);
        }
        if let Some(ids) = handler.reserved_ids() {
            if let Some(last) = TaskId::new(ids.given()) {
                self.engine.dispatcher.continue_after(last);
            }
            self.engine.dispatcher.memory_mut().set_ids(ids);
        }
        restored.tasks.sort_by_key(|task| task.ended);
        let now = now();
        for task in restored.tasks {
            let id = task.id;
            let mut known = Task::<_, HeapText>::new(scope);
            known.state = task.state;
            known.text.set(&task.text);
            let ago = task.ended.unwrap_or_default();
            let ago = u64::try_from(ago.as_micros()).unwrap_or(u64::MAX);
            let at = Instant::from_micros(now.as_micros().saturating_sub(ago));
            known.ended = task.ended.map_or(Instant::NEVER, |_| at);
            if self.engine.dispatcher.restore(id, known) {
                let memory = self.engine.dispatcher.memory_mut();
                memory.note_payload(id, &task.payload, at);
                if task.by_device {
                    memory.note_by_device(id);
                }
            }
            if task.ended.is_none() {
                handler.resume(TaskReporter::new(id, self.engine.mailbox.clone(), None));
            }
        }
    }

    /// Shows each STATUS and ABORT of a known task to `observer` before it is answered, with the request's
    /// payload. Called on the server's thread, so it must be quick.
    pub fn observe_requests(
        &mut self,
        observer: impl FnMut(Request, TaskId, &str) + Send + 'static,
    ) {
        self.engine.observer = Some(Box::new(observer));
    }

    /// A handle that controls the server from other threads.
    #[must_use]
    pub fn handle(&self) -> ServerHandle {
        ServerHandle {
            access: self.engine.router.access().clone(),
            limits: Arc::clone(&self.engine.next_limits),
            waker: Arc::clone(&self.engine.waker),
        }
    }

    /// Serves until it is stopped.
    ///
    /// # Errors
    /// The system's error if it can no longer wait for messages. No request can cause it.
    pub fn listen(self) -> std::io::Result<()> {
        self.engine.run()
    }

    /// Serves on a thread of its own, until the returned server is dropped.
    ///
    /// # Errors
    /// The system's error if it has no more threads.
    pub fn spawn(self) -> std::io::Result<RunningServer> {
        let endpoint = self.endpoint.clone();
        let handle = self.handle();
        let thread = std::thread::Builder::new()
            .name("ztl-server".to_owned())
            .spawn(move || {
                if let Err(cause) = self.listen() {
                    warn!(target: TASKS, "the server has ended: {cause}");
                }
            })?;
        Ok(RunningServer {
            endpoint,
            handle,
            thread: Some(thread),
        })
    }
}
