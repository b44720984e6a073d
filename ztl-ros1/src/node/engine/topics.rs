//! What the node subscribes to.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::publications::QUEUE;
use super::rpc::{CallError, read_offer};
use super::{Engine, Role};
use crate::WireType;
use crate::action::Part;
use crate::node::fit::{TypeConflict, conflict, fits};
use crate::node::net::ConnectionId;
use crate::node::net_error::NetError;
use crate::tcpros::{Frames, Header, LONGEST_HEADER};
use crate::xmlrpc::Value;

/// The longest message that is received, in bytes.
const LONGEST: usize = 64 * 1024 * 1024;

/// Publishers of a topic that are connected. Any node can name some to this one.
const MOST_PUBLISHERS: usize = 128;

/// How long a publisher may take to say where it publishes, and then to accept the connection.
const CONNECT: Duration = Duration::from_secs(5);

/// The pause before a publisher is tried again, at first and at most.
const SHORTEST: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// Called with the name of the publishing node and the encoded message.
pub(crate) type OnMessage = Box<dyn FnMut(&str, &[u8]) + Send>;

/// A topic that the node subscribes to.
pub(crate) struct Subscription {
    pub(crate) ty: WireType,
    pub(crate) registered: bool,
    consumers: Vec<(u32, Consumer)>,
    /// Publishers by the addresses of their APIs.
    publishers: BTreeMap<String, Publisher>,
    action: Option<Arc<str>>,
    /// The log has said that there are too many publishers.
    is_crowd_told: bool,
}

/// How often messages of a topic are expected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// All the time, such as joint states. A connection that brings none for 15 s is replaced.
    Steady,
    /// Now and then.
    Irregular,
}

/// Who gets the messages of a topic.
pub(crate) enum Consumer {
    Owner(OnMessage, Pace),
    Action(Arc<str>, Part),
    Clock,
}

/// A publisher of a topic, as the subscriber sees it.
struct Publisher {
    /// Whether the master names it. One that it does not name any more is used until its connection closes: a master
    /// that was restarted knows no publisher.
    listed: bool,
    state: State,
    pause: Duration,
    /// Why the last attempt failed.
    obstacle: Option<String>,
}

enum State {
    Waiting(Instant),
    Asking,
    Connecting(ConnectionId),
    Open(ConnectionId, Arc<str>),
}

/// The connection to a publisher.
pub(crate) struct Source {
    topic: Arc<str>,
    uri: String,
    frames: Frames,
    /// The name of the node, once its header has arrived.
    caller: Option<Arc<str>>,
    /// Whether the publisher keeps its last message for new subscribers.
    latching: bool,
    /// That message, for new consumers here.
    last: Option<Vec<u8>>,
    /// When the last message arrived, or the connection was made.
    pub(in crate::node) heard: Instant,
}

impl Subscription {
    pub(crate) fn connected_uris(&self) -> impl Iterator<Item = &str> {
        let open = self
            .publishers
            .iter()
            .filter(|(_, publisher)| publisher.caller().is_some());
        open.map(|(uri, _)| uri.as_str())
    }

    /// The nodes that are connected.
    pub(crate) fn callers(&self) -> Vec<Arc<str>> {
        self.publishers
            .values()
            .filter_map(|of| of.caller().cloned())
            .collect()
    }

    /// The connections over which messages come.
    pub(crate) fn open(&self) -> impl Iterator<Item = ConnectionId> + use<'_> {
        let all = self.publishers.values();
        all.filter_map(|of| match of.state {
            State::Open(id, _) => Some(id),
            _ => None,
        })
    }

    /// Whether messages come all the time.
    pub(crate) fn is_steady(&self) -> bool {
        self.is_status()
            || self.consumers.iter().any(|(_, consumer)| {
                matches!(consumer, Consumer::Owner(_, Pace::Steady) | Consumer::Clock)
            })
    }

    /// Whether it is the status of an action.
    pub(crate) fn is_status(&self) -> bool {
        let mut consumers = self.consumers.iter();
        consumers.any(|(_, consumer)| matches!(consumer, Consumer::Action(_, Part::Status)))
    }

    /// The address of the API of a node that is connected.
    pub(crate) fn uri_of(&self, node: &str) -> Option<&str> {
        let is_it = |of: &Publisher| of.caller().is_some_and(|caller| **caller == *node);
        let mut all = self.publishers.iter();
        all.find_map(|(uri, of)| is_it(of).then_some(uri.as_str()))
    }

    /// Whether a publisher was neither reached nor found unreachable yet.
    pub(crate) fn is_unsettled(&self) -> bool {
        self.publishers
            .values()
            .any(|of| of.caller().is_none() && of.obstacle.is_none())
    }

    pub(crate) fn has_publishers(&self) -> bool {
        !self.publishers.is_empty()
    }

    /// Why publishers cannot be received from.
    pub(crate) fn obstacles(&self) -> impl Iterator<Item = &str> {
        self.publishers
            .values()
            .filter_map(|of| of.obstacle.as_deref())
    }
}

