//! Finds all nodes of a bus by their ids, without collisions in the end: where several answer at once, the next question
//! is for half of them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ztl_core::Instant;
use ztl_core::link::{ADDR_ALL, ADDR_MOST, ADDR_NONE, BusMessage};

use super::BusEvent;

/// A question waits at most this long for a moment at which it delays no node with a task too much.
const WAIT: Duration = Duration::from_secs(2);
/// A question without an answer is repeated this often.
const REPEATS: u8 = 2;
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
    /// Nodes that cannot have an address: they do not answer, or several have one id.
    given_up: Vec<u64>,
    found: Vec<Found>,
}

impl Search {
    pub(super) fn new(round: u8, taken: Vec<u8>, given: BTreeMap<u8, u64>, now: Instant) -> Self {
        Self {
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
        let all = self.prefixes.is_empty() && self.next_without().is_none();
        all || self.questions >= QUESTIONS || self.found.len() >= MOST
    }

    /// Addresses that the gateway has given, in this search or before.
    pub(super) const fn given(&self) -> &BTreeMap<u8, u64> {
        &self.given
    }

    pub(super) fn into_event(mut self) -> BusEvent {
        let unnamed = self.found.iter().filter(|node| node.name.is_empty());
        let unnamed: BTreeSet<u64> = unnamed.map(|node| node.id).collect();
        // Several nodes with one id collide at it only. Noise, or a node that sends all the time, collides at all ids.
        if unnamed.iter().any(|id| unnamed.contains(&(id ^ 1))) {
            self.found.retain(|node| !node.name.is_empty());
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
            needs && !self.given_up.contains(&node.id)
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
                self.given.extend((id == node.id).then_some((address, id)));
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
