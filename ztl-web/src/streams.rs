//! Streams of publishers, for the clients that look at them. The console subscribes to a publisher only while a client does.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::{Duration, Instant, UNIX_EPOCH};

use axum::extract::ws::Message;
use serde_json::{Value, json};
use tokio::sync::watch;
use ztl_pickle::Kind;
use ztl_std::Subscriber;
use ztl_std::publish::{Content, Heard};

use crate::lock::locked;
use crate::picture;
use crate::rosbridge;

/// Connects to a publisher, and subscribes to its scope.
pub type ConnectPublisher = Arc<dyn Fn() -> Result<Subscriber, String> + Send + Sync>;

/// A publisher, as the configuration names it.
pub struct Publisher {
    /// Its name.
    pub name: String,
    /// Subscribes to it.
    pub connect: ConnectPublisher,
}

/// What the names of the topics begin with.
const TOPIC: &str = "/ztl/streams/";
/// Pause between two messages to the clients, because values can come faster than people see.
const PAUSE: Duration = Duration::from_millis(100);
/// Pause after a failed subscription to a publisher.
const RETRY: Duration = Duration::from_secs(1);
/// Most topics of a publisher. A new one then replaces the one that was silent for longest.
const TOPICS: usize = 50;
/// Longest value that is kept, and most bytes of one publisher's values.
const LONGEST: usize = 4 << 20;
const KEPT: usize = 32 << 20;
/// How much of a text is shown, in bytes.
const TEXT: usize = 300;
/// Most numbers of a value that are shown as lines.
const LINES: usize = 8;
/// Longest value that subscribers of its topic get as JSON.
const TOLD: usize = 64 << 10;
/// Most topics of all publishers that a client subscribes to.
const SUBSCRIBED: usize = 100;

/// What a client subscribes to.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Wanted {
    /// The list of a publisher's streams.
    All(usize),
    /// The values of a publisher's topic.
    Topic(usize, String),
}

/// A list of a publisher's streams, as JSON.
type Shared = Arc<str>;

/// The streams of all publishers.
pub(crate) struct Streams {
    /// The topics whose bytes are sound.
    sounds: BTreeSet<String>,
    publishers: Vec<Channel>,
    /// The newest message of each publisher.
    newest: watch::Sender<Arc<[Shared]>>,
    next: AtomicUsize,
}

struct Channel {
    name: String,
    connect: ConnectPublisher,
    /// How many clients look.
    looking: AtomicUsize,
    heard: Mutex<BTreeMap<String, Stream>>,
}

/// A topic.
struct Stream {
    number: usize,
    heard: Heard,
    /// The length of the value, which is dropped if it is too long.
    length: usize,
    count: u64,
    /// What is told of it; `None` if a newer value has come since.
    told: Option<Value>,
}

/// Starts a thread for each publisher.
pub(crate) fn spawn(streams: &Arc<Streams>) -> io::Result<()> {
    for publisher in 0..streams.publishers.len() {
        let streams = Arc::downgrade(streams);
        let thread = thread::Builder::new().name("ztl-web-stream".to_owned());
        thread.spawn(move || run(&streams, publisher))?;
    }
    Ok(())
}

fn run(streams: &Weak<Streams>, publisher: usize) {
    let mut subscriber = None;
    while let Some(streams) = streams.upgrade() {
        let Some(channel) = streams.publishers.get(publisher) else {
            return;
        };
        if channel.looking.load(Ordering::SeqCst) == 0 {
            subscriber = None;
            locked(&channel.heard).clear();
            drop(streams);
            thread::sleep(PAUSE);
        } else if let Err(why) = listen(&streams, channel, &mut subscriber) {
            subscriber = None;
            streams.publish(publisher, &json!({ "text": why, "streams": [] }));
            drop(streams);
            thread::sleep(RETRY);
        } else {
            let told = channel.tell(subscriber.as_ref(), &streams.sounds);
            streams.publish(publisher, &told);
        }
    }
}

/// Hears what is published for a while.
fn listen(
    streams: &Streams,
    channel: &Channel,
    subscriber: &mut Option<Subscriber>,
) -> Result<(), String> {
    let subscriber = match subscriber {
        Some(subscriber) => subscriber,
        none => none.insert((channel.connect)()?),
    };
    let until = Instant::now() + PAUSE;
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(());
        }
        let heard = subscriber.next_within(left);
        if let Some(heard) = heard.map_err(|error| error.to_string())? {
            channel.on_heard(heard, || streams.next.fetch_add(1, Ordering::Relaxed));
        }
    }
}

