//! The client's state, without I/O: bytes, events of connections and the time go in; bytes and events come out.
//!
//! It keeps a connection to a robot's service directory, and connects to the processes of the services that are
//! used. After each input, take what has come of it: [`poll_action`](Session::poll_action),
//! [`poll_event`](Session::poll_event) and [`output`](Session::output) of the [`links`](Session::links), and wait until
//! [`poll_timeout`](Session::poll_timeout) at most.

mod calls;
mod directory;
mod functions;
mod links;
mod pending;
mod services;
mod signals;

use std::collections::VecDeque;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::arguments::ArgumentError;
use crate::connection::Credentials;
use crate::endpoint::Endpoint;
use crate::limits::Limits;
use crate::meta_object::MetaObject;
use crate::table::Table;
use crate::value::Value;

use calls::PendingCall;
use directory::Directory;
use links::Link;
use services::Service;
use signals::{QueuedSignal, Subscription};

/// The robot to connect to, and how.
#[derive(Debug, Clone)]
pub struct Options {
    /// Where its service directory listens.
    pub directory: Endpoint,
    /// Who this client is, if the robot asks for it.
    pub credentials: Option<Credentials>,
    /// Bounds on the memory and work that its processes can cause.
    pub limits: Limits,
}

/// A call of [`Session::call`] or [`Session::describe`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct CallId(u64);

/// A subscription of [`Session::subscribe`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct SubscriptionId(u64);

/// A connection that the session has asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct LinkId(u64);

/// What to call.
#[derive(Debug, Clone, PartialEq)]
pub struct Call {
    /// The service, as `ALTextToSpeech`.
    pub service: String,
    /// The method, as `say`, or one of its overloads, as `say::(s)`.
    pub method: String,
    /// The arguments.
    pub arguments: Vec<Value>,
}

impl Call {
    /// A call of a method.
    #[must_use]
    pub fn new(service: &str, method: &str, arguments: Vec<Value>) -> Self {
        Self {
            service: service.to_owned(),
            method: method.to_owned(),
            arguments,
        }
    }

    /// Asks for the value of a property.
    #[must_use]
    pub fn property(service: &str, name: &str) -> Self {
        Self::new(service, "property", vec![Value::Text(name.to_owned())])
    }

    /// Sets a property.
    #[must_use]
    pub fn set_property(service: &str, name: &str, value: Value) -> Self {
        let arguments = vec![Value::Text(name.to_owned()), value];
        Self::new(service, "setProperty", arguments)
    }
}

/// What to subscribe to.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalOf {
    /// The service, as `ALMemory`.
    pub service: String,
    /// The method that returns the object with the signal, and its arguments; nothing if the service has it itself.
    pub object: Option<(String, Vec<Value>)>,
    /// The signal.
    pub signal: String,
}

impl SignalOf {
    /// A signal, or the changes of a property, of a service.
    #[must_use]
    pub fn service(service: &str, signal: &str) -> Self {
        Self {
            service: service.to_owned(),
            object: None,
            signal: signal.to_owned(),
        }
    }

    /// An event of the robot's memory, as `FrontTactilTouched`.
    #[must_use]
    pub fn memory(key: &str) -> Self {
        Self {
            service: "ALMemory".to_owned(),
            object: Some(("subscriber".to_owned(), vec![Value::Text(key.to_owned())])),
            signal: "signal".to_owned(),
        }
    }
}

/// What has happened.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Event {
    /// The service directory answers.
    Connected,
    /// The service directory does not answer. The session tries again.
    Disconnected {
        /// Why.
        reason: String,
    },
    /// The robot has chosen another token for the user, to be used from now on.
    NewToken(String),
    /// A service has been registered.
    ServiceAdded(String),
    /// A service is gone.
    ServiceRemoved(String),
    /// A call has ended.
    Ended {
        /// Which.
        call: CallId,
        /// What it has returned.
        result: Result<Value, CallError>,
    },
    /// The description of a service.
    Described {
        /// What [`Session::describe`] has returned.
        call: CallId,
        /// Its methods, signals and properties.
        result: Result<Arc<MetaObject>, CallError>,
    },
    /// Signals will arrive from now on.
    Subscribed(SubscriptionId),
    /// Signals do not arrive. The session subscribes again when the service comes back.
    Unsubscribed {
        /// Which.
        subscription: SubscriptionId,
        /// Why.
        reason: String,
    },
    /// A signal.
    Signal {
        /// The subscription.
        subscription: SubscriptionId,
        /// Its values, or why they cannot be read.
        values: Result<Value, String>,
        /// How many signals before it were dropped, since they were not polled in time.
        dropped: u64,
    },
}

