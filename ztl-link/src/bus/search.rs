//! Finds all nodes of a bus by their ids, without collisions in the end: where several answer at once, the next question
//! is for half of them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{ADDR_ALL, ADDR_MOST, ADDR_NONE, BusMessage, Turn};

use super::BusEvent;

/// A question waits at most this long for a moment at which it delays no node with a task too much.
const WAIT: Duration = Duration::from_secs(2);
/// A question without an answer is repeated this often.
const REPEATS: u8 = 2;
/// An address is left when so many polls in a row get no answer.
const POLLS: u8 = 3;
/// A search gives up after this many questions: 32 nodes need about a thousand on a bad line.
const QUESTIONS: u32 = 10_000;
/// And when it has found so many nodes, of which a line has at most 32: one of them answers for others, or it is noise.
const MOST: usize = 64;

/// A node that a search has found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Its unique id.
    pub id: u64,
    /// Its address; 0 if several nodes have this id, since the search cannot distinguish them.
    pub address: u8,
    /// Its name.
    pub name: String,
}

/// The addresses at which each id was found. One id at several addresses is in doubt: the node has moved, or there are
/// two nodes.
#[derive(Debug, Clone, Default)]
pub(super) struct Seen(BTreeMap<u64, BTreeSet<u8>>);

impl Seen {
    pub(super) fn hear(&mut self, id: u64, address: u8) {
        if address <= ADDR_MOST {
            self.0.entry(id).or_default().insert(address);
        }
    }

    fn is_doubled(&self, id: u64) -> bool {
        self.0.get(&id).is_some_and(|addresses| addresses.len() > 1)
    }

    /// Whether an id that was found at this address was found at another one, too.
    pub(super) fn doubts(&self, address: u8) -> bool {
        let mut all = self.0.values();
        all.any(|addresses| addresses.len() > 1 && addresses.contains(&address))
    }
}

/// What answers a poll.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Polled {
    Intact,
    Damaged,
    Silent,
}

#[derive(Debug, Clone)]
pub(super) struct Search {
    round: u8,
    /// When the last question was asked.
    asked: Instant,
    /// Whether there is no time for the next question.
    waiting: bool,
    /// Prefixes that are not finished, as bits and their number; the last one is asked next.
    prefixes: Vec<(u8, u64)>,
    /// How often the last question had no answer.
    silences: u8,
    /// How many answers were damaged.
    collisions: u32,
    questions: u32,
    /// A node that answered, and the address that it will have.
    answered: Option<Found>,
    /// Addresses of known nodes.
    taken: Vec<u8>,
    /// The addresses that the gateway has given, each with the id of the last node that took it.
    given: BTreeMap<u8, u64>,
    seen: Seen,
    /// The id and the address that the last question was about, if it was a poll, and the answers to such polls.
    polled: Option<(u64, u8)>,
    polls: Vec<Polled>,
    /// Addresses at which a node answers, with the ids that were polled there.
    there: BTreeSet<(u64, u8)>,
    /// Nodes that cannot have an address: they do not answer, or several have one id.
    given_up: Vec<u64>,
    found: Vec<Found>,
}

impl Search {
    pub(super) fn new(
        round: u8,
        taken: Vec<u8>,
        given: BTreeMap<u8, u64>,
        mut seen: Seen,
        now: Instant,
    ) -> Self {
        for addresses in seen.0.values_mut() {
            addresses.remove(&ADDR_NONE);
        }
        Self {
            seen,
            polled: None,
            polls: Vec::new(),
            there: BTreeSet::new(),
            round,
            asked: now,
            waiting: false,
            prefixes: vec![(0, 0)],
            silences: 0,
            collisions: 0,
            questions: 0,
            answered: None,
            taken,
            given,
            given_up: Vec::new(),
            found: Vec::new(),
        }
    }

    pub(super) const fn asked(&self) -> Instant {
        self.asked
    }

    pub(super) const fn set_waiting(&mut self, waiting: bool) {
        self.waiting = waiting;
    }

    /// When the next question may be asked.
    pub(super) fn ready(&self) -> Instant {
        if self.waiting {
            self.asked + WAIT
        } else {
            self.asked
        }
    }