impl Streams {
    pub(crate) fn new(publishers: Vec<Publisher>, sounds: BTreeSet<String>) -> Self {
        let channel = |publisher: Publisher| Channel {
            name: publisher.name,
            connect: publisher.connect,
            looking: AtomicUsize::new(0),
            heard: Mutex::default(),
        };
        let publishers: Vec<Channel> = publishers.into_iter().map(channel).collect();
        let none: Vec<Shared> = publishers.iter().map(|_| Shared::from("{}")).collect();
        Self {
            sounds,
            publishers,
            newest: watch::Sender::new(none.into()),
            next: AtomicUsize::new(1),
        }
    }

    pub(crate) fn names(&self) -> Vec<&str> {
        self.publishers
            .iter()
            .map(|channel| channel.name.as_str())
            .collect()
    }

    /// What a topic of the socket stands for.
    pub(crate) fn find(&self, topic: &str) -> Option<Wanted> {
        let name = topic.strip_prefix(TOPIC)?;
        let wanted = |(publisher, channel): (usize, &Channel)| {
            let topic = name.strip_prefix(&channel.name)?;
            let wanted = match topic.starts_with('/') {
                true => Wanted::Topic(publisher, topic.to_owned()),
                false => Some(Wanted::All(publisher)).filter(|_| topic.is_empty())?,
            };
            Some((channel.name.len(), wanted))
        };
        let publishers = self.publishers.iter().enumerate();
        // A name may begin with another one.
        let (_, wanted) = publishers.filter_map(wanted).max()?;
        Some(wanted)
    }

    /// The newest picture of a stream, with its type.
    pub(crate) fn picture(&self, number: usize) -> Option<(&'static str, Vec<u8>)> {
        self.publishers.iter().find_map(|channel| {
            let heard = locked(&channel.heard);
            let stream = heard.values().find(|stream| stream.number == number)?;
            let heard = stream.heard.clone();
            picture::of(&heard.content())
        })
    }

    fn publish(&self, publisher: usize, told: &Value) {
        let text = told.to_string();
        self.newest.send_if_modified(|newest| {
            let known = newest.get(publisher);
            if known.is_none_or(|known| **known == *text) {
                return false;
            }
            let mut all = newest.to_vec();
            if let Some(known) = all.get_mut(publisher) {
                *known = text.into();
            }
            *newest = all.into();
            true
        });
    }
}

impl Channel {
    fn on_heard(&self, mut heard: Heard, number: impl FnOnce() -> usize) {
        // A new topic for each task: the tasks themselves are shown.
        if heard.topic.contains("/$tasks/") {
            return;
        }
        let mut all = locked(&self.heard);
        let known = all.remove(&heard.topic);
        if known.is_none() && all.len() >= TOPICS {
            let silent = all.iter().min_by_key(|(_, stream)| stream.heard.at);
            let silent = silent.map(|(topic, _)| topic.clone());
            silent.and_then(|topic| all.remove(&topic));
        }
        let length = heard.body.len();
        let others: usize = all.values().map(|stream| stream.heard.body.len()).sum();
        if length > LONGEST || others + length > KEPT {
            heard.body = Vec::new();
        }
        let stream = Stream {
            number: known.as_ref().map_or_else(number, |stream| stream.number),
            count: known.map_or(0, |stream| stream.count) + 1,
            length,
            told: None,
            heard,
        };
        all.insert(stream.heard.topic.clone(), stream);
    }

    fn tell(&self, subscriber: Option<&Subscriber>, sounds: &BTreeSet<String>) -> Value {
        let connected = subscriber.is_some_and(Subscriber::is_connected);
        let advice = subscriber.and_then(Subscriber::advice);
        let text = match (advice, connected) {
            (Some(advice), _) => advice,
            (None, true) => String::new(),
            (None, false) => "not connected".to_owned(),
        };
        let mut all = locked(&self.heard);
        let streams: Vec<Value> = all
            .values_mut()
            .map(|stream| stream.tell(sounds.contains(&stream.heard.topic)))
            .collect();
        json!({ "text": text, "streams": streams })
    }

    /// The newest value of a topic as JSON, with the numbers of the stream and the value; `None` if these are `known`.
    fn value(&self, topic: &str, known: Option<(usize, u64)>) -> Option<((usize, u64), String)> {
        let all = locked(&self.heard);
        let stream = all.get(topic)?;
        let which = (stream.number, stream.count);
        (Some(which) != known).then(|| (which, stream.to_json()))
    }
}

impl Stream {
    fn to_json(&self) -> String {
        match self.length {
            ..=TOLD => self.heard.to_json(),
            length => json!({
                "topic": self.heard.topic,
                "error": format!("the value has {length} bytes; more than {TOLD} are not sent"),
            })
            .to_string(),
        }
    }

