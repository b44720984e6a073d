//! Which clients have room for a record (`docs/protocol.md`, 9.5).

use std::collections::{BTreeMap, BTreeSet};

use ztl_core::Instant;
use ztl_core::envelope::{ClientId, Envelope};

/// What is known about clients from their requests.
pub(super) struct Places {
    /// Number of clients that the server keeps track of.
    pub(super) room: usize,
    /// The highest number of each client, and the connection of its last request.
    pub(super) heard: BTreeMap<ClientId, (u64, u64)>,
    /// Clients that the server may have dropped.
    pub(super) lost: BTreeSet<ClientId>,
    /// Until when an evicted record would have been kept.
    pub(super) until: Option<Instant>,
}

impl Places {
    pub(super) fn new(room: usize) -> Self {
        Self {
            room,
            heard: BTreeMap::new(),
            lost: BTreeSet::new(),
            until: None,
        }
    }

    /// Whether the server knows for certain that this INIT has not arrived before.
    pub(super) fn is_new(&self, client: ClientId, number: u64) -> bool {
        let highest = self.heard.get(&client);
        // A device stores 32 bits of the number.
        let below = |highest: u64| highest < number && highest < u64::from(u32::MAX);
        highest.is_some_and(|(highest, _)| below(*highest)) && !self.lost.contains(&client)
    }

    /// Whether no client of this project would send this. Numbers increase, so only an INIT may arrive again after
    /// the server has dropped the client's record.
    pub(super) fn is_impossible(&self, envelope: Envelope) -> bool {
        let highest = self.heard.get(&envelope.client);
        highest.is_some_and(|(highest, _)| *highest >= envelope.number)
            && self.lost.contains(&envelope.client)
    }

    pub(super) fn hear(&mut self, envelope: Envelope, place: u64, is_init: bool) {
        let Envelope { client, number, .. } = envelope;
        let known = self.heard.contains_key(&client) && !self.lost.contains(&client);
        if is_init && !known {
            // An INIT does not make its client known.
            let highest = self.heard.get(&client).map_or(0, |(highest, _)| *highest);
            self.lost.insert(client);
            self.heard.insert(client, (highest.max(number), place));
            return;
        }
        if !known && self.heard.len() >= self.room {
            let mut others: Vec<ClientId> = self.heard.keys().copied().collect();
            others.retain(|other| *other != client);
            let here = |other: &ClientId| self.heard[other].1 == place;
            // Clients that used the connection before, if there are any.
            if others
                .iter()
                .any(|other| here(other) && !self.lost.contains(other))
            {
                others.retain(here);
            }
            self.lost.extend(others);
        }
        self.lost.remove(&client);
        let highest = self.heard.get(&client).map_or(0, |(highest, _)| *highest);
        self.heard.insert(client, (highest.max(number), place));
    }
}
