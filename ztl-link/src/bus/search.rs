//! Finds all nodes of a bus by their ids, without collisions in the end: where several answer at once, the next question
//! is for half of them.

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

/// More ids than this that only collisions have shown are noise.
const UNNAMED: usize = 8;

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
    /// Nodes that cannot have an address: they do not answer, or several have one id.
    given_up: Vec<u64>,
    found: Vec<Found>,
}

impl Search {
    pub(super) fn new(round: u8, taken: Vec<u8>, now: Instant) -> Self {
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

    pub(super) fn into_event(self) -> BusEvent {
        // Nodes that answer at once are found in the end, at least those with an id of their own.
        let named = self.found.iter().any(|node| !node.name.is_empty());
        let unnamed = !(1..=UNNAMED).contains(&self.found.len());
        match self.collisions > 0 && !named && unnamed {
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

    /// The next node without an address, and a free one. Only when all nodes are known: one may have it already.
    fn next_without(&self) -> Option<(u64, u8)> {
        let has = |address| self.found.iter().any(|node| node.address == address);
        let free = (1..=ADDR_MOST).find(|address| !self.taken.contains(address) && !has(*address));
        let without = self.found.iter().filter(|node| node.address == ADDR_NONE);
        let node = without
            .into_iter()
            .find(|node| !self.given_up.contains(&node.id));
        node.map(|node| node.id).zip(free)
    }

    /// A node has answered alone.
    pub(super) fn on_answer(&mut self, node: Found) {
        self.silences = 0;
        match &self.answered {
            Some(asked) if asked.id == node.id => {
                self.answered = None;
                self.found.push(node);
            }
            Some(_) => {}
            None if self.prefixes.is_empty() => {
                if let Some(known) = self.found.iter_mut().find(|known| known.id == node.id) {
                    known.address = node.address;
                }
            }
            None => self.answered = Some(node),
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
