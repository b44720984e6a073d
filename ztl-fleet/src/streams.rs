//! Streams of robots: what an agent and an endpoint say to each other, and the rules of both ends, without I/O
//! (docs/fleet.md).
//!
//! An endpoint asks an agent for topics, and again before its interest expires. The agent passes messages on with consecutive
//! numbers: a gap is a number of missed messages. They belong to a *session*, which the agent draws at random. An endpoint
//! takes messages only of the session that the agent has told it, and with rising numbers, so that a recording says nothing.

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use ztl_core::Instant;
use ztl_core::topic::is_below;

/// Longest value of a message: with its topic and a seal, it fits into a message of Zenoh.
pub const LONGEST: usize = 6 << 20;
/// Bytes that may be on their way: at first, and at least and at most. Above, what waits stays with the robot's publisher, where
/// the newest state counts.
const FIRST_WINDOW: usize = 256 << 10;
const WINDOWS: (usize, usize) = (64 << 10, 4 << 20);
/// A line on which a message is longer under way has fewer bytes on it: answers to requests wait behind them.
const LATE: Duration = Duration::from_millis(150);
/// After this time, a message that was not heard is lost.
const LOST: Duration = Duration::from_secs(2);
/// How often an endpoint asks.
pub const RENEW: Duration = Duration::from_secs(1);
/// Part of the window after which an endpoint asks earlier.
const PART: usize = 4;
/// Work of a message at both ends and at routers, as if it had so many bytes more: so no flood of small messages keeps requests
/// waiting behind them for long.
const WORK: usize = 4096;
/// How long an agent passes messages on after it was asked.
pub const LEASE: Duration = Duration::from_secs(5);
/// Most topics that are asked for. For more, all is that those who subscribe may hear.
pub const MOST_TOPICS: usize = 64;
/// Bytes of a topic that a subscriber may ask for.
pub const LONGEST_TOPIC: usize = 4096;
/// Between a scope and the id of a task in a topic.
const TASKS: &str = "/$tasks/";

/// What an endpoint asks an agent for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Want {
    /// Last chunk of the key to which messages go: 32 hexadecimal digits.
    pub id: String,
    /// The session that the agent has told last.
    #[serde(default)]
    pub session: Option<String>,
    /// How the topics begin; empty to end. One may have further lines: exceptions, which begin so, too.
    pub topics: Vec<String>,
    /// The highest number that has arrived.
    #[serde(default)]
    pub heard: u64,
    /// Whether the newest states are needed again.
    #[serde(default)]
    pub newest: bool,
}

/// An agent's answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Granted {
    /// Messages come once the agent is asked with this session.
    pub session: String,
    /// The number of the last message.
    pub sent: u64,
    /// How many bytes may be on their way. Once a quarter has arrived, the agent should be asked again.
    #[serde(default)]
    pub window: usize,
    /// Why none come.
    #[serde(default)]
    pub problem: Option<String>,
}

/// The first line of a message, before its value.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Head {
    /// The agent's session.
    pub session: String,
    /// Rises by one with each message, and by one for each message that was missed before.
    pub number: u64,
    /// The topic, as at the robot's publisher.
    pub topic: String,
    /// The robot's scope that it belongs to.
    #[serde(default)]
    pub scope: Option<String>,
    /// Whether only the newest message of its topic counts.
    #[serde(default)]
    pub state: bool,
}

impl Head {
    /// A message with this head.
    #[must_use]
    pub fn with(&self, body: &[u8]) -> Vec<u8> {
        let head = serde_json::to_vec(self).unwrap_or_default();
        [&head, &b"\n"[..], body].concat()
    }

    /// Reads a message.
    #[must_use]
    pub fn parse(message: &[u8]) -> Option<(Self, &[u8])> {
        let end = message.iter().position(|byte| *byte == b'\n')?;
        let (head, rest) = message.split_at_checked(end)?;
        let head = serde_json::from_slice(head).ok()?;
        Some((head, rest.get(1..)?))
    }

    /// The scope of a robot and the topic at an endpoint, as `/NAME/scope` and the path below it; the scope is the whole robot if
    /// the message belongs to none. `None` for a reserved topic.
    #[must_use]
    pub fn place(&self, robot: &str) -> Option<(String, String)> {
        if self.topic.starts_with('$') {
            return None;
        }
        let scope = self.scope.as_deref();
        let scope = scope.filter(|scope| scope.starts_with('/'));
        let of_scope = scope.and_then(|scope| {
            let fits = is_below(self.topic.as_bytes(), scope.as_bytes());
            let path = self.topic.get(scope.len()..).filter(|_| fits)?;
            Some((format!("/{robot}{scope}"), path.to_owned()))
        });
        Some(of_scope.unwrap_or_else(|| {
            // Readings of a gateway begin with the name of a device.
            let slash = if self.topic.starts_with('/') { "" } else { "/" };
            (format!("/{robot}"), format!("{slash}{}", self.topic))
        }))
    }
}

