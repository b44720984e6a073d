//! Subscribes to what is published.

use std::io;
use std::time::{Duration, Instant, SystemTime};

use serde_json::json;
use tracing::info;
use ztl_core::topic::is_below;
use ztl_pickle::{Kind, Pickle};
use ztl_zmtp::Sub;
use ztl_zmtp::curve;
use ztl_zmtp::session::{Obstacle, Security};

use crate::client::advice;
use crate::keys::{KeyPair, PublicKey};
use crate::log_targets::SUBSCRIBER;
use crate::native::Endpoint;
use crate::native::dialer::Dialer;
use crate::native::publisher::{AGAIN, MISSED, STATE};
use crate::random;

/// The longest message in bytes, unless it is chosen.
const LONGEST: usize = 64 << 20;
/// Longer limits would overflow.
const LONG: Duration = Duration::from_secs(1 << 32);

/// Hears what a publisher publishes under some scopes. Has no thread: it connects, and connects again, while it is waited
/// for.
///
/// A message that is not one of ZTL's is dropped and counted.
pub struct Subscriber {
    dialer: Dialer<Sub>,
    scopes: Vec<String>,
    missed: u64,
    /// What the publisher has said of it last, and on which connection.
    told: u64,
    connection: u64,
    damaged: u64,
    /// The connection on which the publisher has said that the next message is a state.
    next_is_state: Option<u64>,
    was_state: bool,
    /// Beginnings of topics that are subscribed to besides the scopes.
    begins: Vec<Vec<u8>>,
}

/// Options of a subscriber.
#[derive(Debug, Clone, Default)]
#[must_use]
pub struct SubscriberBuilder {
    scopes: Vec<String>,
    keys: Option<(KeyPair, PublicKey)>,
    longest: Option<usize>,
}

/// How long a value in JSON may be: so many times its pickle, and this many bytes more. Shared parts are repeated.
const JSON: (usize, usize) = (16, 64 * 1024);

/// A message of a publisher.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heard {
    /// The publisher's scope, directly followed by a path.
    pub topic: String,
    /// Usually a pickle.
    pub body: Vec<u8>,
    /// When it was received.
    pub at: SystemTime,
}

/// What a message contains.
#[derive(Debug, Clone)]
pub enum Content<'a> {
    /// A pickle.
    Value(Pickle),
    /// Not a pickle, as the readings of a gateway that publishes them raw.
    Text(&'a str),
    /// Neither a pickle nor text.
    Bytes(&'a [u8]),
    /// A pickle that could run code, or exceeds a limit.
    Refused(ztl_pickle::Error),
}

impl Heard {
    /// The value in the message. Nothing in it is executed.
    ///
    /// # Errors
    /// What is wrong with the pickle, or which object in it is refused.
    pub fn value(&self) -> Result<Pickle, ztl_pickle::Error> {
        Pickle::read(&self.body)
    }

    /// The message as an object in JSON: `topic`, `time` of receipt (RFC 3339, UTC), and `value`, or `error` if the value
    /// is refused or has no JSON of at most 16 times the message's length and 64 KiB. Bytes are base64.
    #[must_use]
    pub fn to_json(&self) -> String {
        let most = JSON
            .0
            .saturating_mul(self.body.len())
            .saturating_add(JSON.1);
        let read = |value: &Pickle| {
            value
                .value()
                .to_json(most)
                .map_err(|error| error.to_string())
        };
        let value = match self.content() {
            Content::Value(value) => read(&value),
            Content::Text(text) => Ok(json!(text).to_string()),
            Content::Bytes(bytes) => match Pickle::bytes(bytes) {
                Ok(value) => read(&value),
                Err(error) => Err(error.to_string()),
            },
            Content::Refused(error) => Err(error.to_string()),
        };
        let (key, value) = match value {
            Ok(value) => ("value", value),
            Err(error) => ("error", json!(error).to_string()),
        };
        let topic = json!(self.topic);
        let time = humantime::format_rfc3339_micros(self.at);
        format!("{{\"topic\": {topic}, \"time\": \"{time}\", \"{key}\": {value}}}")
    }

    /// What the message contains, also if that is not a pickle.
    #[must_use]
    pub fn content(&self) -> Content<'_> {
        use ztl_pickle::Error::{Refused, TooLarge};
        match self.value() {
            Ok(value) => Content::Value(value),
            Err(error @ (Refused(_) | TooLarge { .. })) => Content::Refused(error),
            Err(_) => match str::from_utf8(&self.body) {
                Ok(text) => Content::Text(text),
                Err(_) => Content::Bytes(&self.body),
            },
        }
    }
}

