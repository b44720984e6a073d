//! A node: its thread, and the handles of its owner.

mod after_cut;
mod api;
mod connection;
mod engine;
mod explain;
mod fit;
mod hosts;
mod net;
mod net_error;
mod outbox;
mod owners;
mod sockets;
mod unacknowledged;

use std::net::Ipv4Addr;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use std::{fmt, io};

use crate::action::GoalEvent;
use crate::action::machine::GoalKey;
use crate::uri::Address;
use crate::xmlrpc::Value;
use crate::{ActionTypes, WireType};
use engine::publications::Manner;
pub use engine::publications::{Audience, Listener, Loss};
pub use engine::rpc::CallError;
pub(crate) use engine::rpc::read_offer;
pub use engine::service::ServiceError;
use engine::topics::Consumer;
pub use engine::topics::Pace;
use engine::{Engine, Identity};
pub use fit::TypeConflict;
pub(crate) use hosts::resolve;
use hosts::{host_towards, own_host, resolve_literal, variable};
use net::{Net, Wake};
pub use net_error::NetError;

/// How long the master or a node may take to answer a question of the owner.
const ANSWER: Duration = Duration::from_secs(5);

/// Where the master is, and who this node is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Config {
    /// Such as `http://localhost:11311`.
    pub master: String,
    /// The name or address under which other nodes reach this machine. Without it: `ROS_HOSTNAME`, `ROS_IP`, or the
    /// address of this machine in the network of the master.
    pub host: Option<String>,
    /// The beginning of the node's name, such as `ztl`. The process id and a random number follow, so that two nodes
    /// never have the same name.
    pub name: String,
}

impl Config {
    /// The master of `ROS_MASTER_URI`, or that of this machine.
    #[must_use]
    pub fn from_environment(name: &str) -> Self {
        let master = variable("ROS_MASTER_URI");
        Self {
            master: master.unwrap_or_else(|| "http://localhost:11311".to_owned()),
            host: None,
            name: name.to_owned(),
        }
    }
}

/// A node of ROS 1. It works also before there is a master and after the master was restarted: it registers what it
/// publishes and subscribes to as soon as it can.
///
/// Callbacks run on the node's thread. They must not block, and must call nothing here that waits. A clone is the same
/// node; when the last one is dropped, the node stops.
#[derive(Clone)]
pub struct Node {
    mailbox: Mailbox,
    inner: Arc<Inner>,
}

struct Inner {
    name: Arc<str>,
    mailbox: Mailbox,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// The way to the node's thread.
#[derive(Clone)]
struct Mailbox {
    jobs: Sender<engine::Job>,
    wake: Arc<Wake>,
}

impl Mailbox {
    fn send(&self, job: impl FnOnce(&mut Engine, Instant) + Send + 'static) {
        if self.jobs.send(Box::new(job)).is_ok() {
            self.wake.wake();
        }
    }

    fn wake(&self) -> Arc<Wake> {
        Arc::clone(&self.wake)
    }
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Node").field(&self.inner.name).finish()
    }
}

/// Why a node cannot be started.
#[derive(Debug)]
#[non_exhaustive]
pub enum StartError {
    /// This is not the address of a master.
    Master {
        /// What it is.
        uri: String,
    },
    /// This machine cannot resolve the name of the master's host.
    UnknownHost {
        /// The name.
        host: String,
    },
    /// The system provides no socket or thread.
    System(io::Error),
}

impl fmt::Display for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Master { uri } => write!(
                f,
                "invalid ROS master '{uri}': expected http://HOST:PORT, such as http://localhost:11311"
            ),
            Self::UnknownHost { host } => {
                write!(
                    f,
                    "this machine cannot resolve '{host}', the host of the ROS master"
                )
            }
            Self::System(error) => write!(f, "cannot start a ROS node: {error}"),
        }
    }
}

impl std::error::Error for StartError {}

impl From<io::Error> for StartError {
    fn from(error: io::Error) -> Self {
        Self::System(error)
    }
}