/// The scope of a robot that a topic belongs to. `None` if it may belong to several, or to none that is known: then only who may
/// use the whole robot may hear it.
#[must_use]
pub fn scope_of<'a>(topic: &'a str, scopes: &'a [String]) -> Option<&'a str> {
    if let Some((scope, _)) = topic.split_once(TASKS) {
        return Some(scope).filter(|scope| scope.starts_with('/'));
    }
    let mut above = scopes
        .iter()
        .filter(|scope| is_below(topic.as_bytes(), scope.as_bytes()));
    let first = above.next();
    first.filter(|_| above.next().is_none()).map(String::as_str)
}

/// How a robot's topics begin that are meant by topics of an endpoint which begin so.
#[must_use]
pub fn topics_of(begin: &[u8], robot: &str) -> Vec<String> {
    let root = format!("/{robot}/");
    if root.as_bytes().starts_with(begin) {
        return vec![String::new()];
    }
    let Some(rest) = begin.strip_prefix(root.as_bytes()) else {
        return Vec::new();
    };
    let rest = match str::from_utf8(rest) {
        Ok(rest) => rest,
        // It may end within a character.
        Err(error) if error.error_len().is_none() => {
            let whole = rest.get(..error.valid_up_to()).unwrap_or_default();
            str::from_utf8(whole).unwrap_or_default()
        }
        Err(_) => return Vec::new(),
    };
    // Exceptions follow a line feed. A shorter beginning brings more, which is not given to who has not asked for it.
    let rest = rest.split('\n').next().unwrap_or_default();
    // Readings of a gateway do not begin with a slash.
    vec![format!("/{rest}"), rest.to_owned()]
}

/// What of these topics somebody may hear who may use these scopes, and not those that are hidden. Where a hidden scope is below
/// one that may be used, it becomes an exception of the topic ([`Want::topics`]).
#[must_use]
pub fn within(topics: &[String], allowed: &[&str], hidden: &[&str]) -> Vec<String> {
    let mut all = Vec::new();
    for (topic, scope) in topics
        .iter()
        .flat_map(|topic| allowed.iter().map(move |scope| (topic, scope)))
    {
        let mut lines = topic.split('\n');
        let begin = lines.next().unwrap_or_default();
        let root = format!("{scope}/");
        let begin = match () {
            () if begin.starts_with(&root) => begin,
            () if root.starts_with(begin) => &root,
            () => continue,
        };
        let hidden = hidden.iter().map(|hidden| format!("{hidden}/"));
        let hidden = hidden.filter(|hidden| hidden.starts_with(&root));
        let exceptions: BTreeSet<String> = hidden.chain(lines.map(str::to_owned)).collect();
        if exceptions
            .iter()
            .any(|other| begin.starts_with(other.as_str()))
        {
            continue;
        }
        let below = exceptions.iter().filter(|other| other.starts_with(begin));
        let lines = std::iter::once(begin).chain(below.map(String::as_str));
        all.push(lines.collect::<Vec<_>>().join("\n"));
    }
    uncovered(all)
}

/// The same topics without those that others cover.
fn uncovered(mut topics: Vec<String>) -> Vec<String> {
    topics.sort();
    // What begins with another one comes after it; so does the same topic with more exceptions.
    topics.dedup_by(|topic, before| match topic.strip_prefix(before.as_str()) {
        Some(rest) => !before.contains('\n') || rest.is_empty() || rest.starts_with('\n'),
        None => false,
    });
    topics
}

/// The same topics without those that others cover. If there are too many, `widest`, all that those who subscribe may hear; of
/// these, as many as an agent takes.
#[must_use]
pub fn fewest(topics: Vec<String>, widest: impl FnOnce() -> Vec<String>) -> Vec<String> {
    let mut topics = uncovered(topics);
    if topics.len() > MOST_TOPICS {
        topics = uncovered(widest());
    }
    topics.retain(|topic| topic.len() <= LONGEST_TOPIC);
    topics.truncate(MOST_TOPICS);
    topics
}

/// Whether a topic is among those that begin so.
#[must_use]
pub fn is_wanted(topic: &str, topics: &[String]) -> bool {
    topics.iter().any(|wanted| {
        let mut lines = wanted.split('\n');
        let begins = lines.next().is_some_and(|begin| topic.starts_with(begin));
        begins && !lines.any(|exception| topic.starts_with(exception))
    })
}

