//! Publishes messages to those who subscribed to their topics: a PUB socket, on a thread of its own.
//!
//! A subscriber that reads too slowly delays nobody: its messages wait in a queue of limited size, which drops the oldest
//! ones. Messages that wait for several subscribers are in memory once.

mod message;
mod subscriber;

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tracing::{info, warn};
use ztl_zmtp::Pub;

pub(crate) use self::message::{PubMessage, Unheard};
use self::subscriber::{BEHIND, Subscriber, has_room};
pub(crate) use self::subscriber::{EXCEPT, MISSED, STATE};
use super::peers::{PeerId, Peers, Rules};
use super::sockets::Endpoint;
use crate::keys::PublicKey;
use crate::log_targets::{PUBLISHER, TASKS};
use crate::server::CurrentAccess;

/// Bytes of messages that wait for the thread. Above, nothing more is published.
const QUEUE: usize = 32 << 20;
/// Bytes up to which a source that can wait need not. So others have room, and what waits is sent soon.
const READY: usize = 256 << 10;
/// Bytes of the newest messages, which late subscribers get.
const NEWEST: usize = 32 << 20;
/// Bytes of the subscriptions of all subscribers. Further ones are ignored.
const ALL_TOPICS: usize = 32 << 20;
/// Subscriptions that are taken at once, before messages are published again.
const AT_ONCE: usize = 64;
/// The longest message of a subscriber.
const SUBSCRIPTION: usize = 4096;
/// How long what waits is still sent after the socket was dropped.
const LINGER: Duration = Duration::from_secs(1);

/// Who subscribes to this gets the newest states again.
pub(crate) const AGAIN: &str = "$ztl/newest";

/// Learns whether anyone subscribes to a topic.
struct Watch {
    /// A message of this topic.
    message: PubMessage,
    is_heard: bool,
    changed: Box<dyn FnMut(bool) + Send>,
}

impl fmt::Debug for Watch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Watch")
    }
}

/// The topics of each subscriber, with its key.
pub(crate) type Wanted = Vec<(Option<PublicKey>, Vec<u8>)>;

/// Learns what all subscribers subscribe to.
struct Listener(Box<dyn FnMut(Wanted) + Send>);

impl fmt::Debug for Listener {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Listener")
    }
}

/// Tells which topics are stale.
type IsStale = Box<dyn Fn(&[u8]) -> bool + Send>;

/// What a publisher does in turn.
enum Order {
    Publish(PubMessage),
    /// Forgets the newest states of topics that are stale.
    Forget(IsStale),
    /// Subscribers of a robot may have missed messages.
    Missed(Unheard),
}

impl fmt::Debug for Order {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Order")
    }
}

/// What waits for the thread.
#[derive(Debug, Default)]
struct Queue {
    orders: VecDeque<Order>,
    held: usize,
    watches: Vec<Watch>,
    listener: Option<Listener>,
    /// Whether the thread was woken, and has not looked since.
    is_awake: bool,
    is_closed: bool,
    /// Messages that subscribers have missed.
    missed: u64,
}

#[derive(Debug, Default)]
struct Shared {
    queue: Mutex<Queue>,
    subscribers: AtomicUsize,
}

impl Shared {
    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A PUB socket. When it is dropped, it sends what waits, at most for [`LINGER`], and closes.
#[derive(Debug)]
pub(crate) struct PubSocket {
    endpoint: String,
    shared: Arc<Shared>,
    waker: mio::Waker,
    thread: Option<JoinHandle<()>>,
}

/// What the thread owns.
struct Worker {
    peers: Peers<Pub>,
    access: CurrentAccess,
    shared: Arc<Shared>,
    subscribers: BTreeMap<PeerId, Subscriber>,
    watches: Vec<Watch>,
    listener: Option<Listener>,
    /// Bytes that the topics of all subscribers take.
    topics: usize,
    /// The newest state of each topic, and the bytes of all.
    newest: BTreeMap<Vec<u8>, PubMessage>,
    newest_held: usize,
    /// Whether joining and leaving is logged, like by the original.
    logs_subscribers: bool,
    missed: u64,
}

impl PubSocket {
    /// Publishes there, to those whom `access` admits.
    pub(crate) fn bind(
        endpoint: &Endpoint,
        rules: Rules,
        access: CurrentAccess,
        logs_subscribers: bool,
    ) -> io::Result<Self> {
        let rules = Rules {
            message: SUBSCRIPTION,
            // What waits for a subscriber is limited here.
            memory: usize::MAX,
            ..rules
        };
        let peers = Peers::bind(endpoint, rules)?;
        let endpoint = peers.endpoint()?;
        let waker = peers.waker()?;
        let shared = Arc::<Shared>::default();
        let worker = Worker {
            peers,
            access,
            shared: Arc::clone(&shared),
            subscribers: BTreeMap::new(),
            watches: Vec::new(),
            listener: None,
            topics: 0,
            newest: BTreeMap::new(),
            newest_held: 0,
            logs_subscribers,
            missed: 0,
        };
        let thread = std::thread::Builder::new()
            .name("ztl-publisher".to_owned())
            .spawn(move || {
                if let Err(error) = worker.run() {
                    warn!(target: TASKS, "publishing has stopped: {error}");
                }
            })?;
        Ok(Self {
            endpoint,
            shared,
            waker,
            thread: Some(thread),
        })
    }

