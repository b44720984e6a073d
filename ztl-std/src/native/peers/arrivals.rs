//! Accepts connections, and makes room for them.

use std::collections::VecDeque;
use std::io;
use std::net::IpAddr;
use std::time::Duration;

use mio::Token;
use tracing::{debug, warn};
use ztl_core::Instant;
use ztl_zmtp::session::{Inbound, Outbound};

use super::peer::{Peer, Served};
use super::{CHECK, Peers};
use crate::log_targets::TASKS;
use crate::native::streams::Stream;

/// How many connections are accepted at once.
const ACCEPTED: usize = 64;
/// How long no connection is accepted after the system had no file for one.
const PAUSE: Duration = Duration::from_millis(100);
/// How long a connection has for its handshake at least, also when others wait to connect.
const GRACE: Duration = Duration::from_millis(20);

/// Whether another connection can be added.
enum Room {
    Now,
    /// Not before this time.
    At(Instant),
    /// All places are taken by those that have finished the handshake.
    Never,
}

impl<S: Served> Peers<S> {
    pub(super) fn accept(&mut self, now: Instant) {
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

    pub(super) fn forget_stranger(&mut self, address: IpAddr) {
        self.strangers -= 1;
        if let Some(count) = self.strangers_of.get_mut(&address) {
            *count -= 1;
            if *count == 0 {
                self.strangers_of.remove(&address);
            }
        }
    }
}
