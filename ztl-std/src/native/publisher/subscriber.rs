//! One subscriber of a publisher.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::Bound;

use ztl_zmtp::Pub;

use super::message::{ENTRY, PubMessage, Unheard};
use crate::keys::PublicKey;
use crate::native::peers::{PeerId, Peers, UNSENT};
use crate::server::Access;

/// Bytes of messages that wait for one subscriber. Above, the oldest one is dropped.
pub(super) const BEHIND: usize = 8 << 20;
/// Bytes of the subscriptions of one subscriber. Further ones are ignored.
const TOPICS: usize = 64 * 1024;

/// Bytes of the topics whose newest state a subscriber has missed, and gets when it has caught up.
const DROPPED: usize = 1 << 20;

/// Topics below this one are only for those who subscribe to them by name (`docs/streams.md`).
const RESERVED: &[u8] = b"$ztl/";
/// Tells a subscriber how many messages it has missed.
pub(crate) const MISSED: &str = "$ztl/missed";
/// Tells a subscriber that the next message is a state.
pub(crate) const STATE: &str = "$ztl/state";
/// Before a topic, a line feed and how others begin: the subscription to this topic does not bring those.
pub(crate) const EXCEPT: &str = "$ztl/except/";

/// Whether a subscriber's connection can take a message.
pub(super) fn has_room(peers: &Peers<Pub>, peer: PeerId, message: &PubMessage) -> bool {
    let fits = |waiting| waiting == 0 || waiting + message.wire.len() < UNSENT;
    peers.waiting(peer).is_some_and(fits)
}

/// What one subscriber wants, and what waits for it.
#[derive(Default)]
pub(super) struct Subscriber {
    pub(super) key: Option<PublicKey>,
    /// Its topics; each counts as often as it was subscribed to.
    topics: BTreeMap<Vec<u8>, usize>,
    /// Bytes that these take, roughly.
    pub(super) bytes: usize,
    /// Whether there was no room for a subscription. It may have limited the following ones.
    is_full: bool,
    pub(super) queue: VecDeque<PubMessage>,
    /// Bytes in `queue`.
    pub(super) held: usize,
    /// The number of the first one in `queue`, and the numbers of the states in it.
    first: u64,
    states: BTreeMap<Vec<u8>, u64>,
    /// Topics whose newest state was dropped, and the bytes that they take, roughly.
    dropped: BTreeSet<Vec<u8>>,
    dropped_bytes: usize,
    /// Messages that it missed; how many of them it was told.
    missed: u64,
    told: u64,
}

impl Subscriber {
    /// Begins or ends a subscription. Returns whether a topic is new. `has_room`: whether all subscribers leave room for it.
    pub(super) fn change(&mut self, begins: bool, topic: &[u8], has_room: bool) -> bool {
        if begins {
            self.is_full |= !has_room || self.bytes + topic.len() + ENTRY > TOPICS;
            if self.is_full {
                return false;
            }
            self.bytes += topic.len() + ENTRY;
            let count = self.topics.entry(topic.to_vec()).or_default();
            *count += 1;
            return *count == 1;
        }
        if let Some(count) = self.topics.get_mut(topic) {
            self.is_full = false;
            self.bytes -= topic.len() + ENTRY;
            *count -= 1;
            if *count == 0 {
                self.topics.remove(topic);
            }
        }
        false
    }

    /// Whether it wants a message, and may have it.
    pub(super) fn gets(&self, message: &PubMessage, access: &Access) -> bool {
        let may_hear = |scope: &[u8]| access.may_hear(self.key.as_ref(), scope);
        let may_hear = || may_hear(message.scope()) || message.wider().is_some_and(may_hear);
        self.wants(message.topic()) && (message.is_for_all || may_hear())
    }

    /// Its topics, except reserved ones.
    pub(super) fn topics(&self) -> impl Iterator<Item = &[u8]> {
        let topics = self.topics.keys().map(Vec::as_slice);
        topics.filter(|topic| !topic.starts_with(RESERVED))
    }

    /// Counts messages that it would have got.
    pub(super) fn miss(&mut self, unheard: &Unheard, access: &Access) {
        let root = format!("{}/", unheard.root).into_bytes();
        let root = root.as_slice();
        let meets = |topic: &[u8]| topic.starts_with(root) || root.starts_with(topic);
        let may_hear = |scope: &str| access.may_hear(self.key.as_ref(), scope.as_bytes());
        let mut scopes = unheard.scopes.iter();
        if self.topics().any(meets)
            && (may_hear(&unheard.root) || scopes.any(|scope| may_hear(scope)))
        {
            self.missed = self.missed.saturating_add(unheard.count);
        }
    }

    /// Adds the newest state of a topic, unless one waits.
    pub(super) fn push_newest(&mut self, message: &PubMessage, access: &Access) {
        if self.gets(message, access) && !self.has(message) {
            self.push(message.clone());
        }
    }