/// Why a publisher is not received from.
#[derive(Debug, Clone, Copy)]
enum Cause {
    /// A person must mend it, such as a type that differs.
    Lasting,
    /// Such as a node that has ended.
    Passing,
}

impl Cause {
    const fn of(error: &NetError) -> Self {
        match error {
            NetError::UnknownHost { .. } => Self::Lasting,
            _ => Self::Passing,
        }
    }
}

impl Publisher {
    fn caller(&self) -> Option<&Arc<str>> {
        match &self.state {
            State::Open(_, caller) => Some(caller),
            _ => None,
        }
    }
}

impl Engine {
    /// Subscribes to a topic, for one more consumer.
    pub(crate) fn subscribe(
        &mut self,
        topic: &Arc<str>,
        ty: WireType,
        id: u32,
        mut consumer: Consumer,
    ) -> Result<(), TypeConflict> {
        let action = match &consumer {
            Consumer::Action(action, _) => Some(Arc::clone(action)),
            _ => None,
        };
        if let Some(subscription) = self.subscriptions.get_mut(topic) {
            conflict(topic, &subscription.ty, &ty)?;
            for publisher in subscription.publishers.values() {
                if let State::Open(id, caller) = &publisher.state
                    && let Some(Role::Source(source)) = self.roles.get(id)
                    && let (Some(last), Consumer::Owner(on_message, _)) =
                        (&source.last, &mut consumer)
                {
                    on_message(caller, last);
                }
            }
            subscription.consumers.push((id, consumer));
            subscription.action = subscription.action.take().or(action);
            return Ok(());
        }
        let subscription = Subscription {
            ty,
            registered: false,
            consumers: vec![(id, consumer)],
            publishers: BTreeMap::new(),
            action,
            is_crowd_told: false,
        };
        self.subscriptions.insert(Arc::clone(topic), subscription);
        Ok(())
    }

    /// One consumer releases the topic.
    pub(crate) fn unsubscribe(&mut self, topic: &str, id: u32) {
        let Some(subscription) = self.subscriptions.get_mut(topic) else {
            return;
        };
        subscription
            .consumers
            .retain(|(consumer, _)| *consumer != id);
        if !subscription.consumers.is_empty() {
            return;
        }
        let publishers = std::mem::take(&mut subscription.publishers);
        self.subscriptions.remove(topic);
        for publisher in publishers.into_values() {
            if let State::Connecting(id) | State::Open(id, _) = publisher.state {
                self.roles.remove(&id);
                self.net.close(id);
            }
        }
        self.unregister("unregisterSubscriber", topic);
    }

    /// The master names the publishers of a topic.
    pub(crate) fn on_publishers(&mut self, now: Instant, topic: &str, uris: &[String]) {
        let Some(subscription) = self.subscriptions.get_mut(topic) else {
            return;
        };
        for publisher in subscription.publishers.values_mut() {
            publisher.listed = false;
        }
        for uri in uris {
            if let Some(publisher) = subscription.publishers.get_mut(uri) {
                publisher.listed = true;
            }
        }
        let connected = |publisher: &Publisher| publisher.caller().is_some();
        subscription
            .publishers
            .retain(|_, of| of.listed || connected(of));
        for uri in uris {
            let is_full = subscription.publishers.len() >= MOST_PUBLISHERS;
            if !is_full && !subscription.publishers.contains_key(uri) {
                let publisher = Publisher {
                    listed: true,
                    state: State::Waiting(now),
                    pause: SHORTEST,
                    obstacle: None,
                };
                subscription.publishers.insert(uri.clone(), publisher);
            }
        }
        let is_crowd = uris.len() > MOST_PUBLISHERS;
        if is_crowd && !std::mem::replace(&mut subscription.is_crowd_told, true) {
            tracing::warn!(
                "{topic} has more than {MOST_PUBLISHERS} publishers: messages of the others are not received"
            );
        }
        self.relinked.extend(subscription.action.clone());
        self.retry_sources(now);
    }

