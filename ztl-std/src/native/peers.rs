//! A server's connections without libzmq: sessions of [`ztl_zmtp`] on non-blocking sockets, one thread.
//!
//! - Nobody is waited for: each peer has a turn, in which at most [`PIECE`] bytes are read.
//! - An answer is never dropped. A peer that does not read what it asked for is not read from, and is closed when it
//!   stays so.
//! - All buffers together have a limit. At the limit, the peer that holds the most is closed.
//! - Peers that have not finished the handshake, *strangers*, never displace those that have, and are served after them. On a
//!   server without keys, where everybody finishes it, one that has been idle for long makes room.

mod arrivals;
mod peer;
mod places;
mod ready;
mod turns;

use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::net::IpAddr;
#[cfg(feature = "publish")]
use std::sync::Arc;
use std::time::Duration;

use mio::{Events, Interest, Poll, Token};
use tracing::warn;
use ztl_core::Instant;
use ztl_zmtp::session::Security;

pub(super) use self::peer::UNSENT;
pub(crate) use self::peer::{Incoming, PeerId};
use self::peer::{Peer, Served};
use self::places::Places;
use self::ready::Ready;
use super::sockets::{Endpoint, Listener};
use crate::log_targets::TASKS;
use crate::rate_limit::RateLimit;
use crate::time::now;

/// Bytes read at once.
const PIECE: usize = 64 * 1024;
/// How long a peer may leave answers unread.
const UNREAD: Duration = Duration::from_secs(10);
/// How often deadlines are checked, while there are any.
const CHECK: Duration = Duration::from_millis(250);
/// At most so many lines are logged at once, and then one in this time.
const LINES: (u32, Duration) = (10, Duration::from_secs(10));

const LISTENER: Token = Token(usize::MAX);
const WAKER: Token = Token(usize::MAX - 1);

/// What applies to every connection.
pub(crate) struct Rules {
    pub(crate) security: Security,
    /// Longest message in bytes.
    pub(crate) message: usize,
    /// Most connections; [`Places`] says who gets them.
    pub(crate) connections: usize,
    /// Longest time for the handshake.
    pub(crate) handshake: Duration,
    /// After this time, an idle connection of a server without keys makes room for a new one, if none is free.
    pub(crate) idle: Duration,
    /// Bytes of all buffers together.
    pub(crate) memory: usize,
}

/// The connections of a server, as a socket of type `S`.
pub(crate) struct Peers<S> {
    poll: Poll,
    events: Events,
    listener: Listener,
    rules: Rules,
    slots: Vec<Option<Peer<S>>>,
    free: Vec<usize>,
    places: Places,
    next_number: u64,
    ready: Ready,
    /// Peers with something to send.
    unsent: Vec<usize>,
    piece: Box<[u8]>,
    /// Messages that were read together.
    messages: VecDeque<Incoming>,
    /// Bytes that all buffers take.
    held: usize,
    next_check: Option<Instant>,
    accept_again: Option<Instant>,
    /// When to look for an idle connection again, which takes some time where there are many.
    next_idle: Instant,
    lines: RateLimit,
}

impl<S: Served> Peers<S> {
    /// Listens there.
    pub(crate) fn bind(endpoint: &Endpoint, rules: Rules) -> io::Result<Self> {
        let poll = Poll::new()?;
        let mut listener = Listener::bind(endpoint)?;
        poll.registry()
            .register(listener.source(), LISTENER, Interest::READABLE)?;
        let places = Places::new(rules.connections);
        Ok(Self {
            poll,
            events: Events::with_capacity(1024),
            listener,
            rules,
            slots: Vec::new(),
            free: Vec::new(),
            places,
            next_number: 0,
            ready: Ready::default(),
            unsent: Vec::new(),
            piece: vec![0; PIECE].into_boxed_slice(),
            messages: VecDeque::new(),
            held: 0,
            next_check: None,
            accept_again: None,
            next_idle: Instant::ZERO,
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
                            self.ready.push(slot, peer.inbound.is_ready());
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
        // A pause is kept also if more connect.
        let is_due = self.accept_again.map_or(accept, |at| at <= now);
        if is_due {
            self.accept(now);
        }
        if self.next_check.is_some_and(|at| at <= now) {
            self.check(now);
        }
        self.ready.begin_round();
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
            let slot = self.ready.next()?;
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
        peer.unanswered = peer.unanswered.saturating_sub(1);
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

    /// Sends a message that others get, too: its frames as they are on the wire. It goes with the next
    /// [`flush`](Self::flush).
    #[cfg(feature = "publish")]
    pub(super) fn put_shared(&mut self, to: PeerId, message: &Arc<Vec<u8>>) {
        let Some(Some(peer)) = self.slots.get_mut(to.slot) else {
            return;
        };
        if peer.number != to.number {
            return;
        }
        peer.out.shared(message);
        if !peer.is_unsent {
            peer.is_unsent = true;
            self.unsent.push(to.slot);
        }
        self.count(to.slot);
    }

    /// How many bytes wait to be sent to a peer; `None` if it is gone.
    #[cfg(feature = "publish")]
    pub(super) fn waiting(&self, peer: PeerId) -> Option<usize> {
        let found = self.slots.get(peer.slot).and_then(Option::as_ref);
        let found = found.filter(|found| found.number == peer.number);
        found.map(|found| found.out.waiting())
    }

    /// Sends what can be sent without waiting.
    pub(super) fn flush(&mut self) {
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
                self.ready.push(slot, peer.inbound.is_ready());
            }
            self.count(slot);
        }
    }

    /// Closes peers that have been silent for too long, or that do not read. The next [`flush`](Self::flush) tries those
    /// that read slowly.
    fn check(&mut self, now: Instant) {
        self.next_check = None;
        for slot in 0..self.slots.len() {
            let Some(Some(peer)) = self.slots.get_mut(slot) else {
                continue;
            };
            // What subscribers do not read takes no more memory.
            let unread = peer.out.waiting() >= UNSENT && !S::SUBSCRIBED || peer.is_leaving;
            // A subscriber with too many unread messages is not read from, and so not heard.
            let is_full = S::SUBSCRIBED && peer.out.waiting() >= UNSENT;
            let deadline = match is_full {
                true => Instant::NEVER,
                false => peer.inbound.deadline(),
            };
            let why = match unread {
                true if now.since(peer.took) >= UNREAD => Some("it does not read its answers"),
                _ if deadline <= now => Some("it was silent for too long"),
                _ => None,
            };
            if why.is_some() {
                self.close(slot, why);
                continue;
            }
            if unread || deadline != Instant::NEVER {
                self.next_check = Some(now + CHECK);
            }
            // The system tells of room only when a third of its buffer is free: too late for who reads slowly.
            if unread && !peer.is_unsent {
                peer.is_unsent = true;
                self.unsent.push(slot);
            }
        }
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
            true => self.places.remove_known(),
            false => self.places.remove_stranger(peer.id(slot), peer.address),
        }
    }
}

#[cfg(test)]
mod tests;