    fn tell(&mut self, is_sound: bool) -> Value {
        if let Some(told) = &self.told {
            return told.clone();
        }
        let (text, numbers, shows) = match self.heard.body.len() == self.length {
            true if is_sound => shown_sound(&self.heard.content()),
            true => shown(&self.heard.content()),
            false => (format!("{} bytes", self.length), Vec::new(), false),
        };
        let at = self.heard.at.duration_since(UNIX_EPOCH);
        let told = json!({
            "topic": self.heard.topic,
            "number": self.number,
            "count": self.count,
            "at_ms": at.map_or(0, |at| u64::try_from(at.as_millis()).unwrap_or(u64::MAX)),
            "text": text,
            "numbers": numbers,
            "picture": shows,
        });
        self.told = Some(told.clone());
        told
    }
}

/// The level of sound, as a number.
fn shown_sound(content: &Content<'_>) -> (String, Vec<(String, f64)>, bool) {
    let bytes = match content {
        Content::Bytes(bytes) => *bytes,
        Content::Value(value) => match value.value().kind() {
            Kind::Bytes(bytes) | Kind::ByteArray(bytes) => bytes,
            _ => return shown(content),
        },
        _ => return shown(content),
    };
    let level = level(bytes);
    (
        format!("{level:.0} dB of full scale"),
        vec![("dB".to_owned(), level)],
        false,
    )
}

/// The root mean square of 16-bit samples, little-endian, in decibels of the largest one; not below that of one step.
fn level(bytes: &[u8]) -> f64 {
    const FULL: f64 = 32_768.0;
    let (samples, _) = bytes.as_chunks::<2>();
    let squares = samples.iter().map(|bytes| {
        let sample = f64::from(i16::from_le_bytes(*bytes));
        sample * sample
    });
    let mean = squares.sum::<f64>() / samples.len().max(1) as f64;
    20.0 * (mean.sqrt().max(1.0) / FULL).log10()
}

/// A value as text, its numbers with their names, and whether it is a picture.
fn shown(content: &Content<'_>) -> (String, Vec<(String, f64)>, bool) {
    let is_picture = picture::is_one(content);
    match content {
        Content::Value(value) => {
            let value = value.value();
            let text = match value.kind() {
                Kind::Bytes(bytes) | Kind::ByteArray(bytes) if bytes.len() > TEXT => {
                    format!("{} bytes", bytes.len())
                }
                Kind::Array(array) if array.data().len() > TEXT => format!("{array:?}"),
                _ => value.repr().most(TEXT).to_string(),
            };
            (text, numbers(value), is_picture)
        }
        Content::Text(text) => {
            let number = text
                .trim()
                .parse()
                .ok()
                .filter(|number: &f64| number.is_finite());
            let numbers = number.map(|number| (String::new(), number));
            let most = text.floor_char_boundary(TEXT);
            let text = text.get(..most).unwrap_or_default().to_owned();
            (text, numbers.into_iter().collect(), is_picture)
        }
        Content::Bytes(bytes) => (format!("{} bytes", bytes.len()), Vec::new(), is_picture),
        Content::Refused(error) => (error.to_string(), Vec::new(), false),
    }
}

/// The numbers of a value: itself, or those directly in it.
fn numbers(value: ztl_pickle::Value<'_>) -> Vec<(String, f64)> {
    let finite = |name: String, value: ztl_pickle::Value<'_>| {
        let number = value.as_f64().filter(|number| number.is_finite())?;
        Some((name, number))
    };
    match value.kind() {
        Kind::Dict(entries) | Kind::OrderedDict(entries) => entries
            .take(LINES)
            .filter_map(|(key, value)| finite(key.repr().most(TEXT).to_string(), value))
            .collect(),
        Kind::List(items) | Kind::Tuple(items) => items
            .take(LINES)
            .enumerate()
            .filter_map(|(index, value)| finite(index.to_string(), value))
            .collect(),
        _ => finite(String::new(), value).into_iter().collect(),
    }
}

/// What one client hears of streams.
pub(crate) struct Listener {
    streams: Arc<Streams>,
    newest: watch::Receiver<Arc<[Shared]>>,
    /// What was the newest when it was told last.
    seen: Arc<[Shared]>,
    /// The publishers that it looks at, and what it was told last.
    looks: BTreeMap<usize, Shared>,
    /// The topics of publishers, and which value it was told last.
    topics: BTreeMap<(usize, String), Option<(usize, u64)>>,
}

impl Listener {
    pub(crate) fn new(streams: &Arc<Streams>) -> Self {
        let newest = streams.newest.subscribe();
        let seen = Arc::clone(&newest.borrow());
        Self {
            streams: Arc::clone(streams),
            newest,
            seen,
            looks: BTreeMap::new(),
            topics: BTreeMap::new(),
        }
    }