    pub(super) fn has_ended(&self) -> bool {
        let all = self.doubt().is_none() && self.next_without().is_none();
        let all = all && self.prefixes.is_empty();
        all || self.questions >= QUESTIONS || self.found.len() >= MOST
    }

    /// Addresses that the gateway has given, in this search or before.
    pub(super) const fn given(&self) -> &BTreeMap<u8, u64> {
        &self.given
    }

    /// Where nodes were found.
    pub(super) const fn seen(&self) -> &Seen {
        &self.seen
    }

    /// A node has said its id and its address.
    pub(super) fn hear(&mut self, node: &Found) {
        self.seen.hear(node.id, node.address);
    }

    /// The next address to poll, with the id of a node that was found there and has now answered elsewhere or not at all.
    fn doubt(&self) -> Option<(u64, u8)> {
        if !self.prefixes.is_empty() {
            return None;
        }
        let has = |id: u64, address| {
            let mut found = self.found.iter();
            found.any(|node| (node.id, node.address) == (id, address))
        };
        let known = |id: u64| self.found.iter().any(|node| node.id == id);
        let all = self.seen.0.iter().flat_map(|(&id, addresses)| {
            let doubted = addresses.len() > 1 || known(id);
            let doubted = addresses.iter().filter(move |_| doubted);
            doubted.map(move |address| (id, *address))
        });
        let mut all = all.filter(|&(id, address)| {
            let open = address != ADDR_NONE && !has(id, address);
            open && !self.there.contains(&(id, address)) && !self.has_other(id, address)
        });
        all.next()
    }

    /// Whether another node was found at the address.
    fn has_other(&self, id: u64, address: u8) -> bool {
        let mut found = self.found.iter();
        found.any(|node| node.address == address && node.id != id)
    }

    /// The address that the last question was for, if it was a poll.
    pub(super) fn polled(&self) -> Option<u8> {
        self.polled.map(|(_, address)| address)
    }

    /// Handles what has answered this poll.
    pub(super) fn on_polled(&mut self, polled: Polled) {
        let Some((id, address)) = self.polled else {
            return;
        };
        self.polls.push(polled);
        if polled != Polled::Intact && self.polls.len() < usize::from(POLLS) {
            return;
        }
        if std::mem::take(&mut self.polls)
            .iter()
            .all(|polled| *polled == Polled::Silent)
        {
            self.seen.0.entry(id).or_default().remove(&address);
        } else {
            self.there.insert((id, address));
        }
    }

    /// Ends it: an id at several addresses is that of several nodes.
    pub(super) fn finish(&mut self) {
        let mut seen = std::mem::take(&mut self.seen);
        for (&id, addresses) in &mut seen.0 {
            let here = |address| {
                let mut found = self.found.iter();
                found.any(|node| (node.id, node.address) == (id, address))
            };
            // A node that has moved made room for another one.
            addresses.retain(|&address| here(address) || !self.has_other(id, address));
        }
        if seen.0.len() > MOST {
            seen.0
                .retain(|id, _| self.found.iter().any(|node| node.id == *id));
        }
        self.seen = seen;
    }

    pub(super) fn into_event(mut self) -> BusEvent {
        let unnamed = self.found.iter().filter(|node| node.name.is_empty());
        let unnamed: BTreeSet<u64> = unnamed.map(|node| node.id).collect();
        // Several nodes with one id collide at it only. Noise, or a node that sends all the time, collides at all ids.
        if unnamed.iter().any(|id| unnamed.contains(&(id ^ 1))) {
            self.found.retain(|node| !node.name.is_empty());
        }
        for &id in self.seen.0.keys() {
            if self.seen.is_doubled(id) {
                self.found.retain(|node| node.id != id);
                self.found.push(Found {
                    id,
                    address: ADDR_NONE,
                    name: String::new(),
                });
            }
        }
        match self.collisions > 0 && self.found.is_empty() {
            true => BusEvent::Noise,
            false => BusEvent::Found(self.found),
        }
    }

