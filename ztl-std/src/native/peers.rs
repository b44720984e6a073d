//! A server's connections without libzmq: sessions of [`ztl_zmtp`] on non-blocking sockets, one thread.
//!
//! - Nobody is waited for: each peer has a turn, in which at most [`PIECE`] bytes are read.
//! - An answer is never dropped. A peer that does not read what it asked for is not read from, and is closed when it
//!   stays so.
//! - All buffers together have a limit. At the limit, the peer that holds the most is closed.
//! - Peers that have not finished the handshake never displace those that have: there are places for both.

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, Read as _, Write as _};
use std::net::IpAddr;
use std::time::Duration;

use mio::{Events, Interest, Poll, Token};
use tracing::{debug, warn};
use ztl_core::Instant;
use ztl_zmtp::session::{Inbound, Message, Outbound, Security, Step};
use ztl_zmtp::{Fault, Pub, Router};

use super::streams::{Endpoint, Listener, Stream};
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::rate_limit::RateLimit;
use crate::time::now;

/// Bytes read at once.
const PIECE: usize = 64 * 1024;
/// Above so many unsent bytes, a peer is not read from.
pub(super) const UNSENT: usize = 256 * 1024;
/// How long a peer may leave answers unread.
const UNREAD: Duration = Duration::from_secs(10);
/// How often deadlines are checked, while there are any.
const CHECK: Duration = Duration::from_millis(250);
/// How many connections are accepted at once.
const ACCEPTED: usize = 64;
/// How long no connection is accepted after the system had no file for one.
const PAUSE: Duration = Duration::from_millis(100);
/// How long a connection has for its handshake at least, also when others wait to connect.
const GRACE: Duration = Duration::from_millis(20);
/// At most so many lines are logged at once, and then one in this time.
const LINES: (u32, Duration) = (10, Duration::from_secs(10));

/// The empty frame between the envelope and the content.
const DELIMITER: &[u8] = &[1, 0];

const LISTENER: Token = Token(usize::MAX);
const WAKER: Token = Token(usize::MAX - 1);

/// What applies to every connection.
pub(crate) struct Rules {
    pub(crate) security: Security,
    /// Longest message in bytes.
    pub(crate) message: usize,
    /// Most connections. Those that have not finished the handshake can have all places that are free, and a fifth of all
    /// at least.
    pub(crate) connections: usize,
    /// Longest time for the handshake.
    pub(crate) handshake: Duration,
    /// Bytes of all buffers together.
    pub(crate) memory: usize,
}

impl Rules {
    /// How many connections may be without a handshake, beside those with one.
    fn strangers(&self, known: usize) -> usize {
        let free = self.connections.saturating_sub(known);
        free.max(self.connections / 5).max(4)
    }
}

/// A socket type whose messages come from many peers.
pub(crate) trait Served: ztl_zmtp::Socket {
    /// Whether its peers subscribe.
    const SUBSCRIBED: bool;

    /// The frames before the delimiter, and the content if it is one frame. `None` without a delimiter.
    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)>;
}

impl Served for Router {
    const SUBSCRIBED: bool = false;

    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)> {
        message.split()
    }
}

impl Served for Pub {
    const SUBSCRIBED: bool = true;

    fn split(message: Message<'_>) -> Option<(&[u8], Option<&[u8]>)> {
        let mut frames = message.frames();
        let only = frames.next().filter(|_| frames.next().is_none());
        Some((b"", only))
    }
}

/// A connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(test, derive(Default))]
pub(crate) struct PeerId {
    slot: usize,
    /// Which of the connections that had this slot.
    number: u32,
}

/// A message.
pub(crate) struct Incoming {
    pub(crate) peer: PeerId,
    /// The frames that lead an answer back, as on the wire, with the delimiter; `None` if the message has no delimiter.
    pub(crate) envelope: Option<Box<[u8]>>,
    /// The only frame after the envelope; `None` if there are several.
    pub(crate) body: Option<Box<[u8]>>,
    pub(crate) from: IpAddr,
    /// The public key of the sender, if the connection is encrypted.
    pub(crate) key: Option<[u8; 32]>,
}