impl SubscriberBuilder {
    /// Adds a scope. Without one, all are heard.
    pub fn scope(mut self, scope: &str) -> Self {
        self.scopes.push(scope.to_owned());
        self
    }

    /// Encrypts, with our own keys and the publisher's.
    pub fn keys(mut self, own: KeyPair, publisher: PublicKey) -> Self {
        self.keys = Some((own, publisher));
        self
    }

    /// Sets the longest message in bytes; a longer one ends the connection. Default 64 MiB.
    pub fn longest(mut self, bytes: usize) -> Self {
        self.longest = Some(bytes);
        self
    }

    /// Subscribes, and connects while it is waited for.
    ///
    /// # Errors
    /// If the endpoint is invalid, or the system has no more files.
    pub fn connect(self, endpoint: &str) -> io::Result<Subscriber> {
        let at = Endpoint::parse(endpoint)
            .map_err(|why| io::Error::new(io::ErrorKind::InvalidInput, why))?;
        let keys = self.keys.map(|(own, publisher)| {
            curve::Keys::client(*own.secret(), *publisher.as_bytes(), random::secret)
        });
        let security = keys.map_or(Security::Null, Security::Curve);
        let mut scopes = self.scopes;
        if scopes.is_empty() {
            scopes.push(String::new());
        }
        let topics = scopes.iter().map(String::as_str).chain([MISSED]);
        let begin = topics.map(|topic| [b"\x01", topic.as_bytes()].concat());
        let dialer = Dialer::new(at, security, self.longest.unwrap_or(LONGEST))?;
        for scope in &scopes {
            info!(target: SUBSCRIBER, "Subscriber '{scope}' established at '{endpoint}'");
        }
        Ok(Subscriber {
            dialer: dialer.with_first(begin.collect()),
            scopes,
            missed: 0,
            told: 0,
            connection: 0,
            damaged: 0,
            next_is_state: None,
            was_state: false,
            begins: Vec::new(),
        })
    }
}

impl Subscriber {
    /// Subscribes to a scope: as [`SubscriberBuilder::connect`].
    ///
    /// # Errors
    /// Those of [`SubscriberBuilder::connect`].
    pub fn connect(endpoint: &str, scope: &str) -> io::Result<Self> {
        Self::builder().scope(scope).connect(endpoint)
    }

    /// Sets options before connecting.
    pub fn builder() -> SubscriberBuilder {
        SubscriberBuilder::default()
    }