    /// The frame to send next.
    pub(super) fn question(&mut self, now: Instant) -> Vec<u8> {
        self.questions += 1;
        self.asked = now;
        let round = self.round;
        self.polled = self.doubt();
        if let Some((_, address)) = self.polled {
            return Turn::Poll.encode(address).to_vec();
        }
        let message = match (&self.answered, self.prefixes.last()) {
            (None, Some(&(bits, prefix))) => BusMessage::Search {
                round,
                bits,
                prefix,
            },
            // This node no longer answers, so the same question finds the next one.
            (Some(node), _) => BusMessage::Assign {
                round,
                id: node.id,
                address: ADDR_NONE,
            },
            (None, None) => {
                let (id, address) = self.next_without().unwrap_or_default();
                BusMessage::Assign { round, id, address }
            }
        };
        let mut buffer = [0; 32];
        let len = message.encode(ADDR_ALL, &mut buffer);
        len.and_then(|len| buffer.get(..len))
            .unwrap_or_default()
            .to_vec()
    }

    /// The next node that gets an address, and a free one. Only when all nodes are known: one may have it already.
    fn next_without(&self) -> Option<(u64, u8)> {
        let has = |address| self.found.iter().any(|node| node.address == address);
        // A node with a switch may be off now. Most switches are set to low addresses.
        let free = (1..=ADDR_MOST)
            .rev()
            .find(|address| !self.taken.contains(address) && !has(*address));
        let mut without = self.found.iter().filter(|node| {
            let needs = node.address == ADDR_NONE || self.gives_way(node);
            needs && !self.given_up.contains(&node.id) && !self.seen.is_doubled(node.id)
        });
        without.next().map(|node| node.id).zip(free)
    }

    /// Whether the gateway has given the node its address, and another node has this address too.
    fn gives_way(&self, node: &Found) -> bool {
        let other = |other: &Found| other.id != node.id && other.address == node.address;
        self.given.get(&node.address) == Some(&node.id) && self.found.iter().any(other)
    }

    /// A node has answered alone.
    pub(super) fn on_answer(&mut self, node: Found) {
        if !self.prefixes.is_empty() {
            self.hear(&node);
        }
        match &self.answered {
            None if self.prefixes.is_empty() => return self.on_assigned(&node),
            None => self.answered = Some(node),
            Some(asked) if asked.id == node.id => {
                self.answered = None;
                // A late answer to the question before may have been taken for the one to this question.
                self.found.retain(|known| known.id != node.id);
                self.found.push(node);
            }
            Some(_) => {}
        }
        self.silences = 0;
    }

    /// A node that is known has answered, mostly because it was given an address.
    fn on_assigned(&mut self, node: &Found) {
        let asked = self.next_without();
        if let Some(known) = self.found.iter_mut().find(|known| known.id == node.id) {
            known.address = node.address;
        }
        self.silences += 1;
        match asked {
            Some((id, address)) if id != node.id || address == node.address => {
                self.silences = 0;
                if id == node.id {
                    self.given.insert(address, id);
                    self.seen.0.insert(id, BTreeSet::from([address]));
                }
            }
            // It does not take the address.
            _ if self.silences >= REPEATS => {
                self.silences = 0;
                self.given_up.push(node.id);
            }
            _ => {}
        }
    }

    /// Several nodes have answered, or there was noise.
    pub(super) fn on_collision(&mut self) {
        self.silences = 0;
        self.collisions += 1;
        if self.answered.is_some() {
            return;
        }
        let Some((bits, prefix)) = self.prefixes.pop() else {
            return;
        };
        if bits == 64 {
            self.given_up.push(prefix);
            self.found.push(Found {
                id: prefix,
                address: ADDR_NONE,
                name: String::new(),
            });
        } else {
            let half = 1 << (63 - bits);
            self.prefixes.push((bits + 1, prefix | half));
            self.prefixes.push((bits + 1, prefix));
        }
    }

    /// No node has answered.
    pub(super) fn on_silence(&mut self) {
        self.silences += 1;
        if self.silences < REPEATS {
            return;
        }
        self.silences = 0;
        if self.answered.take().is_none() && self.prefixes.pop().is_none() {
            let unreached = self.next_without().map(|(id, _)| id);
            self.given_up.extend(unreached);
        }
    }
}