struct Peer<S> {
    stream: Stream,
    address: IpAddr,
    key: Option<[u8; 32]>,
    number: u32,
    /// When it was accepted.
    began: Instant,
    inbound: Inbound<S>,
    out: Outbound,
    /// Bytes that its buffers take, as counted.
    held: usize,
    /// Whether it is in `ready`, and in `unsent`.
    is_ready: bool,
    is_unsent: bool,
    /// The system may have bytes of it.
    readable: bool,
    /// The system has its end, perhaps after bytes.
    has_ended: bool,
    /// Its end was read; it is closed when all is sent.
    is_leaving: bool,
    /// Messages of it that wait until it has read its answers, and their bytes.
    later: VecDeque<Incoming>,
    later_held: usize,
    /// When it last took bytes, or began to have too many.
    took: Instant,
}

/// Whether another connection can be added.
enum Room {
    Now,
    /// Not before this time.
    At(Instant),
    /// All places are taken by those that have finished the handshake.
    Never,
}

/// The connections of a server, as a socket of type `S`.
pub(crate) struct Peers<S> {
    poll: Poll,
    events: Events,
    listener: Listener,
    rules: Rules,
    slots: Vec<Option<Peer<S>>>,
    free: Vec<usize>,
    /// How many have finished the handshake.
    known: usize,
    /// How many have not, in all and by address.
    strangers: usize,
    strangers_of: BTreeMap<IpAddr, usize>,
    next_number: u32,
    /// Those that had not finished the handshake when they came, the oldest first.
    arrivals: VecDeque<(usize, u32)>,
    /// Peers with something to read, in turns.
    ready: VecDeque<usize>,
    /// Turns until the next [`wait`](Self::wait), so that those that send only commands stop nobody.
    turns: usize,
    /// Peers with something to send.
    unsent: Vec<usize>,
    piece: Box<[u8]>,
    /// Messages that were read together.
    messages: VecDeque<Incoming>,
    /// Bytes that all buffers take.
    held: usize,
    next_check: Option<Instant>,
    accept_again: Option<Instant>,
    /// A connection that waits for room.
    accepted: Option<(Stream, IpAddr)>,
    lines: RateLimit,
}

impl<S: Served> Peers<S> {
    /// Listens there.
    pub(crate) fn bind(endpoint: &Endpoint, rules: Rules) -> io::Result<Self> {
        let poll = Poll::new()?;
        let mut listener = Listener::bind(endpoint)?;
        poll.registry()
            .register(listener.source(), LISTENER, Interest::READABLE)?;
        Ok(Self {
            poll,
            events: Events::with_capacity(1024),
            listener,
            rules,
            slots: Vec::new(),
            free: Vec::new(),
            known: 0,
            strangers: 0,
            strangers_of: BTreeMap::new(),
            next_number: 0,
            arrivals: VecDeque::new(),
            ready: VecDeque::new(),
            turns: 0,
            unsent: Vec::new(),
            piece: vec![0; PIECE].into_boxed_slice(),
            messages: VecDeque::new(),
            held: 0,
            next_check: None,
            accept_again: None,
            accepted: None,
            lines: RateLimit::new(LINES.0, LINES.1, now()),
        })
    }

    /// Where it listens, with the port that was chosen.
    pub(crate) fn endpoint(&self) -> io::Result<String> {
        self.listener.endpoint()
    }

    /// Wakes [`wait`](Self::wait) from another thread.
    pub(crate) fn waker(&self) -> io::Result<mio::Waker> {
        mio::Waker::new(self.poll.registry(), WAKER)
    }