impl Node {
    /// Starts a node. Does not wait for the master.
    ///
    /// # Errors
    /// If the address of the master is malformed or its host unknown, or if the system provides no socket or thread.
    pub fn start(config: &Config) -> Result<Self, StartError> {
        let master = config.master.clone();
        let Some(address) = Address::parse(&master, "http") else {
            return Err(StartError::Master { uri: master });
        };
        let host = match config.host.clone().or_else(own_host) {
            Some(host) => host,
            None => host_towards(&address)?.ok_or_else(|| StartError::UnknownHost {
                host: address.host.clone(),
            })?,
        };
        // A host that is this machine alone is served to this machine alone.
        let local = resolve_literal(&host).is_some_and(|address| address.is_loopback());
        let bind = if local {
            Ipv4Addr::LOCALHOST
        } else {
            Ipv4Addr::UNSPECIFIED
        };
        let (net, wake) = Net::bind(bind)?;
        let (jobs, received) = channel();
        let wake = Arc::new(wake);
        let mailbox = Mailbox { jobs, wake };
        let random = getrandom::u32().unwrap_or_else(|_| Instant::now().elapsed().subsec_nanos());
        let name = config.name.trim_matches('/');
        let name = format!("/{name}_{}_{random:08x}", std::process::id());
        let name: Arc<str> = Arc::from(name);
        let identity = Identity {
            name: Arc::clone(&name),
            master,
            host,
        };
        let engine = Engine::new(identity, net, received, mailbox.clone())?;
        let thread = std::thread::Builder::new().name("ztl-ros1".to_owned());
        let thread = thread.spawn(move || engine.run())?;
        let inner = Inner {
            name,
            mailbox: mailbox.clone(),
            thread: Mutex::new(Some(thread)),
        };
        Ok(Self {
            mailbox,
            inner: Arc::new(inner),
        })
    }

    /// The name of the node.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    /// Unregisters from the master and ends the thread; waits up to two seconds. Not for callbacks.
    pub fn stop(&self) {
        self.mailbox.send(Engine::stop);
        let thread = self.inner.thread.lock();
        let thread = thread.unwrap_or_else(PoisonError::into_inner).take();
        if let Some(thread) = thread {
            let _ = thread.join();
        }
    }

    /// Publishes a topic. `latching`: a new subscriber gets the last message.
    ///
    /// # Errors
    /// If this node publishes the topic with another type.
    pub fn publisher(
        &self,
        topic: &str,
        ty: WireType,
        latching: bool,
    ) -> Result<Publisher, OpenError> {
        let manner = Manner {
            latching,
            ..Manner::default()
        };
        self.publish_as(topic, ty, manner)
    }

    /// Publishes a topic whose messages must not arrive late, such as velocities. A subscriber that does not acknowledge a
    /// message within `limit`, and a second for each MiB, is disconnected, and what waits for it is discarded.
    /// `newest`: a message replaces one that was not sent yet.
    ///
    /// # Errors
    /// If this node publishes the topic with another type.
    pub fn command_publisher(
        &self,
        topic: &str,
        ty: WireType,
        limit: Duration,
        newest: bool,
    ) -> Result<Publisher, OpenError> {
        let manner = Manner {
            latching: false,
            newest,
            limit: Some(limit),
        };
        self.publish_as(topic, ty, manner)
    }

    fn publish_as(
        &self,
        topic: &str,
        ty: WireType,
        manner: Manner,
    ) -> Result<Publisher, OpenError> {
        let topic = absolute(topic);
        let name = Arc::clone(&topic);
        self.wait(move |engine, _| engine.advertise(&name, ty, manner, None))??;
        Ok(Publisher {
            topic,
            mailbox: self.mailbox.clone(),
        })
    }

    /// Subscribes to a topic. The callback gets the name of the publishing node and the encoded message. A publisher
    /// that is faster than the callback is slowed down and loses messages.
    ///
    /// # Errors
    /// If this node subscribes to the topic with another type.
    pub fn subscribe(
        &self,
        topic: &str,
        ty: WireType,
        pace: Pace,
        on_message: impl FnMut(&str, &[u8]) + Send + 'static,
    ) -> Result<Subscription, OpenError> {
        let topic = absolute(topic);
        let name = Arc::clone(&topic);
        let id = self.wait(move |engine, _| {
            let id = engine.new_id();
            let consumer = Consumer::Owner(Box::new(on_message), pace);
            engine.subscribe(&name, ty, id, consumer).map(|()| id)
        })??;
        Ok(Subscription {
            topic,
            id,
            mailbox: self.mailbox.clone(),
        })
    }

