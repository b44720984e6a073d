//! Accepts connections, and makes room for them.

use std::cell::Cell;
use std::collections::{HashMap, VecDeque};
use std::io::{self, Read as _};
use std::net::IpAddr;
use std::time::Duration;

use mio::Token;
use tracing::{debug, warn};
use ztl_core::Instant;
use ztl_zmtp::session::{Inbound, Outbound, Security};

use super::peer::{Peer, PeerId, Served};
use super::places::Room;
use super::{CHECK, Peers};
use crate::log_targets::TASKS;
use crate::native::sockets::Stream;

/// What a round spends on new connections, so that known clients do not wait for many; and what one costs, open or closed
/// again.
const SPENT: u32 = 64;
const OPEN: u32 = 8;
const GONE: u32 = 1;
/// How long no connection is accepted for each that was turned away.
const CROWDED: Duration = Duration::from_micros(625);
/// How long no connection is accepted after the system had no file for one.
const PAUSE: Duration = Duration::from_millis(100);

impl<S: Served> Peers<S> {
    /// Accepts connections. While some are turned away, others wait in the system's queue, so that those that come again at
    /// once neither keep the server busy nor have a better chance.
    pub(super) fn accept(&mut self, now: Instant) {
        self.accept_again = None;
        let mut pause = Duration::ZERO;
        let mut left = SPENT;
        while left > 0 {
            let (mut stream, address) = match self.listener.accept() {
                Ok(accepted) => accepted,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.accept_again = (!pause.is_zero()).then(|| now + pause);
                    return;
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                // A connection that is gone already, or no file for one.
                Err(error) => {
                    debug!(target: TASKS, "a connection was not accepted: {error}");
                    self.accept_again = Some(now + PAUSE);
                    return;
                }
            };
            let slots = &self.slots;
            let has_unread = |id: PeerId| {
                let peer = slots.get(id.slot).and_then(Option::as_ref);
                peer.is_some_and(|peer| peer.is_ready)
            };
            let is_open = matches!(self.rules.security, Security::Null) && !S::SUBSCRIBED;
            let found_none = Cell::new(false);
            let idle = || {
                let looks = is_open && self.next_idle <= now;
                let idle = looks.then(|| idlest(slots, now, self.rules.idle, address));
                found_none.set(idle == Some(None));
                idle.flatten()
            };
            let room = self.places.room(now, address, has_unread, idle);
            if found_none.get() {
                self.next_idle = now + CHECK;
            }
            match room {
                Room::Free => {}
                Room::InsteadOf(id) => self.close(id.slot, Some("others wait to connect")),
                Room::None if is_gone(&mut stream, &mut self.piece) => {
                    left = left.saturating_sub(GONE);
                    continue;
                }
                Room::None => {
                    pause += CROWDED;
                    left = left.saturating_sub(OPEN);
                    let most = self.rules.connections;
                    if self.lines.take(now) {
                        warn!(target: TASKS, "The connection of {address} is rejected: of {most} places, none is free for it.");
                    }
                    continue;
                }
            }
            left = left.saturating_sub(OPEN);
            if let Err(error) = self.add(now, stream, address) {
                debug!(target: TASKS, "a connection was not accepted: {error}");
            }
        }
        // The next ones after those that are connected.
        self.accept_again = Some(now + pause);
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
        self.next_number += 1;
        let peer = Peer {
            stream,
            address,
            key: None,
            number: self.next_number,
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
            heard: now,
            unanswered: 0,
            has_asked: false,
            took: now,
        };
        self.unsent.push(slot);
        match self.slots.get_mut(slot) {
            Some(empty) => *empty = Some(peer),
            None => self.slots.push(Some(peer)),
        }
        let id = PeerId {
            slot,
            number: self.next_number,
        };
        self.places.add(now, id, address);
        self.next_check.get_or_insert(now + CHECK);
        Ok(())
    }
}

/// The connection that makes room on a server without keys, where everybody finishes the handshake: an idle one of the
/// addresses with the most connections, but of no other address with fewer than the newcomer's. One that never asked
/// anything goes first, then the one that was silent for longest.
fn idlest<S: Served>(
    slots: &[Option<Peer<S>>],
    now: Instant,
    time: Duration,
    newcomer: IpAddr,
) -> Option<PeerId> {
    let known = || {
        let all = slots.iter().enumerate();
        let all = all.filter_map(|(slot, peer)| Some((slot, peer.as_ref()?)));
        all.filter(|(_, peer)| peer.inbound.is_ready())
    };
    let mut counts: HashMap<IpAddr, usize> = HashMap::new();
    for (_, peer) in known() {
        *counts.entry(peer.address).or_default() += 1;
    }
    let largest = counts.values().copied().max()?;
    let count = |of: IpAddr| counts.get(&of).copied().unwrap_or(0);
    let own = count(newcomer);
    let pays = |of: IpAddr| of == newcomer || count(of) > own;
    let makes_room = |(_, peer): &(usize, &Peer<S>)| {
        peer.is_idle(now, time) && 2 * count(peer.address) >= largest && pays(peer.address)
    };
    let idle = known().filter(makes_room);
    let idle = idle.min_by_key(|(_, peer)| (peer.has_asked, peer.heard));
    idle.map(|(slot, peer)| peer.id(slot))
}

/// Whether the other end has closed a connection that gets no place. Reads what it sent.
fn is_gone(stream: &mut Stream, piece: &mut [u8]) -> bool {
    // The end may follow the first bytes.
    for _ in 0..2 {
        match stream.read(piece) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) => return error.kind() != io::ErrorKind::WouldBlock,
        }
    }
    false
}