    /// Sends what can be sent, and waits for something to read, at most for `longest`.
    pub(crate) fn wait(&mut self, longest: Option<Duration>) -> io::Result<()> {
        self.flush();
        let before = now();
        let due = [self.next_check, self.accept_again].into_iter().flatten();
        let due = due.map(|at| at.since(before)).min();
        let longest = match !self.ready.is_empty() || !self.messages.is_empty() {
            true => Some(Duration::ZERO),
            false => [longest, due].into_iter().flatten().min(),
        };
        match self.poll.poll(&mut self.events, longest) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Ok(()),
            done => done?,
        }
        let mut accept = false;
        for event in &self.events {
            match event.token() {
                LISTENER => accept = true,
                WAKER => {}
                Token(slot) => {
                    let Some(Some(peer)) = self.slots.get_mut(slot) else {
                        continue;
                    };
                    if event.is_readable() || event.is_read_closed() || event.is_error() {
                        peer.readable = true;
                        peer.has_ended |= event.is_read_closed();
                        if !peer.is_ready && peer.out.waiting() < UNSENT {
                            peer.is_ready = true;
                            self.ready.push_back(slot);
                        }
                    }
                    if event.is_writable() && peer.out.waiting() > 0 && !peer.is_unsent {
                        peer.is_unsent = true;
                        self.unsent.push(slot);
                    }
                }
            }
        }
        let now = now();
        if accept || self.accept_again.is_some_and(|at| at <= now) {
            self.accept(now);
        }
        if self.next_check.is_some_and(|at| at <= now) {
            self.check(now);
        }
        self.turns = self.ready.len();
        Ok(())
    }

    /// The next message. `admit` decides about a peer that has finished the handshake.
    pub(crate) fn next(
        &mut self,
        admit: &mut dyn FnMut(IpAddr, Option<[u8; 32]>) -> bool,
    ) -> Option<Incoming> {
        loop {
            while let Some(message) = self.messages.pop_front() {
                match self.slots.get_mut(message.peer.slot) {
                    // Short requests can have long answers.
                    Some(Some(peer)) if peer.number == message.peer.number && peer.is_full() => {
                        peer.later_held += message.held();
                        peer.later.push_back(message);
                    }
                    _ => return Some(message),
                }
            }
            self.turns = self.turns.checked_sub(1)?;
            let slot = self.ready.pop_front()?;
            self.turn(now(), slot, admit);
        }
    }

    /// Sends frames as they are on the wire, of which each announces another, then a last one. Drops the message if the
    /// peer is gone.
    pub(crate) fn send(&mut self, to: PeerId, envelope: &[u8], last: &[u8]) {
        let Some(Some(peer)) = self.slots.get_mut(to.slot) else {
            return;
        };
        if peer.number != to.number {
            return;
        }
        let before = peer.out.waiting();
        peer.out.message(envelope, last);
        // An answer that is alone goes at once; what cannot go, or fails, is left to `flush`.
        if before == 0
            && let Ok(count) = peer.stream.write(peer.out.transmit_buf())
        {
            peer.out.consume(count);
        }
        if before < UNSENT && peer.out.waiting() >= UNSENT {
            peer.took = now();
        }
        if peer.out.waiting() > 0 && !peer.is_unsent {
            peer.is_unsent = true;
            self.unsent.push(to.slot);
        }
        self.count(to.slot);
    }

    /// How many bytes wait to be sent to a peer; `None` if it is gone.
    #[cfg(feature = "gateway")]
    pub(super) fn waiting(&self, peer: PeerId) -> Option<usize> {
        let found = self.slots.get(peer.slot).and_then(Option::as_ref);
        let found = found.filter(|found| found.number == peer.number);
        found.map(|found| found.out.waiting())
    }

    /// Reads a piece of a peer's bytes, and makes messages of them.
    fn turn(
        &mut self,
        now: Instant,
        slot: usize,
        admit: &mut dyn FnMut(IpAddr, Option<[u8; 32]>) -> bool,
    ) {
        let Some(Some(peer)) = self.slots.get_mut(slot) else {
            return;
        };
        peer.is_ready = false;
        if peer.out.waiting() >= UNSENT {
            return;
        }
        if !peer.later.is_empty() {
            self.messages.append(&mut peer.later);
            peer.later_held = 0;
            if peer.readable {
                peer.is_ready = true;
                self.ready.push_back(slot);
            }
            return;
        }
        let read = match peer.stream.read(&mut self.piece) {
            // What it asked for before is sent first.
            Ok(0) if peer.out.waiting() > 0 => {
                peer.is_leaving = true;
                peer.readable = false;
                peer.took = now;
                self.next_check.get_or_insert(now + CHECK);
                return;
            }
            Ok(0) => return self.close(slot, None),
            Ok(count) => {
                // A short read has emptied the system's buffer. The next bytes are an event; the end may have been one.
                peer.readable = count == self.piece.len() || peer.has_ended;
                count
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                peer.readable = false;
                0
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => 0,
            Err(_) => return self.close(slot, None),
        };
        let mut bytes = self.piece.get(..read).unwrap_or_default();
        let mut is_known = false;
        let fault = loop {
            match peer.inbound.next(&mut bytes, &mut peer.out) {
                Ok(Step::Taken) => break None,
                Ok(Step::Asks) => {
                    let key = peer.inbound.peer_key();
                    if !admit(peer.address, key) {
                        return self.reject(slot, key);
                    }
                    peer.key = key;
                    peer.inbound.accept(&mut peer.out);
                    is_known = true;
                }
                Ok(Step::Message(message)) => {
                    let (envelope, body) = match S::split(message) {
                        Some((envelope, body)) => {
                            (Some([envelope, DELIMITER].concat().into()), body)
                        }
                        None => (None, None),
                    };
                    let body = body.map(Into::into);
                    self.messages.push_back(peer.incoming(slot, envelope, body));
                }
                Ok(Step::Subscription(begins, topic)) => {
                    if S::SUBSCRIBED {
                        let message = [&[u8::from(begins)], topic.as_slice()].concat();
                        let body = Some(message.into_boxed_slice());
                        self.messages.push_back(peer.incoming(slot, None, body));
                    }
                }
                Err(fault) => break Some(fault),
            }
        };
        if is_known {
            let address = peer.address;
            self.known += 1;
            self.forget_stranger(address);
        }
        if let Some(fault) = fault {
            return self.close(slot, Some(&self.told(fault)));
        }
        let Some(Some(peer)) = self.slots.get_mut(slot) else {
            return;
        };
        peer.inbound.on_heard(now);
        if peer.readable && peer.out.waiting() < UNSENT {
            peer.is_ready = true;
            self.ready.push_back(slot);
        }
        if peer.out.waiting() > 0 && !peer.is_unsent {
            peer.is_unsent = true;
            self.unsent.push(slot);
        }
        if peer.inbound.deadline() != Instant::NEVER {
            self.next_check.get_or_insert(now + CHECK);
        }
        self.count(slot);
    }

    /// A fault, for the log.
    fn told(&self, fault: Fault) -> String {
        match (fault, &self.rules.security) {
            (Fault::Mechanism, Security::Curve(_)) => {
                "it does not encrypt, and this server demands keys".to_owned()
            }
            (Fault::Mechanism, Security::Null) => {
                "it encrypts or has a password, and this server has no keys".to_owned()
            }
            (fault, _) => fault.to_string(),
        }
    }

    /// Sends what can be sent without waiting.
    fn flush(&mut self) {
        if self.unsent.is_empty() {
            return;
        }
        let now = now();
        while let Some(slot) = self.unsent.pop() {
            let Some(Some(peer)) = self.slots.get_mut(slot) else {
                continue;
            };
            peer.is_unsent = false;
            let mut failed = false;
            while peer.out.waiting() > 0 {
                match peer.stream.write(peer.out.transmit_buf()) {
                    Ok(count) => {
                        peer.out.consume(count);
                        peer.took = now;
                    }
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(_) => {
                        failed = true;
                        break;
                    }
                }
            }
            if failed || peer.is_leaving && peer.out.waiting() == 0 {
                self.close(slot, None);
                continue;
            }
            if peer.out.waiting() >= UNSENT {
                self.next_check.get_or_insert(now + CHECK);
            } else if (peer.readable || !peer.later.is_empty()) && !peer.is_ready {
                peer.is_ready = true;
                self.ready.push_back(slot);
            }
            self.count(slot);
        }
    }

    fn accept(&mut self, now: Instant) {
        self.accept_again = None;
        for _ in 0..ACCEPTED {
            let accepted = self
                .accepted
                .take()
                .map_or_else(|| self.listener.accept(), Ok);
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                // A connection that is gone already, or no file for one.
                Err(error) => {
                    debug!(target: TASKS, "a connection was not accepted: {error}");
                    self.accept_again = Some(now + PAUSE);
                    return;
                }
            };
            match self.make_room(now, address) {
                Room::Now => {}
                Room::At(at) => {
                    self.accepted = Some((stream, address));
                    self.accept_again = Some(at);
                    return;
                }
                Room::Never => {
                    let most = self.rules.connections;
                    if self.lines.take(now) {
                        warn!(target: TASKS, "The limit of {most} connections is reached; the one of {address} is rejected.");
                    }
                    continue;
                }
            }
            if let Err(error) = self.add(now, stream, address) {
                debug!(target: TASKS, "a connection was not accepted: {error}");
            }
        }
        // The next ones after those that are connected.
        self.accept_again = Some(now);
    }

    fn add(&mut self, now: Instant, mut stream: Stream, address: IpAddr) -> io::Result<()> {
        let slot = self.free.last().copied().unwrap_or(self.slots.len());
        stream.register(self.poll.registry(), Token(slot))?;
        self.free.pop();
        let mut out = Outbound::default();
        let inbound = Inbound::open(
            now + self.rules.handshake,
            self.rules.security.clone(),
            self.rules.message,
            &mut out,
        );
        self.next_number = self.next_number.wrapping_add(1);
        let peer = Peer {
            stream,
            address,
            key: None,
            number: self.next_number,
            began: now,
            inbound,
            out,
            held: 0,
            is_ready: false,
            is_unsent: true,
            readable: false,
            has_ended: false,
            is_leaving: false,
            later: VecDeque::new(),
            later_held: 0,
            took: now,
        };
        self.unsent.push(slot);
        match self.slots.get_mut(slot) {
            Some(empty) => *empty = Some(peer),
            None => self.slots.push(Some(peer)),
        }
        self.strangers += 1;
        *self.strangers_of.entry(address).or_default() += 1;
        self.arrivals.push_back((slot, self.next_number));
        if self.arrivals.len() > 2 * self.strangers + 64 {
            self.arrivals.retain(|(slot, number)| {
                let peer = self.slots.get(*slot).and_then(Option::as_ref);
                peer.is_some_and(|peer| peer.is_stranger(*number))
            });
        }
        self.next_check.get_or_insert(now + CHECK);
        Ok(())
    }

    /// Makes room for another connection, at the cost of the one that has taken longest for its handshake: of this
    /// address if it has half of the places, or of all. One whose bytes were not read yet, or that just came, stays: else
    /// whoever connects fastest would lock out all others.
    fn make_room(&mut self, now: Instant, address: IpAddr) -> Room {
        let most = self.rules.strangers(self.known);
        let of_address = self.strangers_of.get(&address).copied().unwrap_or(0);
        let of = match of_address >= most / 2 {
            true => Some(address),
            false
                if self.strangers < most
                    && self.known + self.strangers < self.rules.connections =>
            {
                return Room::Now;
            }
            false => None,
        };
        let mut room = Room::Never;
        for (slot, number) in &self.arrivals {
            let peer = self.slots.get(*slot).and_then(Option::as_ref);
            let Some(peer) = peer.filter(|peer| peer.is_stranger(*number)) else {
                continue;
            };
            if of.is_some_and(|address| peer.address != address) {
                continue;
            }
            if peer.is_ready {
                room = Room::At(now);
            } else if peer.began + GRACE > now {
                return match room {
                    Room::Never => Room::At(peer.began + GRACE),
                    room => room,
                };
            } else {
                let slot = *slot;
                self.close(slot, Some("others wait to connect"));
                return Room::Now;
            }
        }
        room
    }

    fn forget_stranger(&mut self, address: IpAddr) {
        self.strangers -= 1;
        if let Some(count) = self.strangers_of.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                self.strangers_of.remove(&address);
            }
        }
    }

    /// Closes peers that have been silent for too long, or that do not read.
    fn check(&mut self, now: Instant) {
        self.next_check = None;
        for slot in 0..self.slots.len() {
            let Some(Some(peer)) = self.slots.get(slot) else {
                continue;
            };
            let unread = peer.out.waiting() >= UNSENT || peer.is_leaving;
            let deadline = peer.inbound.deadline();
            let why = match unread {
                true if now.since(peer.took) >= UNREAD => Some("it does not read its answers"),
                _ if deadline <= now => Some("it was silent for too long"),
                _ => None,
            };
            if why.is_some() {
                self.close(slot, why);
            } else if unread || deadline != Instant::NEVER {
                self.next_check = Some(now + CHECK);
            }
        }
    }

    /// Closes the connection of a peer that is not allowed.
    fn reject(&mut self, slot: usize, key: Option<[u8; 32]>) {
        let address = self.slots.get(slot).and_then(Option::as_ref);
        if let Some(address) = address.map(|peer| peer.address)
            && self.lines.take(now())
        {
            let who = key.map_or_else(
                || "without a key".to_owned(),
                |key| format!("with the key {}", PublicKey::from_bytes(key)),
            );
            warn!(target: TASKS, "A client at {address} {who} is not allowed and was rejected.");
        }
        self.close(slot, None);
    }

    /// Counts the bytes that a peer's buffers take. If all take too many, closes who takes the most.
    fn count(&mut self, slot: usize) {
        let Some(Some(peer)) = self.slots.get_mut(slot) else {
            return;
        };
        // Strangers are bounded by their number.
        let held = match peer.inbound.is_ready() {
            true => peer.inbound.held() + peer.out.held() + peer.later_held,
            false => 0,
        };
        self.held = self.held + held - peer.held;
        peer.held = held;
        while self.held > self.rules.memory {
            let peers = self.slots.iter().enumerate();
            let held = peers.filter_map(|(slot, peer)| Some((peer.as_ref()?.held, slot)));
            let Some((_, slot)) = held.max() else {
                return;
            };
            self.close(
                slot,
                Some("all connections together hold too much, and it the most"),
            );
        }
    }

    fn close(&mut self, slot: usize, why: Option<&str>) {
        let Some(mut peer) = self.slots.get_mut(slot).and_then(Option::take) else {
            return;
        };
        if let Some(why) = why {
            if self.lines.take(now()) {
                warn!(target: TASKS, "The connection of {} is closed: {why}.", peer.address);
            }
            // Tells the peer, if it listens.
            let _ = peer.stream.write(peer.out.transmit_buf());
        }
        peer.stream.deregister(self.poll.registry());
        self.free.push(slot);
        self.held -= peer.held;
        match peer.inbound.is_ready() {
            true => self.known -= 1,
            false => self.forget_stranger(peer.address),
        }
    }
}