    /// Asks publishers for connections, each after its pause.
    pub(crate) fn retry_sources(&mut self, now: Instant) {
        let mut due = Vec::new();
        for (topic, subscription) in &mut self.subscriptions {
            for (uri, publisher) in &mut subscription.publishers {
                match publisher.state {
                    State::Waiting(at) if at <= now => {
                        publisher.state = State::Asking;
                        due.push((Arc::clone(topic), uri.clone()));
                    }
                    State::Waiting(at) => self.net.wake_by(at),
                    _ => {}
                }
            }
        }
        for (topic, uri) in due {
            let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
            let params = [self.name[..].into(), topic[..].into(), protocols];
            let address = uri.clone();
            let then = move |engine: &mut Self, now: Instant, answer| {
                engine.on_topic_offer(now, &topic, &uri, answer);
            };
            self.rpc(
                now,
                &address,
                "requestTopic",
                &params,
                CONNECT,
                Box::new(then),
            );
        }
    }

    /// A publisher has said where to connect.
    fn on_topic_offer(
        &mut self,
        now: Instant,
        topic: &Arc<str>,
        uri: &str,
        answer: Result<Value, CallError>,
    ) {
        let Some(subscription) = self.subscriptions.get_mut(topic) else {
            return;
        };
        let publisher = subscription.publishers.get_mut(uri);
        let Some(publisher) = publisher.filter(|of| matches!(of.state, State::Asking)) else {
            return;
        };
        let cause = |error: &CallError| match error {
            CallError::Net(error) => Cause::of(error),
            _ => Cause::Passing,
        };
        let offer = answer.map_err(|error| (error.to_string(), cause(&error)));
        let offer = offer.and_then(|value| {
            let malformed = || format!("{uri} offers no TCPROS for {topic}");
            read_offer(&value).ok_or_else(|| (malformed(), Cause::Lasting))
        });
        match offer {
            Ok(address) => {
                let ty = &subscription.ty;
                let header = Header::new([
                    ("callerid", &self.name[..]),
                    ("topic", topic),
                    ("type", &ty.name),
                    ("md5sum", &ty.md5),
                    ("message_definition", &ty.definition),
                    ("tcp_nodelay", "1"),
                ]);
                let id = self.net.open(now, address, now + CONNECT);
                publisher.state = State::Connecting(id);
                self.net.send(id, Arc::from(header.encode()), QUEUE);
                let source = Source {
                    topic: Arc::clone(topic),
                    uri: uri.to_owned(),
                    frames: Frames::default(),
                    caller: None,
                    latching: false,
                    last: None,
                    heard: now,
                };
                self.roles.insert(id, Role::Source(source));
            }
            Err((error, cause)) => self.on_no_source(now, topic, uri, error, cause),
        }
    }

    pub(crate) fn on_source_bytes(
        &mut self,
        now: Instant,
        id: ConnectionId,
        mut source: Source,
        bytes: &[u8],
    ) -> Option<Role> {
        source.frames.handle_bytes(bytes);
        loop {
            let most = match source.caller {
                Some(_) => LONGEST,
                None => LONGEST_HEADER,
            };
            let error = match (source.frames.poll_frame(most), &source.caller) {
                (Ok(None), _) => return Some(Role::Source(source)),
                (Ok(Some(content)), Some(caller)) => {
                    source.heard = now;
                    self.deliver(now, &source.topic, caller, content);
                    source.last = source.latching.then(|| content.to_vec());
                    continue;
                }
                (Ok(Some(content)), None) => {
                    let header = Header::parse(content).map_err(|error| error.to_string());
                    let accepted = header.and_then(|header| {
                        let caller = self.on_source_header(id, &source, &header)?;
                        Ok((caller, header.get("latching") == "1"))
                    });
                    match accepted {
                        Ok((caller, latching)) => {
                            source.caller = Some(caller);
                            source.latching = latching;
                            source.heard = now;
                            continue;
                        }
                        Err(error) => error,
                    }
                }
                (Err(error), _) => error.to_string(),
            };
            self.net.close(id);
            self.on_no_source(now, &source.topic, &source.uri, error, Cause::Lasting);
            return None;
        }
    }