/// Why a call has no result.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallError {
    /// It was not sent, so that nothing has happened.
    NotSent(String),
    /// It was not sent: the method does not take these arguments.
    Arguments(ArgumentError),
    /// The method has failed with this text.
    Failed(String),
    /// It was cancelled.
    Canceled,
    /// It was sent, and no answer will come: the outcome is unknown.
    Unknown(String),
    /// The method has returned, and its result cannot be read.
    Unreadable(String),
}

impl fmt::Display for CallError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotSent(reason) | Self::Failed(reason) => f.write_str(reason),
            Self::Arguments(error) => error.fmt(f),
            Self::Canceled => f.write_str("cancelled"),
            Self::Unknown(reason) => write!(f, "unknown: {reason}"),
            Self::Unreadable(reason) => write!(f, "done, but the result is unreadable: {reason}"),
        }
    }
}

impl CallError {
    /// Whether nothing was sent, so that nothing has happened.
    #[must_use]
    pub const fn nothing_was_sent(&self) -> bool {
        matches!(self, Self::NotSent(_) | Self::Arguments(_))
    }
}

impl std::error::Error for CallError {}

/// What to do with connections.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Action {
    /// Connect, then call [`Session::handle_connected`] or [`Session::handle_closed`].
    Connect(LinkId, Endpoint),
    /// Close it. The session takes nothing more from it.
    Close(LinkId),
}

/// The answer to a request to cancel a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cancel {
    /// The call has ended, or will: it was not sent yet, or had ended before.
    Ended,
    /// The service was asked; it may ignore that.
    Asked,
    /// The robot cannot cancel calls.
    Impossible,
}

/// A client of one robot.
#[derive(Debug)]
pub struct Session {
    options: Options,
    directory: Directory,
    links: Table<LinkId, Link>,
    services: Table<String, Service>,
    /// The services that the directory lists, with their numbers.
    known: Table<String, u32>,
    calls: Table<CallId, PendingCall>,
    subscriptions: Table<SubscriptionId, Subscription>,
    actions: VecDeque<Action>,
    events: VecDeque<Event>,
    signals: VecDeque<QueuedSignal>,
    signal_bytes: usize,
    last_id: u64,
}

impl Session {
    /// A session that begins to connect.
    #[must_use]
    pub fn new(options: Options, now: Instant) -> Self {
        let mut session = Self {
            directory: Directory::new(options.directory.clone(), now),
            options,
            links: Table::default(),
            services: Table::default(),
            known: Table::default(),
            calls: Table::default(),
            subscriptions: Table::default(),
            actions: VecDeque::new(),
            events: VecDeque::new(),
            signals: VecDeque::new(),
            signal_bytes: 0,
            last_id: 0,
        };
        session.handle_timeout(now);
        session
    }

    /// The services that the directory lists; none before [`Event::Connected`].
    pub fn services(&self) -> impl Iterator<Item = &str> {
        self.known.keys().map(String::as_str)
    }

    /// Calls a method. If that is not possible within `wait`, the call ends as [`CallError::NotSent`].
    ///
    /// # Errors
    /// [`CallError::NotSent`] if too many calls are under way.
    pub fn call(&mut self, call: Call, wait: Duration, now: Instant) -> Result<CallId, CallError> {
        self.begin(call.service, Some((call.method, call.arguments)), wait, now)
    }

    /// Asks for the description of a service.
    ///
    /// # Errors
    /// As [`call`](Self::call).
    pub fn describe(
        &mut self,
        service: &str,
        wait: Duration,
        now: Instant,
    ) -> Result<CallId, CallError> {
        self.begin(service.to_owned(), None, wait, now)
    }

    /// Subscribes to a signal until [`unsubscribe`](Self::unsubscribe), also when its service comes back.
    pub fn subscribe(&mut self, signal: SignalOf) -> SubscriptionId {
        let id = SubscriptionId(self.new_id());
        let service = signal.service.clone();
        self.subscriptions.insert(id, Subscription::new(signal));
        self.want(&service);
        id
    }

    /// What has happened next.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front().or_else(|| self.next_signal())
    }

    /// What to do next.
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// The open connections.
    pub fn links(&self) -> impl Iterator<Item = LinkId> {
        self.links.keys().copied()
    }

    /// The bytes to send on a connection. Remove what was sent.
    pub fn output(&mut self, link: LinkId) -> Option<&mut Vec<u8>> {
        Some(self.links.get_mut(&link)?.connection.as_mut()?.output())
    }

    fn new_id(&mut self) -> u64 {
        self.last_id += 1;
        self.last_id
    }
}

#[cfg(test)]
mod tests;