    /// Where it listens, with the port that was chosen.
    pub(crate) fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Whether its thread has ended, which it does only at a fault.
    pub(crate) fn has_ended(&self) -> bool {
        let thread = self.thread.as_ref();
        thread.is_none_or(JoinHandle::is_finished)
    }

    /// How many peers have subscribed.
    pub(crate) fn subscribers(&self) -> usize {
        self.shared.subscribers.load(Ordering::Relaxed)
    }

    /// Messages that subscribers have missed, in all.
    pub(crate) fn missed(&self) -> u64 {
        self.shared.queue().missed
    }

    /// Publishes without waiting. Returns whether there was room.
    pub(crate) fn publish(&self, message: PubMessage) -> bool {
        let mut queue = self.shared.queue();
        let held = queue.held + message.held();
        let has_room = held <= QUEUE || queue.orders.is_empty();
        if has_room {
            queue.held = held;
            queue.orders.push_back(Order::Publish(message));
        }
        self.wake(queue);
        has_room
    }

    /// Whether there is room for a source that can wait.
    pub(crate) fn has_room(&self) -> bool {
        self.shared.queue().held <= READY
    }

    /// Calls `changed` on the publisher's thread whenever it changes whether any subscriber gets such a message; at first
    /// none does.
    pub(crate) fn watch(&self, message: PubMessage, changed: impl FnMut(bool) + Send + 'static) {
        let mut queue = self.shared.queue();
        queue.watches.push(Watch {
            message,
            is_heard: false,
            changed: Box::new(changed),
        });
        self.wake(queue);
    }

    /// Calls `changed` on the publisher's thread whenever it changes what anyone subscribes to, with all of it.
    pub(crate) fn listen(&self, changed: impl FnMut(Wanted) + Send + 'static) {
        let mut queue = self.shared.queue();
        queue.listener = Some(Listener(Box::new(changed)));
        self.wake(queue);
    }

    /// Forgets the newest states of the topics that are stale, after what was published before.
    pub(crate) fn forget(&self, is_stale: impl Fn(&[u8]) -> bool + Send + 'static) {
        self.order(Order::Forget(Box::new(is_stale)));
    }

    /// Tells those subscribers who may have heard them that messages were missed.
    pub(crate) fn tell_missed(&self, unheard: Unheard) {
        self.order(Order::Missed(unheard));
    }

    fn order(&self, order: Order) {
        let mut queue = self.shared.queue();
        queue.orders.push_back(order);
        self.wake(queue);
    }

    /// Wakes the thread, unless that was done before.
    fn wake(&self, mut queue: MutexGuard<'_, Queue>) {
        let wake = !std::mem::replace(&mut queue.is_awake, true);
        drop(queue);
        if wake {
            let _ = self.waker.wake();
        }
    }
}

impl Drop for PubSocket {
    fn drop(&mut self) {
        self.shared.queue().is_closed = true;
        let _ = self.waker.wake();
        if let Some(thread) = self.thread.take() {
            // A panic there has been printed already.
            let _ = thread.join();
        }
    }
}

impl Worker {
    /// Runs until the publisher is dropped.
    fn run(mut self) -> io::Result<()> {
        loop {
            self.peers.wait(None)?;
            let mut has_changed = self.take_subscriptions();
            let (orders, is_closed) = {
                let mut queue = self.shared.queue();
                queue.is_awake = false;
                queue.held = 0;
                has_changed |= !queue.watches.is_empty();
                self.watches.append(&mut queue.watches);
                if let Some(listener) = queue.listener.take() {
                    self.listener = Some(listener);
                    has_changed = true;
                }
                let orders = std::mem::take(&mut queue.orders);
                (orders, queue.is_closed)
            };
            if has_changed {
                self.tell_watches();
                self.tell_listener();
            }
            for order in orders {
                match order {
                    Order::Publish(message) => self.publish(&message),
                    Order::Forget(is_stale) => self.forget(is_stale),
                    Order::Missed(unheard) => self.miss(&unheard),
                }
            }
            self.pump();
            self.shared.queue().missed = self.missed;
            if is_closed {
                return self.linger();
            }
        }
    }

    /// Sends what waits.
    fn linger(mut self) -> io::Result<()> {
        let end = Instant::now() + LINGER;
        let is_waiting = |worker: &Self| {
            let mut subscribers = worker.subscribers.iter();
            subscribers.any(|(peer, subscriber)| {
                !subscriber.queue.is_empty() || worker.peers.waiting(*peer) > Some(0)
            })
        };
        while is_waiting(&self) {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            self.peers.wait(Some(left))?;
            self.take_subscriptions();
            self.pump();
        }
        Ok(())
    }

    /// Tells those who watch a topic whether that has a subscriber.
    fn tell_watches(&mut self) {
        let access = self.access.read();
        for watch in &mut self.watches {
            let mut subscribers = self.subscribers.values();
            let is_heard = subscribers.any(|one| one.gets(&watch.message, &access));
            if is_heard != watch.is_heard {
                watch.is_heard = is_heard;
                (watch.changed)(is_heard);
            }
        }
    }