    /// A publisher has accepted or refused the connection. Returns the name of its node.
    fn on_source_header(
        &mut self,
        id: ConnectionId,
        source: &Source,
        header: &Header,
    ) -> Result<Arc<str>, String> {
        let caller = header.get("callerid");
        let caller = if caller.is_empty() {
            &source.uri
        } else {
            caller
        };
        match header.get("error") {
            "" => {}
            error => return Err(format!("{caller} refuses {}: {error}", source.topic)),
        }
        let subscription = self.subscriptions.get_mut(&source.topic);
        let subscription = subscription.ok_or_else(|| "not subscribed any more".to_owned())?;
        let (ours, theirs) = (&subscription.ty, header.get("md5sum"));
        if !fits(&ours.md5, theirs) {
            return Err(format!(
                "{caller} publishes {} as {} with MD5 sum {theirs}, and not as {} with {}: \
                 the definitions differ",
                source.topic,
                header.get("type"),
                ours.name,
                ours.md5
            ));
        }
        let publisher = subscription.publishers.get_mut(&source.uri);
        let publisher = publisher.ok_or_else(|| "not named any more".to_owned())?;
        let caller: Arc<str> = Arc::from(caller);
        publisher.state = State::Open(id, Arc::clone(&caller));
        publisher.pause = SHORTEST;
        publisher.obstacle = None;
        self.net.set_deadline(id, None);
        self.relinked.extend(subscription.action.clone());
        Ok(caller)
    }

    pub(crate) fn on_source_closed(&mut self, now: Instant, source: &Source, error: &NetError) {
        let cause = Cause::of(error);
        self.on_no_source(now, &source.topic, &source.uri, error.to_string(), cause);
    }

    /// This node has closed the connection, and connects again.
    pub(crate) fn on_source_lost(&mut self, now: Instant, source: &Source, reason: String) {
        self.on_no_source(now, &source.topic, &source.uri, reason, Cause::Passing);
    }

    /// There is no connection to this publisher.
    fn on_no_source(&mut self, now: Instant, topic: &str, uri: &str, error: String, cause: Cause) {
        let Some(subscription) = self.subscriptions.get_mut(topic) else {
            return;
        };
        self.relinked.extend(subscription.action.clone());
        let Some(publisher) = subscription.publishers.get_mut(uri) else {
            return;
        };
        if publisher.obstacle.as_ref() != Some(&error) {
            // One that only has ended is not worth a warning.
            match cause {
                Cause::Lasting => tracing::warn!("{topic} is not received from {uri}: {error}"),
                Cause::Passing => tracing::debug!("{topic} is not received from {uri}: {error}"),
            }
        }
        let again = now + publisher.pause;
        publisher.pause = (publisher.pause * 2).min(LONGEST_PAUSE);
        publisher.state = State::Waiting(again);
        publisher.obstacle = Some(error);
        self.net.wake_by(again);
        if !publisher.listed {
            subscription.publishers.remove(uri);
        }
    }

    fn deliver(&mut self, now: Instant, topic: &str, caller: &str, content: &[u8]) {
        let Some(subscription) = self.subscriptions.get_mut(topic) else {
            return;
        };
        // Taken out meanwhile, so that a consumer can use everything else.
        let mut consumers = std::mem::take(&mut subscription.consumers);
        for (_, consumer) in &mut consumers {
            match consumer {
                Consumer::Owner(on_message, _) => on_message(caller, content),
                Consumer::Action(action, part) => {
                    self.on_action_message(now, action, *part, caller, content);
                }
                Consumer::Clock => self.on_clock(now, content),
            }
        }
        if let Some(subscription) = self.subscriptions.get_mut(topic) {
            subscription.consumers = consumers;
        }
    }
}
