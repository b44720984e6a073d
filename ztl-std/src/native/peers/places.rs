//! Who has a place: a policy without I/O.
//!
//! Clients that have finished the handshake keep their place, unless they are idle where nobody needs a key. The others, *strangers*, share what is left, and a small part
//! in any case. When it is full, a newcomer takes the place of another stranger, or is turned away. A crowd of strangers may
//! come from the address of an honest client, and may send what an honest client sends, but nobody can finish the handshake
//! faster than the network allows. So:
//!
//! 1. *The addresses with the most strangers pay.* A newcomer takes a place of its own address if that has half of all
//!    places, else of an address that has at least half as many strangers as the one that has most. So a crowd from a few
//!    addresses never costs another address its only place.
//! 2. *Of those that pay, who takes longer than [`Patience::most`] for a step of the handshake makes room first; else the
//!    older half stay.* Without this, a slow client would never finish beside a crowd that comes fast enough. With it, its
//!    chance falls only in proportion to the crowd.
//! 3. *Of the younger half, after [`Patience::least`], those make room that are at the step where most are*, the youngest
//!    first, but not the last one there. So strangers that send nothing displace each other, and nobody who greets; those that
//!    only greet, nobody who opened a handshake; and those that open a handshake at once, nobody who has not come so far yet.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use ztl_core::Instant;
use ztl_zmtp::session::Stage;

use super::peer::PeerId;

/// How long a stranger keeps its place, if others wait.
struct Patience {
    /// At least so long after it came.
    least: Duration,
    /// At most so long at its stage.
    most: Duration,
}

/// Until the first bytes, which take no round trip; but what stands between client and server may delay them.
const SILENT: Patience = Patience {
    least: Duration::from_millis(5),
    most: Duration::from_millis(100),
};

/// Then a stage takes a round trip at most. Clients nearby finish their handshake in the least time.
const TALKING: Patience = Patience {
    least: Duration::from_millis(20),
    most: Duration::from_millis(200),
};

/// Most strangers. Each may take a moment of the processor, and who comes last waits for all of them.
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

    /// Whether a newcomer of this address gets a place. Who `has_unread` bytes stays: it may be further than its stage says.
    /// `idle` finds one that has finished the handshake and may be closed, if all places are taken.
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

    /// One that had finished its handshake is gone.
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
