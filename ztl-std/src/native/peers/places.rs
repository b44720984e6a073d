//! Decides which connections a server keeps: a policy without I/O. `docs/zmtp.md` has the rules in [6.5].
//!
//! A client that has finished the handshake keeps its place, except an idle one on a server without keys. The others are
//! *strangers*. They share the free places, and have a small part of all places in any case. If these are taken, a newcomer
//! replaces another stranger or is closed. A crowd of strangers can come from the address of an honest client and can send what
//! it sends, but nobody can finish the handshake faster than the network allows. Three rules follow:
//!
//! 1. *The addresses with the most strangers make room.* If the newcomer's address has half of the places, one of its own
//!    strangers is replaced. Otherwise it is one of an address with at least half as many strangers as the largest address. So a
//!    crowd from a few addresses never takes the only place of another address.
//! 2. *There, a stranger that takes longer than [`Patience::most`] for a step is replaced first; if there is none, the older
//!    half stays.* Without this rule, a slow client would never finish beside a crowd that comes fast enough. With it, the
//!    client's chance falls only in proportion to the crowd.
//! 3. *In the younger half, the youngest stranger at the most frequent step is replaced*, after [`Patience::least`], unless it is
//!    alone there. So strangers that send nothing never displace one that greets, those that only greet never displace one that
//!    has opened a handshake, and those that open a handshake at once never displace one that is not so far yet.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use ztl_core::Instant;
use ztl_zmtp::session::Stage;

use super::peer::PeerId;

/// How long a stranger keeps its place while others wait.
struct Patience {
    /// At least this long after it came.
    least: Duration,
    /// At most this long at one stage.
    most: Duration,
}

/// Before the first bytes. They need no round trip, but proxies can delay them.
const SILENT: Patience = Patience {
    least: Duration::from_millis(5),
    most: Duration::from_millis(100),
};

/// After the first bytes, when a stage takes one round trip at most. Clients nearby finish their handshake within `least`.
const TALKING: Patience = Patience {
    least: Duration::from_millis(20),
    most: Duration::from_millis(200),
};

/// Most strangers. Each can take some processor time, and the last one waits for all of them.
const HANDSHAKES: usize = 512;

/// The places of a server's connections.
#[derive(Debug)]
pub(super) struct Places {
    connections: usize,
    /// How many have finished the handshake.
    known: usize,
    /// How many have not.
    strangers: usize,
    /// The same by address, the oldest first.
    by_address: BTreeMap<IpAddr, BTreeMap<u64, Stranger>>,
}

#[derive(Debug, Clone, Copy)]
struct Stranger {
    id: PeerId,
    stage: Stage,
    came: Instant,
    /// When it reached its stage.
    advanced: Instant,
}

impl Stranger {
    const fn patience(&self) -> Patience {
        match self.stage {
            Stage::Silent => SILENT,
            Stage::Greeted | Stage::Opened => TALKING,
        }
    }
}

/// Whether a newcomer gets a place.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Room {
    Free,
    /// If this one is closed.
    InsteadOf(PeerId),
    None,
}

impl Places {
    /// So many places.
    pub(super) fn new(connections: usize) -> Self {
        Self {
            connections,
            known: 0,
            strangers: 0,
            by_address: BTreeMap::new(),
        }
    }