impl Incoming {
    /// Bytes that it takes, roughly.
    fn held(&self) -> usize {
        let part = |bytes: &Option<Box<[u8]>>| bytes.as_ref().map_or(0, |bytes| bytes.len() + 32);
        size_of::<Self>() + part(&self.envelope) + part(&self.body)
    }
}

impl<S: Served> Peer<S> {
    /// Whether it is the connection with this number, and has not finished its handshake.
    fn is_stranger(&self, number: u32) -> bool {
        self.number == number && !self.inbound.is_ready()
    }

    /// Whether it has to read answers before it is served again.
    fn is_full(&self) -> bool {
        self.out.waiting() >= UNSENT || !self.later.is_empty()
    }

    fn incoming(
        &self,
        slot: usize,
        envelope: Option<Box<[u8]>>,
        body: Option<Box<[u8]>>,
    ) -> Incoming {
        Incoming {
            peer: PeerId {
                slot,
                number: self.number,
            },
            envelope,
            body,
            from: self.address,
            key: self.key,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread::JoinHandle;

    use std::net::{SocketAddr, TcpStream};

    use ztl_zmtp::{Dealer, GREETING, HANDSHAKE, Socket as _};

    use super::*;

    const LIMIT: Option<Duration> = Some(Duration::from_secs(20));

    /// A server that answers each request with its body, but `hold` only together with the next other one.
    struct Echo {
        address: SocketAddr,
        stop: Arc<AtomicBool>,
        waker: mio::Waker,
        thread: Option<JoinHandle<usize>>,
    }

    impl Echo {
        fn new(rules: Rules) -> Self {
            let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
            let peers = Peers::<Router>::bind(&endpoint, rules).unwrap();
            let (endpoint, waker) = (peers.endpoint().unwrap(), peers.waker().unwrap());
            let address = endpoint.strip_prefix("tcp://").unwrap().parse().unwrap();
            let stop = Arc::new(AtomicBool::new(false));
            let stopped = Arc::clone(&stop);
            Self {
                address,
                stop,
                waker,
                thread: Some(std::thread::spawn(move || serve(peers, &stopped))),
            }
        }

        fn endpoint(&self) -> String {
            format!("tcp://{}", self.address)
        }

        /// Stops it; returns the most bytes that its buffers took.
        fn stop(&mut self) -> usize {
            self.stop.store(true, Ordering::SeqCst);
            self.waker.wake().unwrap();
            self.thread
                .take()
                .map_or(0, |thread| thread.join().unwrap())
        }
    }

    impl Drop for Echo {
        fn drop(&mut self) {
            self.stop();
        }
    }

    fn serve(mut peers: Peers<Router>, stop: &AtomicBool) -> usize {
        let mut most = 0;
        let mut held = Vec::new();
        while !stop.load(Ordering::SeqCst) {
            peers.wait(None).unwrap();
            while let Some(message) = peers.next(&mut |_, _| true) {
                let body = message.body.unwrap_or(Box::from(*b"several"));
                if body.starts_with(b"hold") {
                    held.push((message.peer, message.envelope.unwrap(), body));
                    continue;
                }
                for (peer, envelope, body) in held.drain(..) {
                    peers.send(peer, &envelope, &body);
                }
                peers.send(message.peer, &message.envelope.unwrap(), &body);
                most = most.max(peers.held);
            }
            most = most.max(peers.held);
        }
        most
    }

    fn rules() -> Rules {
        Rules {
            security: Security::Null,
            message: 1 << 20,
            connections: 50,
            handshake: HANDSHAKE,
            memory: 8 << 20,
        }
    }

    fn libzmq(context: &zmq::Context, endpoint: &str) -> zmq::Socket {
        let socket = context.socket(zmq::DEALER).unwrap();
        socket.set_linger(0).unwrap();
        socket.set_rcvtimeo(20_000).unwrap();
        socket.connect(endpoint).unwrap();
        socket
    }

    #[track_caller]
    fn is_served(socket: &zmq::Socket, body: &[u8]) {
        let frames = [&b"one"[..], b"", body];
        socket.send_multipart(frames, 0).unwrap();
        assert_eq!(socket.recv_multipart(0).unwrap(), frames);
    }

    /// A client that has shaken hands.
    fn raw(echo: &Echo) -> TcpStream {
        let mut stream = TcpStream::connect(echo.address).unwrap();
        stream.set_read_timeout(LIMIT).unwrap();
        stream.set_write_timeout(LIMIT).unwrap();
        stream.write_all(GREETING).unwrap();
        stream.write_all(Dealer::READY).unwrap();
        let mut heard = vec![0; GREETING.len() + Router::READY.len()];
        stream.read_exact(&mut heard).unwrap();
        stream
    }

    #[test]
    fn libzmqs_clients_get_messages_of_any_length() {
        let echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        for length in [0, 1, 255, 256, 100_000, 1_000_000] {
            is_served(&socket, &vec![7; length]);
        }
        let request = context.socket(zmq::REQ).unwrap();
        request.set_linger(0).unwrap();
        request.set_rcvtimeo(20_000).unwrap();
        request.connect(&echo.endpoint()).unwrap();
        request.send("hi", 0).unwrap();
        assert_eq!(request.recv_bytes(0).unwrap(), b"hi");
    }

    #[test]
    fn a_message_without_end_takes_little_memory_and_ends_its_connection() {
        let mut echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        is_served(&socket, b"before");
        let mut endless = raw(&echo);
        let frames = b"\x01\x01x".repeat(10_000);
        let mut sent = 0;
        while endless.write_all(&frames).is_ok() {
            sent += frames.len();
            assert!(sent < 64 << 20, "it is not ended");
        }
        is_served(&socket, b"after");
        let most = echo.stop();
        assert!(most < 8 << 20, "{most} bytes");
    }

    #[test]
    fn every_held_answer_arrives() {
        let echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        for number in 0..1000 {
            let body = format!("hold {number}");
            socket
                .send_multipart([&b"one"[..], b"", body.as_bytes()], 0)
                .unwrap();
        }
        socket
            .send_multipart([&b"one"[..], b"", b"now"], 0)
            .unwrap();
        for number in 0..1000 {
            let frames = socket.recv_multipart(0).unwrap();
            assert_eq!(frames[2], format!("hold {number}").as_bytes());
        }
        assert_eq!(socket.recv_multipart(0).unwrap()[2], b"now");
    }

    #[test]
    fn a_client_that_does_not_read_is_not_read_from_and_takes_no_more_than_its_share() {
        let mut echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        is_served(&socket, b"before");
        let mut deaf = raw(&echo);
        deaf.set_write_timeout(Some(Duration::from_millis(300)))
            .unwrap();
        // A request of 60,000 bytes, again and again, until it is not taken any more.
        let mut request = b"\x01\0\x02\0\0\0\0\0\0\xEA\x60".to_vec();
        request.extend([7; 60_000]);
        let mut sent = 0;
        while deaf.write_all(&request).is_ok() {
            sent += request.len();
            assert!(sent < 64 << 20, "it is read from without end");
        }
        is_served(&socket, b"after");
        let most = echo.stop();
        assert!(most < 4 << 20, "{most} bytes");
    }

    #[test]
    fn connections_that_never_shake_hands_displace_nobody_and_let_others_in() {
        let echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        is_served(&socket, b"before");
        let idle: Vec<_> = (0..200)
            .map(|_| TcpStream::connect(echo.address).unwrap())
            .collect();
        is_served(&socket, b"still");
        let other = libzmq(&context, &echo.endpoint());
        is_served(&other, b"in");
        drop(idle);
    }

    #[test]
    fn a_client_that_comes_after_a_long_time_has_time_to_shake_hands() {
        let echo = Echo::new(rules());
        std::thread::sleep(HANDSHAKE + Duration::from_millis(100));
        let context = zmq::Context::new();
        is_served(&libzmq(&context, &echo.endpoint()), b"late");
        let mut raw = raw(&echo);
        raw.write_all(b"\x01\0\0\x02hi").unwrap();
        let mut heard = [0; 6];
        raw.read_exact(&mut heard).unwrap();
        assert_eq!(&heard, b"\x01\0\0\x02hi");
    }

    #[test]
    fn a_connection_that_ends_right_after_its_bytes_is_closed() {
        let echo = Echo::new(rules());
        for (bytes, answer) in [(&b"\x01\0\0\x02hi"[..], 6), (b"\x01\0\0", 0)] {
            let mut stream = raw(&echo);
            stream.write_all(bytes).unwrap();
            stream.shutdown(std::net::Shutdown::Write).unwrap();
            let mut heard = Vec::new();
            stream.read_to_end(&mut heard).unwrap();
            assert_eq!(heard.len(), answer);
        }
    }

    #[test]
    fn commands_without_end_stop_nobody() {
        let echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        is_served(&socket, b"before");
        let served = AtomicBool::new(false);
        std::thread::scope(|scope| {
            for command in [
                &b"\x04\x06\x05HELLO"[..],
                b"\x04\0",
                b"\x04\x0A\x09SUBSCRIBE",
            ] {
                for _ in 0..2 {
                    let mut flood = raw(&echo);
                    let served = &served;
                    scope.spawn(move || {
                        let commands = command.repeat(20_000);
                        // Until the others were served, at most for 20 s.
                        let begin = std::time::Instant::now();
                        while !served.load(Ordering::SeqCst)
                            && begin.elapsed() < Duration::from_secs(20)
                        {
                            flood.write_all(&commands).unwrap();
                        }
                    });
                }
            }
            for _ in 0..20 {
                is_served(&socket, b"meanwhile");
            }
            is_served(&libzmq(&context, &echo.endpoint()), b"a new one");
            served.store(true, Ordering::SeqCst);
        });
    }

    #[test]
    fn a_client_that_has_ended_its_stream_gets_all_answers() {
        let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
        let mut peers = Peers::<Router>::bind(&endpoint, rules()).unwrap();
        let address: SocketAddr = peers.endpoint().unwrap()[6..].parse().unwrap();
        let mut client = TcpStream::connect(address).unwrap();
        client.write_all(GREETING).unwrap();
        client.write_all(Dealer::READY).unwrap();
        client.write_all(b"\x01\0\0\x02hi").unwrap();
        let request = loop {
            peers.wait(Some(Duration::from_secs(20))).unwrap();
            if let Some(request) = peers.next(&mut |_, _| true) {
                break request;
            }
        };
        // More than the system takes.
        let answer = vec![7; 100_000];
        let mut sent = GREETING.len() + Router::READY.len();
        while peers.waiting(request.peer).unwrap() < 50_000 {
            peers.send(request.peer, &request.envelope.clone().unwrap(), &answer);
            sent += 2 + 9 + answer.len();
            for _ in 0..10 {
                peers.wait(Some(Duration::from_millis(1))).unwrap();
            }
        }
        client.shutdown(std::net::Shutdown::Write).unwrap();
        let has_ended = |peers: &Peers<Router>| {
            let peer = peers.slots[request.peer.slot].as_ref();
            peer.is_none_or(|peer| peer.is_leaving)
        };
        while !has_ended(&peers) {
            peers.wait(Some(Duration::from_secs(20))).unwrap();
            assert!(peers.next(&mut |_, _| true).is_none());
        }
        let reading = std::thread::spawn(move || {
            let mut heard = Vec::new();
            client.read_to_end(&mut heard).unwrap();
            heard.len()
        });
        while peers.waiting(request.peer).is_some() {
            peers.wait(Some(Duration::from_secs(20))).unwrap();
            assert!(peers.next(&mut |_, _| true).is_none());
        }
        assert_eq!(reading.join().unwrap(), sent);
    }

    #[test]
    fn a_stream_that_is_not_zmtp_ends_and_harms_nobody() {
        let echo = Echo::new(rules());
        let context = zmq::Context::new();
        let socket = libzmq(&context, &echo.endpoint());
        for bytes in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[0xFF; 3000], &[0; 3000]] {
            let mut stream = TcpStream::connect(echo.address).unwrap();
            stream.set_read_timeout(LIMIT).unwrap();
            let _ = stream.write_all(bytes);
            let mut heard = Vec::new();
            // Closed, perhaps with a reset.
            let _ = stream.read_to_end(&mut heard);
            is_served(&socket, bytes);
        }
    }
}
