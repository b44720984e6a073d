//! The thread of a node: what happens on its connections, and what its owner asks for.

pub(super) mod actions;
pub(super) mod publications;
pub(super) mod registrar;
pub(super) mod rpc;
pub(super) mod service;
pub(super) mod topics;

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::mem;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use super::net::{ConnectionId, Listener, Net, NetEvent, PIECE, Read, Wake};
use super::net_error::NetError;
use crate::http;
use crate::tcpros::Frames;
use actions::{Action, Clock};
use publications::Publication;
use registrar::Registrar;
use rpc::Then;
use service::ServiceCall;
use topics::{Source, Subscription};

/// What the owner has the thread do.
pub(crate) type Job = Box<dyn FnOnce(&mut Engine, Instant) + Send>;

/// Jobs that are done before connections get their next turn.
const JOBS: usize = 256;

/// How long a connection may say nothing: a subscriber before its header, and a caller between its calls.
pub(crate) const IDLE: Duration = Duration::from_secs(30);

/// The longest call of another node, in bytes.
const LONGEST_CALL: usize = 256 * 1024;

/// What a connection is for.
pub(crate) enum Role {
    /// A node, or the master, that calls this node's API.
    ApiCaller(http::Reader),
    /// A call of this node.
    Rpc(http::Reader, Then),
    /// It has not sent its header yet.
    NewSubscriber(Frames),
    /// Receives what this node publishes under this topic.
    Subscriber(Arc<str>),
    /// A publisher that this node receives from.
    Source(Source),
    Service(Box<ServiceCall>),
}

/// The state of a node.
pub(crate) struct Engine {
    pub(crate) name: Arc<str>,
    pub(crate) master: String,
    /// The name or address under which others reach this node.
    pub(crate) host: String,
    pub(crate) api_uri: String,
    pub(crate) tcpros_port: u16,
    pub(crate) net: Net,
    pub(crate) roles: HashMap<ConnectionId, Role>,
    pub(crate) registrar: Registrar,
    pub(crate) publications: BTreeMap<Arc<str>, Publication>,
    pub(crate) subscriptions: BTreeMap<Arc<str>, Subscription>,
    pub(crate) actions: BTreeMap<Arc<str>, Action>,
    pub(crate) clock: Clock,
    /// Actions whose connections have changed.
    pub(crate) relinked: Vec<Arc<str>>,
    pub(crate) next_id: u32,
    pub(crate) stopping: Option<Instant>,
    /// The log has said that a request to stop was ignored.
    pub(crate) is_shutdown_told: bool,
    jobs: Receiver<Job>,
    /// The way to this thread, for threads that look up names.
    pub(crate) mailbox: super::Mailbox,
    wake: Arc<Wake>,
    piece: Vec<u8>,
}

/// What is known of a new node.
pub(crate) struct Identity {
    pub(crate) name: Arc<str>,
    pub(crate) master: String,
    pub(crate) host: String,
}

impl Engine {
    pub(crate) fn new(
        identity: Identity,
        net: Net,
        jobs: Receiver<Job>,
        mailbox: super::Mailbox,
    ) -> io::Result<Self> {
        let Identity { name, master, host } = identity;
        let [api_port, tcpros_port] = net.ports()?;
        Ok(Self {
            api_uri: format!("http://{host}:{api_port}/"),
            name,
            master,
            host,
            tcpros_port,
            net,
            roles: HashMap::new(),
            registrar: Registrar::default(),
            publications: BTreeMap::new(),
            subscriptions: BTreeMap::new(),
            actions: BTreeMap::new(),
            clock: Clock::default(),
            relinked: Vec::new(),
            next_id: 0,
            stopping: None,
            is_shutdown_told: false,
            jobs,
            wake: mailbox.wake(),
            mailbox,
            piece: vec![0; PIECE],
        })
    }

    /// Runs until the node is stopped.
    pub(crate) fn run(mut self) {
        while !self.has_stopped(Instant::now()) {
            if let Err(error) = self.turn() {
                tracing::error!("the ROS node has stopped: {error}");
                break;
            }
        }
        self.net.close_all();
    }