    /// Whether a newcomer from this address gets a place. A stranger that `has_unread` bytes stays, because it may be further
    /// than its stage says. If all places are taken, `idle` finds a client that has finished the handshake and may be closed.
    pub(super) fn room(
        &self,
        now: Instant,
        address: IpAddr,
        has_unread: impl Fn(PeerId) -> bool,
        idle: impl FnOnce() -> Option<PeerId>,
    ) -> Room {
        let most = self.most_strangers();
        let own = self.by_address.get(&address).map_or(0, BTreeMap::len);
        let has_share = own >= most / 2;
        let is_full = self.strangers >= most || self.known + self.strangers >= self.connections;
        if !has_share && !is_full {
            return Room::Free;
        }
        if !has_share
            && self.strangers < most
            && let Some(idle) = idle()
        {
            return Room::InsteadOf(idle);
        }
        let counts = self.by_address.values().map(BTreeMap::len);
        let largest = counts.max().unwrap_or(0);
        let pays = |of: &IpAddr, count| match has_share {
            true => *of == address,
            false => 2 * count >= largest,
        };
        let paying = self.by_address.iter();
        let paying = paying.filter(|(of, all)| pays(of, all.len()));
        let paying = paying.map(|(_, all)| all.values());
        // Each address has its oldest first, so that a large crowd costs little time.
        let is_stuck =
            |one: &&Stranger| one.advanced + one.patience().most <= now && !has_unread(one.id);
        let stuck = paying.clone().filter_map(|mut all| all.find(is_stuck));
        if let Some(oldest) = stuck.min_by_key(|one| one.id.number) {
            return Room::InsteadOf(oldest.id);
        }
        let mut numbers: Vec<u64> = paying.clone().flatten().map(|one| one.id.number).collect();
        let half = numbers.len() / 2;
        let Some((_, &mut half, _)) =
            (half < numbers.len()).then(|| numbers.select_nth_unstable(half))
        else {
            return Room::None;
        };
        let is_young =
            |one: &&Stranger| one.id.number >= half && one.came + one.patience().least <= now;
        let young = paying.flatten().filter(is_young);
        // The earliest of those where as many are.
        let stages = [Stage::Opened, Stage::Greeted, Stage::Silent];
        let mut crowds = stages.map(|stage| (0, stage));
        for one in young.clone() {
            for (count, stage) in &mut crowds {
                *count += usize::from(*stage == one.stage);
            }
        }
        let crowded = crowds.into_iter().max_by_key(|(count, _)| *count);
        let crowded = crowded.filter(|(count, _)| *count > 1);
        let crowded = crowded.map(|(_, stage)| stage);
        let makes_room = |one: &&Stranger| Some(one.stage) == crowded && !has_unread(one.id);
        let youngest = young.filter(makes_room).max_by_key(|one| one.id.number);
        youngest.map_or(Room::None, |one| Room::InsteadOf(one.id))
    }

    /// A stranger has come.
    pub(super) fn add(&mut self, now: Instant, id: PeerId, address: IpAddr) {
        let stranger = Stranger {
            id,
            stage: Stage::Silent,
            came: now,
            advanced: now,
        };
        self.strangers += 1;
        let all = self.by_address.entry(address).or_default();
        all.insert(id.number, stranger);
    }

    /// A stranger is at this stage of its handshake.
    pub(super) fn advance(&mut self, now: Instant, id: PeerId, address: IpAddr, stage: Stage) {
        let all = self.by_address.get_mut(&address);
        let stranger = all.and_then(|all| all.get_mut(&id.number));
        if let Some(stranger) = stranger.filter(|stranger| stranger.stage != stage) {
            stranger.stage = stage;
            stranger.advanced = now;
        }
    }

    /// A stranger has finished its handshake.
    pub(super) fn admit(&mut self, id: PeerId, address: IpAddr) {
        self.remove_stranger(id, address);
        self.known += 1;
    }

    /// A stranger is gone.
    pub(super) fn remove_stranger(&mut self, id: PeerId, address: IpAddr) {
        let Some(all) = self.by_address.get_mut(&address) else {
            return;
        };
        if all.remove(&id.number).is_some() {
            self.strangers -= 1;
        }
        if all.is_empty() {
            self.by_address.remove(&address);
        }
    }

    /// A client that had finished its handshake is gone.
    pub(super) fn remove_known(&mut self) {
        self.known -= 1;
    }

    /// How many strangers there may be.
    fn most_strangers(&self) -> usize {
        let free = self.connections.saturating_sub(self.known);
        free.max(self.connections / 5).clamp(4, HANDSHAKES)
    }
}

#[cfg(test)]
mod tests;