    /// Calls a service; `ty` has the name and MD5 sum of its type. The callback gets the encoded response, and is called
    /// once within `limit`, a day at most, unless the node stops.
    pub fn call(
        &self,
        service: &str,
        ty: WireType,
        request: Vec<u8>,
        limit: Duration,
        then: impl FnOnce(Result<Vec<u8>, ServiceError>) + Send + 'static,
    ) {
        let service = absolute(service);
        self.mailbox.send(move |engine, now| {
            engine.call_service(now, &service, ty, request, limit, Box::new(then));
        });
    }

    /// Connects to an action and keeps the connection until the node stops. All calls for one action share it.
    ///
    /// # Errors
    /// If this node uses the action, or one of its topics, with another type.
    pub fn action(&self, name: &str, types: ActionTypes) -> Result<ActionClient, OpenError> {
        let action = absolute(name);
        let name = Arc::clone(&action);
        self.wait(move |engine, _| engine.add_action(&name, types))??;
        Ok(ActionClient {
            action,
            node: self.clone(),
        })
    }

    /// The value of a parameter, or of all below it as a struct.
    ///
    /// # Errors
    /// If the master does not answer, or the parameter is not set.
    pub fn param(&self, name: &str) -> Result<Value, CallError> {
        self.ask_master("getParam", &[absolute(name)[..].into()])
    }

    /// Calls a method of the master; `params` follow the name of the node. Waits up to five seconds.
    ///
    /// # Errors
    /// If the master does not answer, or refuses.
    pub fn ask_master(&self, method: &str, params: &[Value]) -> Result<Value, CallError> {
        self.ask_at(None, method, params)
    }

    /// As [`ask_master`](Self::ask_master), for the API of another node.
    ///
    /// # Errors
    /// If the node does not answer, or refuses.
    pub fn ask(&self, uri: &str, method: &str, params: &[Value]) -> Result<Value, CallError> {
        self.ask_at(Some(uri.to_owned()), method, params)
    }

    fn ask_at(
        &self,
        uri: Option<String>,
        method: &str,
        params: &[Value],
    ) -> Result<Value, CallError> {
        let answer = self.ask_soon(uri, method, params);
        answer.recv().unwrap_or(Err(CallError::Stopped))
    }

    /// Calls the master, or this node, without waiting.
    pub(crate) fn ask_soon(
        &self,
        uri: Option<String>,
        method: &str,
        params: &[Value],
    ) -> Receiver<Result<Value, CallError>> {
        let (method, params) = (method.to_owned(), params.to_vec());
        let (answered, answer) = channel();
        self.mailbox.send(move |engine, now| {
            let mut all = vec![engine.name[..].into()];
            all.extend(params);
            let uri = uri.unwrap_or_else(|| engine.master.clone());
            let then = move |_: &mut Engine, _: Instant, answer| drop(answered.send(answer));
            engine.rpc(now, &uri, &method, &all, ANSWER, Box::new(then));
        });
        answer
    }

    /// Has the thread do something, and waits for it.
    fn wait<T: Send + 'static>(
        &self,
        job: impl FnOnce(&mut Engine, Instant) -> T + Send + 'static,
    ) -> Result<T, OpenError> {
        let (done, result) = channel();
        self.mailbox
            .send(move |engine, now| drop(done.send(job(engine, now))));
        result.recv().map_err(|_| OpenError::Stopped)
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.mailbox.send(Engine::stop);
    }
}

/// Why a topic or action cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum OpenError {
    /// It is used with another type.
    Type(TypeConflict),
    /// The node was stopped.
    Stopped,
}

impl fmt::Display for OpenError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Type(conflict) => conflict.fmt(f),
            Self::Stopped => f.write_str("the ROS node has stopped"),
        }
    }
}

impl std::error::Error for OpenError {}

impl From<TypeConflict> for OpenError {
    fn from(conflict: TypeConflict) -> Self {
        Self::Type(conflict)
    }
}

/// Publishes a topic until it is dropped.
pub struct Publisher {
    topic: Arc<str>,
    mailbox: Mailbox,
}

impl Publisher {
    /// Sends an encoded message to all subscribers. Each has a queue of 64 messages; a slow one loses the oldest.
    pub fn publish(&self, content: Vec<u8>) {
        let topic = Arc::clone(&self.topic);
        self.mailbox
            .send(move |engine, _| engine.publish(&topic, &content));
    }