/// An agent's end: what it passes on to one endpoint.
#[derive(Debug)]
pub struct Outgoing {
    number: u64,
    /// Messages that are not heard yet: numbers, bytes, and when they were sent.
    under_way: VecDeque<(u64, usize, Instant)>,
    bytes: usize,
    window: usize,
}

impl Default for Outgoing {
    fn default() -> Self {
        Self {
            number: 0,
            under_way: VecDeque::new(),
            bytes: 0,
            window: FIRST_WINDOW,
        }
    }
}

impl Outgoing {
    /// How many bytes may be on their way.
    #[must_use]
    pub const fn window(&self) -> usize {
        self.window
    }

    /// The number of the last message.
    #[must_use]
    pub const fn sent(&self) -> u64 {
        self.number
    }

    /// Whether another message may be sent now.
    pub fn may_send(&mut self, now: Instant) -> bool {
        while let Some((_, bytes, at)) = self.under_way.front()
            && now.since(*at) >= LOST
        {
            self.bytes -= bytes;
            self.under_way.pop_front();
        }
        self.bytes < self.window
    }

    /// The number of a message that is sent now.
    pub fn send(&mut self, now: Instant, bytes: usize) -> u64 {
        let bytes = bytes.saturating_add(WORK);
        self.skip(1);
        self.under_way.push_back((self.number, bytes, now));
        self.bytes += bytes;
        self.number
    }

    /// Messages were missed before they could be sent.
    pub const fn skip(&mut self, count: u64) {
        self.number = self.number.saturating_add(count);
    }

    /// The endpoint has heard messages up to this number.
    pub fn on_heard(&mut self, now: Instant, heard: u64) {
        let before = self.bytes;
        while let Some((number, bytes, _)) = self.under_way.front()
            && *number <= heard
        {
            self.bytes -= bytes;
            self.under_way.pop_front();
        }
        let next = self.under_way.front();
        self.window = match next.is_some_and(|(_, _, at)| now.since(*at) > LATE) {
            true => self.window / 2,
            false => self.window + (before - self.bytes),
        };
        self.window = self.window.clamp(WINDOWS.0, WINDOWS.1);
    }
}

/// An endpoint's end: what arrives from one robot.
#[derive(Debug, Default)]
pub struct Incoming {
    session: Option<String>,
    heard: u64,
    /// A number that the agent had sent, and when it said so.
    promised: Option<(u64, Instant)>,
    newest: bool,
    /// Bytes that have arrived since the agent was asked, and its window.
    bytes: usize,
    window: usize,
}

impl Incoming {
    /// What to ask the agent for.
    pub fn want(&mut self, id: &str, topics: &[String]) -> Want {
        self.bytes = 0;
        Want {
            id: id.to_owned(),
            session: self.session.clone(),
            topics: topics.to_vec(),
            heard: self.heard,
            newest: std::mem::take(&mut self.newest),
        }
    }

    /// Whether to ask at once, so that more may come.
    #[must_use]
    pub const fn is_due(&self) -> bool {
        self.bytes > 0 && self.bytes >= self.window / PART
    }

    /// The newest states are needed again.
    pub const fn lose_states(&mut self) {
        self.newest = true;
    }

    /// The agent's answer. Returns how many messages are missed, at least, and whether to ask again at once.
    pub fn on_answer(&mut self, now: Instant, granted: &Granted) -> (u64, bool) {
        if self.session.as_ref() != Some(&granted.session) {
            // What came between two sessions is not known.
            let missed = u64::from(self.session.is_some());
            *self = Self {
                session: Some(granted.session.clone()),
                window: granted.window,
                ..Self::default()
            };
            return (missed, true);
        }
        self.window = granted.window;
        let late = self
            .promised
            .filter(|(_, at)| now.since(*at) >= RENEW.mul_f32(0.9));
        let mut missed = 0;
        if let Some((number, _)) = late {
            missed = number.saturating_sub(self.heard);
            self.heard = self.heard.max(number);
            self.newest |= missed > 0;
        }
        if late.is_some() || self.promised.is_none() {
            self.promised = Some((granted.sent, now));
        }
        (missed, false)
    }

    /// A message of so many bytes. Returns how many were missed before it; `None` if it is of another session or came already.
    pub fn on_message(&mut self, head: &Head, bytes: usize) -> Option<u64> {
        if self.session.as_ref() != Some(&head.session) || head.number <= self.heard {
            return None;
        }
        let missed = head.number - self.heard - 1;
        self.heard = head.number;
        self.newest |= missed > 0;
        self.bytes = self.bytes.saturating_add(bytes).saturating_add(WORK);
        Some(missed)
    }
}

#[cfg(test)]
mod tests;
