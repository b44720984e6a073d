//! A shared, half-duplex line, byte by byte: when two ends send at once, both are damaged. An end that sends hears nothing.

use std::time::Duration;

use ztl_core::Instant;

use super::gateway::BAUD;
use crate::plan::Dice;

/// Of one byte, in ns.
const BYTE: u64 = 10_000_000_000 / BAUD as u64;
/// Bytes are heard in pieces of about this duration.
const BURST: u64 = 1_000_000;

/// The gateway, or a device.
pub(super) type End = Option<usize>;

/// What one end sends without a pause.
struct Talk {
    end: End,
    /// When its first byte begins, in ns.
    begin: u64,
    bytes: Vec<u8>,
    heard: usize,
}

impl Talk {
    const fn until(&self) -> u64 {
        self.at(self.bytes.len())
    }

    /// When the byte with this number begins.
    const fn at(&self, number: usize) -> u64 {
        self.begin + number as u64 * BYTE
    }
}

/// Bytes that were on the line, and who sent at that time.
pub(super) struct Piece {
    pub(super) bytes: Vec<u8>,
    pub(super) senders: Vec<End>,
}

pub(super) struct Wire {
    talks: Vec<Talk>,
    dice: Dice,
    /// How many bytes were damaged since several ends sent at once.
    pub(super) collided: u64,
}

impl Wire {
    pub(super) const fn new(seed: u64) -> Self {
        Self {
            talks: Vec::new(),
            dice: Dice::new(seed),
            collided: 0,
        }
    }

    /// An end sends these bytes, after what it is sending.
    pub(super) fn send(&mut self, now: Instant, end: End, bytes: &[u8]) {
        let begin = now.as_micros() * 1000;
        let mut its = self.talks.iter_mut();
        match its.find(|talk| talk.end == end && talk.until() >= begin) {
            Some(talk) => talk.bytes.extend(bytes),
            None if bytes.is_empty() => {}
            None => self.talks.push(Talk {
                end,
                begin,
                bytes: bytes.to_vec(),
                heard: 0,
            }),
        }
    }

    /// Nothing is on the line any more.
    pub(super) fn clear(&mut self) {
        self.talks.clear();
    }

    /// What was heard until now, in order.
    pub(super) fn poll(&mut self, now: Instant) -> Vec<Piece> {
        let mut pieces: Vec<Piece> = Vec::new();
        if self.poll_timeout().is_none_or(|at| now < at) {
            return pieces;
        }
        let now = now.as_micros() * 1000;
        loop {
            let due = self
                .talks
                .iter_mut()
                .filter(|talk| talk.heard < talk.bytes.len() && talk.at(talk.heard + 1) <= now);
            let Some(talk) = due.min_by_key(|talk| talk.at(talk.heard)) else {
                break;
            };
            let (begin, mut byte) = (talk.at(talk.heard), talk.bytes[talk.heard]);
            talk.heard += 1;
            let sends = |talk: &&Talk| talk.begin < begin + BYTE && talk.until() > begin;
            let senders: Vec<End> = self.talks.iter().filter(sends).map(|t| t.end).collect();
            if senders.len() > 1 {
                self.collided += 1;
                // As many bytes as there is time for, not as many as are sent.
                if !self.dice.throw().is_multiple_of(senders.len() as u64) {
                    continue;
                }
                byte ^= self.dice.below(256) as u8;
            }
            match pieces.last_mut() {
                Some(piece) if piece.senders == senders => piece.bytes.push(byte),
                _ => pieces.push(Piece {
                    bytes: vec![byte],
                    senders,
                }),
            }
        }
        self.talks.retain(|talk| talk.until() + BYTE > now);
        pieces
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        let open = self
            .talks
            .iter()
            .filter(|talk| talk.heard < talk.bytes.len());
        let wake = open
            .map(|talk| talk.until().min(talk.at(talk.heard) + BURST))
            .min();
        wake.map(|at| Instant::ZERO + Duration::from_micros(at.div_ceil(1000)))
    }
}