    /// The next message, if it comes within `limit`.
    ///
    /// # Errors
    /// If the system can no longer wait for messages. No publisher can cause it.
    pub fn next_within(&mut self, limit: Duration) -> io::Result<Option<Heard>> {
        let end = Instant::now() + limit.min(LONG);
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if !self.dialer.can_receive(left)? {
                return Ok(None);
            }
            while let Some(frames) = self.dialer.receive() {
                if let Some(heard) = self.on_message(frames) {
                    return Ok(Some(heard));
                }
            }
            // Messages that are not wanted may come without end.
            if left.is_zero() {
                return Ok(None);
            }
        }
    }

    /// Whether the publisher is connected.
    #[must_use]
    pub fn is_connected(&self) -> bool {
        self.dialer.is_ready()
    }

    /// If the other side does not let this subscriber connect: what is wrong with it, and what helps. In the words of
    /// `ztl`: options of its commands, which have the same names in its files.
    #[must_use]
    pub fn advice(&self) -> Option<String> {
        let obstacle = self.dialer.obstacle()?;
        let (problem, mut remedy) = advice(obstacle);
        if matches!(obstacle, Obstacle::Fault(_)) {
            remedy = "is it a publisher, or a port for tasks?";
        }
        Some(format!("the publisher {problem}: {remedy}"))
    }

    /// How many messages the publisher has dropped since this subscriber was too slow. Only publishers of this crate tell
    /// it.
    #[must_use]
    pub const fn missed(&self) -> u64 {
        self.missed
    }

    /// How many messages were dropped because they are not ZTL's: not two frames, or a topic that is not UTF-8.
    #[must_use]
    pub const fn damaged(&self) -> u64 {
        self.damaged
    }

    /// How often the connection was lost.
    #[must_use]
    pub const fn lost(&self) -> u64 {
        self.dialer.lost()
    }

    /// Subscribes to topics that begin so, instead of all before, and to which of them are states.
    pub(crate) fn set_begins(&mut self, begins: Vec<Vec<u8>>) {
        let ask = |flag: &[u8], topic: &[u8]| [flag, topic].concat();
        let added = begins.iter().filter(|begin| !self.begins.contains(begin));
        let ended = self.begins.iter().filter(|begin| !begins.contains(begin));
        // Nothing is missed between the two.
        let added = added.map(|begin| ask(b"\x01", begin));
        // What limits others comes before them, and ends after them.
        let ended = ended.rev().map(|begin| ask(b"\0", begin));
        let changes: Vec<_> = added.chain(ended).collect();
        for change in changes {
            self.dialer.send_frame(&change);
        }
        let told = [MISSED, STATE].map(str::as_bytes);
        let first = told.into_iter().chain(begins.iter().map(Vec::as_slice));
        self.dialer
            .set_first(first.map(|topic| ask(b"\x01", topic)).collect());
        self.begins = begins;
    }

    /// Asks for the newest states again.
    pub(crate) fn ask_newest(&mut self) {
        self.dialer
            .send_frame(&[b"\x01", AGAIN.as_bytes()].concat());
    }

    /// Whether the last message was a state, if the publisher tells that.
    pub(crate) const fn was_state(&self) -> bool {
        self.was_state
    }

    /// The publisher says how many messages it has dropped since this subscriber connected.
    fn on_missed(&mut self, told: u64) {
        // It counts from zero for a new connection.
        if std::mem::replace(&mut self.connection, self.dialer.lost()) != self.dialer.lost() {
            self.told = 0;
        }
        let more = told.checked_sub(self.told).unwrap_or(told);
        self.missed = self.missed.saturating_add(more);
        self.told = told;
    }

    fn on_message(&mut self, frames: Vec<Vec<u8>>) -> Option<Heard> {
        let Ok([topic, body]) = <[Vec<u8>; 2]>::try_from(frames) else {
            self.damaged += 1;
            return None;
        };
        if topic == MISSED.as_bytes() {
            if let Ok(told) = Pickle::read(&body)
                && let Kind::Int(missed) = told.value().kind()
            {
                self.on_missed(u64::try_from(missed).unwrap_or(0));
            }
            return None;
        }
        if topic == STATE.as_bytes() {
            self.next_is_state = Some(self.dialer.lost());
            return None;
        }
        self.was_state = self.next_is_state.take() == Some(self.dialer.lost());
        let is_wanted = |scope: &String| is_below(&topic, scope.as_bytes());
        if !self.scopes.iter().any(is_wanted) {
            return None;
        }
        let Ok(topic) = String::from_utf8(topic) else {
            self.damaged += 1;
            return None;
        };
        Some(Heard {
            topic,
            body,
            at: SystemTime::now(),
        })
    }
}