    /// Begins or ends to look at a publisher or a topic. Returns what is told at once.
    pub(crate) fn listen(&mut self, wanted: Wanted, on: bool) -> Vec<Message> {
        let publisher = match &wanted {
            Wanted::All(publisher) | Wanted::Topic(publisher, _) => *publisher,
        };
        let Some(channel) = self.streams.publishers.get(publisher) else {
            return Vec::new();
        };
        let is_changed = match (wanted, on) {
            (Wanted::All(_), true) => self.looks.insert(publisher, Shared::from("{}")).is_none(),
            (Wanted::All(_), false) => self.looks.remove(&publisher).is_some(),
            (Wanted::Topic(_, topic), true) => {
                if self.topics.len() >= SUBSCRIBED {
                    let why = format!("not subscribed: a client may have {SUBSCRIBED} topics");
                    return vec![Message::from(rosbridge::error(&why))];
                }
                self.topics.insert((publisher, topic), None).is_none()
            }
            (Wanted::Topic(_, topic), false) => self.topics.remove(&(publisher, topic)).is_some(),
        };
        if is_changed && on {
            channel.looking.fetch_add(1, Ordering::SeqCst);
        } else if is_changed {
            channel.looking.fetch_sub(1, Ordering::SeqCst);
        }
        self.news()
    }

    /// Waits for news of the publishers that it looks at.
    pub(crate) async fn changed(&mut self) -> Vec<Message> {
        let is_idle = self.looks.is_empty() && self.topics.is_empty();
        if is_idle || self.newest.changed().await.is_err() {
            std::future::pending::<()>().await;
        }
        self.news()
    }

    fn news(&mut self) -> Vec<Message> {
        let newest = Arc::clone(&self.newest.borrow_and_update());
        // Each publisher has news ten times a second at most, also if another one has news in between.
        let has_news = |publisher: usize| match (newest.get(publisher), self.seen.get(publisher)) {
            (Some(now), Some(seen)) => !Arc::ptr_eq(now, seen),
            _ => false,
        };
        let mut messages = Vec::new();
        for ((publisher, topic), told) in &mut self.topics {
            let channel = self.streams.publishers.get(*publisher);
            if let Some(channel) = channel
                && (told.is_none() || has_news(*publisher))
                && let Some((which, value)) = channel.value(topic, *told)
            {
                *told = Some(which);
                let topic = format!("{TOPIC}{}{topic}", channel.name);
                messages.push(Message::from(rosbridge::publish(&topic, &value)));
            }
        }
        for (publisher, told) in &mut self.looks {
            let (Some(now), Some(channel)) = (
                newest.get(*publisher),
                self.streams.publishers.get(*publisher),
            ) else {
                continue;
            };
            if **now != **told {
                *told = Arc::clone(now);
                let topic = format!("{TOPIC}{}", channel.name);
                messages.push(Message::from(rosbridge::publish(&topic, now)));
            }
        }
        self.seen = newest;
        messages
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        let topics = self.topics.keys().map(|(publisher, _)| publisher);
        for publisher in self.looks.keys().chain(topics) {
            if let Some(channel) = self.streams.publishers.get(*publisher) {
                channel.looking.fetch_sub(1, Ordering::SeqCst);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hear(streams: &Streams, publisher: usize, word: &str) {
        let heard = Heard {
            topic: "/lab/x".to_owned(),
            body: word.as_bytes().to_vec(),
            at: UNIX_EPOCH,
        };
        streams.publishers[publisher].on_heard(heard, || 1);
    }

    fn tell(streams: &Streams, publisher: usize) {
        let told = streams.publishers[publisher].tell(None, &streams.sounds);
        streams.publish(publisher, &told);
    }

    #[test]
    fn the_news_of_one_publisher_make_the_topics_of_another_no_faster() {
        let publisher = |name: &str| Publisher {
            name: name.to_owned(),
            connect: Arc::new(|| Err("nobody connects".to_owned())),
        };
        let publishers = vec![publisher("one"), publisher("other")];
        let streams = Arc::new(Streams::new(publishers, BTreeSet::new()));
        let mut listener = Listener::new(&streams);
        for publisher in 0..2 {
            let topic = Wanted::Topic(publisher, "/lab/x".to_owned());
            assert!(listener.listen(topic, true).is_empty());
            hear(&streams, publisher, "first");
            tell(&streams, publisher);
            assert_eq!(listener.news().len(), 1);
        }
        hear(&streams, 0, "second");
        hear(&streams, 1, "second");
        tell(&streams, 1);
        assert_eq!(listener.news().len(), 1, "of the other one only");
        tell(&streams, 0);
        assert_eq!(listener.news().len(), 1);
        assert!(listener.news().is_empty());
    }
}