    fn turn(&mut self) -> io::Result<()> {
        self.net.poll()?;
        let now = Instant::now();
        self.handle_events(now);
        if self.net.is_due(now) {
            self.net.handle_timeout(now);
            self.handle_events(now);
            self.retry_sources(now);
            self.time_actions(now);
            self.replace_silent(now);
        }
        // Then its owner asks, and learns of connections that have failed.
        self.do_jobs(now);
        if let Some(limit) = self.stopping {
            self.net.wake_by(limit);
        }
        self.turn_registrar(now);
        self.relink(now);
        self.look_up();
        Ok(())
    }

    fn handle_events(&mut self, now: Instant) {
        while let Some(event) = self.net.next_event() {
            self.on_event(now, event);
        }
    }

    fn do_jobs(&mut self, now: Instant) {
        for _ in 0..JOBS {
            match self.jobs.try_recv() {
                Ok(job) => job(self, now),
                Err(_) => return,
            }
        }
        self.wake.wake();
    }

    /// A number that no other thing of this node has.
    pub(crate) fn new_id(&mut self) -> u32 {
        self.next_id = self.next_id.wrapping_add(1);
        self.next_id
    }

    fn on_event(&mut self, now: Instant, event: NetEvent) {
        match event {
            NetEvent::Accepted(listener, id) => {
                let role = match listener {
                    Listener::Api => Role::ApiCaller(http::Reader::new(LONGEST_CALL)),
                    Listener::Tcpros => Role::NewSubscriber(Frames::default()),
                };
                self.roles.insert(id, role);
                self.net.set_deadline(id, Some(now + IDLE));
            }
            NetEvent::Readable(id) => self.on_readable(now, id),
            NetEvent::Failed(id, error) => self.on_closed(now, id, error),
        }
    }

    fn on_readable(&mut self, now: Instant, id: ConnectionId) {
        let mut piece = mem::take(&mut self.piece);
        match self.net.read(id, &mut piece) {
            Read::Bytes(count) => {
                self.on_bytes(now, id, piece.get(..count).unwrap_or_default());
            }
            Read::Later => {}
            Read::Ended(error) => {
                self.net.close(id);
                self.on_closed(now, id, error);
            }
        }
        self.piece = piece;
    }

    fn on_bytes(&mut self, now: Instant, id: ConnectionId, bytes: &[u8]) {
        // Taken out meanwhile, so that what the bytes cause can use everything else.
        let Some(role) = self.roles.remove(&id) else {
            return;
        };
        let role = match role {
            Role::ApiCaller(reader) => self.on_api_bytes(now, id, reader, bytes),
            Role::Rpc(reader, then) => self.on_rpc_bytes(now, id, reader, then, bytes),
            Role::NewSubscriber(frames) => self.on_subscriber_bytes(now, id, frames, bytes),
            // A subscriber sends nothing after its header.
            Role::Subscriber(topic) => Some(Role::Subscriber(topic)),
            Role::Source(source) => self.on_source_bytes(now, id, source, bytes),
            Role::Service(call) => self.on_service_bytes(id, call, bytes),
        };
        if let Some(role) = role {
            self.roles.insert(id, role);
        }
    }

    /// The connection is closed.
    fn on_closed(&mut self, now: Instant, id: ConnectionId, error: NetError) {
        match self.roles.remove(&id) {
            Some(Role::Rpc(reader, then)) => self.on_rpc_closed(now, reader, then, error),
            Some(Role::Subscriber(topic)) => self.on_subscriber_closed(id, &topic, &error),
            Some(Role::Source(source)) => self.on_source_closed(now, &source, &error),
            Some(Role::Service(call)) => call.end(error),
            Some(Role::ApiCaller(_) | Role::NewSubscriber(_)) | None => {}
        }
    }

    /// Looks up host names, each on a thread of its own, since the system's lookup blocks.
    fn look_up(&mut self) {
        while let Some(host) = self.net.next_lookup() {
            let mailbox = self.mailbox.clone();
            let name = host.clone();
            let look_up = move || {
                let address = super::resolve(&name);
                mailbox.send(move |engine, now| engine.net.handle_host(now, &name, address));
            };
            let thread = std::thread::Builder::new().name("ztl-lookup".to_owned());
            if thread.spawn(look_up).is_err() {
                self.net.handle_host(Instant::now(), &host, None);
            }
        }
    }
}