    fn tell_listener(&mut self) {
        let Some(Listener(changed)) = &mut self.listener else {
            return;
        };
        let all = self.subscribers.values();
        let all = all.flat_map(|one| one.topics().map(|topic| (one.key, topic.to_vec())));
        changed(all.collect());
    }

    fn forget(&mut self, is_stale: impl Fn(&[u8]) -> bool) {
        let held = &mut self.newest_held;
        self.newest.retain(|topic, message| {
            let keeps = !is_stale(topic);
            if !keeps {
                *held -= message.held();
            }
            keeps
        });
    }

    fn miss(&mut self, unheard: &Unheard) {
        let access = self.access.read();
        for (peer, subscriber) in &mut self.subscribers {
            subscriber.miss(unheard, &access);
            // Before the messages that follow the gap.
            subscriber.fill(*peer, &mut self.peers);
        }
    }

    /// Reads what subscribers ask for, and notes who has left. Returns whether that was anything.
    fn take_subscriptions(&mut self) -> bool {
        let mut has_changed = false;
        let access = &self.access;
        let mut admit =
            |address, key: Option<[u8; 32]>| access.admits(address, key.map(PublicKey::from_bytes));
        for _ in 0..AT_ONCE {
            let Some(message) = self.peers.next(&mut admit) else {
                break;
            };
            has_changed = true;
            let body = message.body.unwrap_or_default();
            if let Some((begins @ 0..=1, topic)) = body.split_first() {
                let subscriber = self.subscribers.entry(message.peer).or_default();
                subscriber.key = message.key.map(PublicKey::from_bytes);
                if topic == AGAIN.as_bytes() {
                    if *begins == 1 {
                        let access = access.read();
                        for message in self.newest.values() {
                            subscriber.push_newest(message, &access);
                        }
                    }
                    continue;
                }
                let before = subscriber.bytes;
                let has_room = self.topics < ALL_TOPICS;
                let is_new = subscriber.change(*begins == 1, topic, has_room);
                self.topics = self.topics + subscriber.bytes - before;
                if is_new {
                    let newest = self.newest.range(topic.to_vec()..);
                    let newest = newest.take_while(|(known, _)| known.starts_with(topic));
                    let access = access.read();
                    for (_, message) in newest {
                        subscriber.push_newest(message, &access);
                    }
                }
            }
        }
        let peers = &self.peers;
        let topics = &mut self.topics;
        self.subscribers.retain(|peer, subscriber| {
            let is_there = peers.waiting(*peer).is_some();
            if !is_there {
                *topics -= subscriber.bytes;
                has_changed = true;
            }
            is_there
        });
        let count = self.subscribers.len();
        let before = self.shared.subscribers.swap(count, Ordering::Relaxed);
        if self.logs_subscribers {
            for total in before + 1..=count {
                info!(target: PUBLISHER, "Subscriber joined! Total connected: {total}");
            }
            for total in (count..before).rev() {
                info!(target: PUBLISHER, "Subscriber left! Total connected: {total}");
            }
        }
        has_changed
    }

    fn publish(&mut self, message: &PubMessage) {
        if message.is_state {
            self.keep(message);
        }
        let access = self.access.read();
        for (peer, subscriber) in &mut self.subscribers {
            if !subscriber.gets(message, &access) {
                continue;
            }
            if subscriber.queue.is_empty() && has_room(&self.peers, *peer, message) {
                subscriber.send(*peer, message, &mut self.peers);
                subscriber.forget_dropped(message);
            } else {
                subscriber.push(message.clone());
                if subscriber.held > BEHIND {
                    self.peers.flush();
                    subscriber.fill(*peer, &mut self.peers);
                    self.missed += subscriber.drop_oldest();
                }
            }
        }
    }

    /// Keeps the newest state of a topic for late subscribers.
    fn keep(&mut self, message: &PubMessage) {
        let topic = message.topic().to_vec();
        self.newest_held += message.held();
        if let Some(before) = self.newest.insert(topic, message.clone()) {
            self.newest_held -= before.held();
        }
        while self.newest_held > NEWEST
            && let Some((_, dropped)) = self.newest.pop_first()
        {
            self.newest_held -= dropped.held();
        }
    }

    /// Sends what waits, until the subscribers' connections are full.
    fn pump(&mut self) {
        loop {
            // First: a connection that can take bytes again does not say so a second time.
            self.peers.flush();
            let mut moved = false;
            for (peer, subscriber) in &mut self.subscribers {
                moved |= subscriber.fill(*peer, &mut self.peers);
                // It has caught up: a state that it missed is still the newest one.
                if subscriber.queue.is_empty() && subscriber.has_dropped() {
                    let access = self.access.read();
                    for topic in subscriber.take_dropped() {
                        if let Some(message) = self.newest.get(&topic) {
                            subscriber.push_newest(message, &access);
                        }
                    }
                    moved |= !subscriber.queue.is_empty();
                }
            }
            if !moved {
                return;
            }
        }
    }
}