    /// Sends a message at once.
    pub(super) fn send(&self, peer: PeerId, message: &PubMessage, peers: &mut Peers<Pub>) {
        if message.is_state && self.wants(STATE.as_bytes()) {
            let told = PubMessage::new(STATE, "", b"\x80\x02\x88.", false);
            peers.put_shared(peer, &told.wire);
        }
        peers.put_shared(peer, &message.wire);
    }

    /// Whether a topic begins with one of its topics that has no exception for it. It has fewer beginnings than a subscriber may
    /// have topics.
    fn wants(&self, topic: &[u8]) -> bool {
        let shortest = if topic.starts_with(RESERVED) {
            RESERVED.len()
        } else {
            0
        };
        let begins = |length| {
            let begin = topic.get(..length);
            begin
                .is_some_and(|begin| self.topics.contains_key(begin) && !self.excepts(begin, topic))
        };
        (shortest..=topic.len()).any(begins)
    }

    /// Whether one of its topics does not bring another topic, which begins with it.
    fn excepts(&self, begin: &[u8], topic: &[u8]) -> bool {
        let root = [EXCEPT.as_bytes(), begin, b"\n"].concat();
        let from = (Bound::Included(root.as_slice()), Bound::Unbounded);
        let exceptions = self.topics.range::<[u8], _>(from);
        let exceptions = exceptions.map_while(|(known, _)| known.strip_prefix(root.as_slice()));
        { exceptions }.any(|exception| topic.starts_with(exception))
    }

    /// Whether a message of this topic waits.
    fn has(&self, message: &PubMessage) -> bool {
        self.states.contains_key(message.topic())
    }

    /// Adds a message at the end; a state takes the place of the one before it.
    pub(super) fn push(&mut self, message: PubMessage) {
        self.forget_dropped(&message);
        self.held += message.held();
        if message.is_state {
            let number = self.first + self.queue.len() as u64;
            let known = self.states.entry(message.topic().to_vec());
            let at = *known.or_insert(number);
            let index = usize::try_from(at - self.first).unwrap_or(usize::MAX);
            if let Some(before) = self.queue.get_mut(index) {
                self.held -= before.held();
                *before = message;
                return;
            }
        }
        self.queue.push_back(message);
    }

    fn pop(&mut self) -> Option<PubMessage> {
        let message = self.queue.pop_front()?;
        self.first += 1;
        self.held -= message.held();
        if message.is_state {
            self.states.remove(message.topic());
        }
        if self.queue.is_empty() {
            self.queue = VecDeque::new();
        }
        Some(message)
    }

    /// Drops the oldest messages above the limit, and returns how many. One always stays.
    pub(super) fn drop_oldest(&mut self) -> u64 {
        let before = self.missed;
        while self.held > BEHIND && self.queue.len() > 1 {
            let dropped = self.pop();
            self.missed = self.missed.saturating_add(1);
            if let Some(state) = dropped.filter(|message| message.is_state) {
                let topic = state.topic().to_vec();
                let bytes = topic.len() + ENTRY;
                if self.dropped_bytes + bytes <= DROPPED && self.dropped.insert(topic) {
                    self.dropped_bytes += bytes;
                }
            }
        }
        self.missed - before
    }

    /// Whether it needs a state again.
    pub(super) fn has_dropped(&self) -> bool {
        !self.dropped.is_empty()
    }

    /// The topics whose newest state it needs again.
    pub(super) fn take_dropped(&mut self) -> BTreeSet<Vec<u8>> {
        self.dropped_bytes = 0;
        std::mem::take(&mut self.dropped)
    }

    /// A newer state of a topic comes.
    pub(super) fn forget_dropped(&mut self, message: &PubMessage) {
        if message.is_state && self.dropped.remove(message.topic()) {
            self.dropped_bytes -= message.topic().len() + ENTRY;
        }
    }

    /// Passes on what its connection can take. Returns whether that was anything.
    pub(super) fn fill(&mut self, peer: PeerId, peers: &mut Peers<Pub>) -> bool {
        let mut moved = false;
        if self.missed > self.told && self.wants(MISSED.as_bytes()) {
            let told = PubMessage::new(MISSED, "", &pickled(self.missed), false);
            if has_room(peers, peer, &told) {
                peers.put_shared(peer, &told.wire);
                self.told = self.missed;
                // A message that has no room behind this one has some as soon as it is sent.
                moved = true;
            }
        }
        while let Some(next) = self.queue.front()
            && has_room(peers, peer, next)
        {
            self.send(peer, next, peers);
            self.pop();
            moved = true;
        }
        moved
    }
}

/// A count as a pickle: protocol 2, an integer of eight bytes and a sign.
fn pickled(count: u64) -> [u8; 14] {
    let mut pickle = *b"\x80\x02\x8a\x09\0\0\0\0\0\0\0\0\0.";
    for (to, from) in pickle.iter_mut().skip(4).zip(count.to_le_bytes()) {
        *to = from;
    }
    pickle
}