    /// Sends a message to these nodes, which were disconnected: at once if they are connected again, else first when they do.
    pub fn publish_when_back(&self, nodes: Vec<String>, content: Vec<u8>) {
        let topic = Arc::clone(&self.topic);
        self.mailbox
            .send(move |engine, _| engine.publish_when_back(&topic, nodes, &content));
    }

    /// A task relies on those that are connected: the topic is not registered again for ten seconds, which would disconnect
    /// them for a moment.
    pub fn keep_connections(&self) {
        let topic = Arc::clone(&self.topic);
        self.mailbox
            .send(move |engine, _| engine.keep_connections(&topic));
    }

    /// Who receives it.
    #[must_use]
    pub fn audience(&self) -> Audience {
        let topic = Arc::clone(&self.topic);
        let (done, result) = channel();
        self.mailbox.send(move |engine, _| {
            let _ = done.send(engine.audience(&topic));
        });
        result.recv().unwrap_or_default()
    }

    /// The names of the other nodes that receive it.
    #[must_use]
    pub fn subscribers(&self) -> Vec<String> {
        let nodes = self.audience().nodes.into_iter();
        nodes.map(|listener| listener.node).collect()
    }

    /// Finds out why no node receives it, or why `wanted` does not. The callback gets the reason within half a second, unless
    /// the node stops.
    pub fn explain(&self, wanted: Option<&str>, then: impl FnOnce(String) + Send + 'static) {
        let (topic, wanted) = (Arc::clone(&self.topic), wanted.map(str::to_owned));
        self.mailbox.send(move |engine, now| {
            engine.explain_audience(now, topic, wanted, Box::new(then));
        });
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Publisher").field(&self.topic).finish()
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        let topic = Arc::clone(&self.topic);
        self.mailbox
            .send(move |engine, now| engine.unadvertise(now, &topic));
    }
}

/// Receives a topic until it is dropped.
pub struct Subscription {
    topic: Arc<str>,
    id: u32,
    mailbox: Mailbox,
}

impl Subscription {
    /// Why nothing is received, if this node knows.
    #[must_use]
    pub fn obstacle(&self) -> Option<String> {
        let topic = Arc::clone(&self.topic);
        let (done, result) = channel();
        self.mailbox.send(move |engine, _| {
            let _ = done.send(engine.why_silent(&topic));
        });
        result.recv().unwrap_or_default()
    }
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Subscription").field(&self.topic).finish()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let (topic, id) = (Arc::clone(&self.topic), self.id);
        self.mailbox
            .send(move |engine, _| engine.unsubscribe(&topic, id));
    }
}

/// The client of an action.
#[derive(Debug, Clone)]
pub struct ActionClient {
    action: Arc<str>,
    node: Node,
}

impl ActionClient {
    /// Sends an encoded goal once the action server is connected, for which it waits 1.5 s. Every goal ends with
    /// [`GoalEvent::Ended`], unless the node stops.
    ///
    /// Dropping the returned goal does not cancel it.
    pub fn send_goal(
        &self,
        content: Vec<u8>,
        on_event: impl FnMut(GoalEvent) + Send + 'static,
    ) -> Goal {
        let key = Arc::new(Mutex::new(None));
        let (action, shared) = (Arc::clone(&self.action), Arc::clone(&key));
        self.node.mailbox.send(move |engine, now| {
            let key = GoalKey(engine.new_id());
            *shared.lock().unwrap_or_else(PoisonError::into_inner) = Some(key);
            engine.send_goal(now, &action, key, content, Box::new(on_event));
        });
        Goal {
            action: Arc::clone(&self.action),
            key,
            mailbox: self.node.mailbox.clone(),
        }
    }
}

/// A goal that was sent, or will be.
pub struct Goal {
    action: Arc<str>,
    key: Arc<Mutex<Option<GoalKey>>>,
    mailbox: Mailbox,
}

impl Goal {
    /// Asks the action server to cancel the goal, every second until the server's status shows the cancel. The goal still
    /// ends with [`GoalEvent::Ended`].
    pub fn cancel(&self) {
        let (action, key) = (Arc::clone(&self.action), Arc::clone(&self.key));
        self.mailbox.send(move |engine, now| {
            let key = *key.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(key) = key {
                engine.cancel_goal(now, &action, key);
            }
        });
    }
}

impl fmt::Debug for Goal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Goal").field(&self.action).finish()
    }
}

/// A name that begins with a slash.
fn absolute(name: &str) -> Arc<str> {
    Arc::from(format!("/{}", name.trim_start_matches('/')))
}
