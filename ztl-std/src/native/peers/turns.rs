//! A turn of a peer: reads a piece of its bytes, and makes messages of them.

use std::io::{self, Read as _};
use std::net::IpAddr;

use tracing::warn;
use ztl_core::Instant;
use ztl_zmtp::Fault;
use ztl_zmtp::session::{Security, Step};

use super::peer::Served;
use super::{CHECK, Peers, UNSENT};
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::time::now;

/// The empty frame between the envelope and the content.
const DELIMITER: &[u8] = &[1, 0];

impl<S: Served> Peers<S> {
    /// Reads a piece of a peer's bytes, and makes messages of them.
    pub(super) fn turn(
        &mut self,
        now: Instant,
        slot: usize,
        admit: &mut dyn FnMut(IpAddr, Option<[u8; 32]>) -> bool,
    ) {
        let Some(Some(peer)) = self.slots.get_mut(slot) else {
            return;
        };
        peer.is_ready = false;
        if peer.out.waiting() >= UNSENT {
            return;
        }
        if !peer.later.is_empty() {
            self.messages.append(&mut peer.later);
            peer.later_held = 0;
            if peer.readable {
                peer.is_ready = true;
                self.ready.push(slot, peer.inbound.is_ready());
            }
            return;
        }
        let read = match peer.stream.read(&mut self.piece) {
            // What it asked for before is sent first.
            Ok(0) if peer.out.waiting() > 0 => {
                peer.is_leaving = true;
                peer.readable = false;
                peer.took = now;
                self.next_check.get_or_insert(now + CHECK);
                return;
            }
            Ok(0) => return self.close(slot, None),
            Ok(count) => {
                peer.heard = now;
                // A short read has emptied the system's buffer. The next bytes are an event; the end may have been one.
                peer.readable = count == self.piece.len() || peer.has_ended;
                count
            }
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                peer.readable = false;
                0
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => 0,
            Err(_) => return self.close(slot, None),
        };
        let mut bytes = self.piece.get(..read).unwrap_or_default();
        let mut is_known = false;
        let fault = loop {
            match peer.inbound.next(&mut bytes, &mut peer.out) {
                Ok(Step::Taken) => break None,
                Ok(Step::Asks) => {
                    let key = peer.inbound.peer_key();
                    if !admit(peer.address, key) {
                        return self.reject(slot, key);
                    }
                    peer.key = key;
                    peer.inbound.accept(&mut peer.out);
                    is_known = true;
                }
                Ok(Step::Message(message)) => {
                    let (envelope, body) = match S::split(message) {
                        Some((envelope, body)) => {
                            (Some([envelope, DELIMITER].concat().into()), body)
                        }
                        None => (None, None),
                    };
                    peer.unanswered += usize::from(envelope.is_some());
                    peer.has_asked = true;
                    let body = body.map(Into::into);
                    self.messages.push_back(peer.incoming(slot, envelope, body));
                }
                Ok(Step::Subscription(begins, topic)) => {
                    if S::SUBSCRIBED {
                        let message = [&[u8::from(begins)], topic.as_slice()].concat();
                        let body = Some(message.into_boxed_slice());
                        self.messages.push_back(peer.incoming(slot, None, body));
                    }
                }
                Err(fault) => break Some(fault),
            }
        };
        let (id, address) = (peer.id(slot), peer.address);
        if is_known {
            self.places.admit(id, address);
        } else if !peer.inbound.is_ready() {
            self.places.advance(now, id, address, peer.inbound.stage());
        }
        if let Some(fault) = fault {
            return self.close(slot, Some(&self.told(fault)));
        }
        let Some(Some(peer)) = self.slots.get_mut(slot) else {
            return;
        };
        peer.inbound.on_heard(now);
        if peer.readable && peer.out.waiting() < UNSENT {
            peer.is_ready = true;
            self.ready.push(slot, peer.inbound.is_ready());
        }
        if peer.out.waiting() > 0 && !peer.is_unsent {
            peer.is_unsent = true;
            self.unsent.push(slot);
        }
        if peer.inbound.deadline() != Instant::NEVER {
            self.next_check.get_or_insert(now + CHECK);
        }
        self.count(slot);
    }

    /// A fault, for the log.
    fn told(&self, fault: Fault) -> String {
        match (fault, &self.rules.security) {
            (Fault::Mechanism, Security::Curve(_)) => {
                "it does not encrypt, and this server demands keys".to_owned()
            }
            (Fault::Mechanism, Security::Null) => {
                "it encrypts or has a password, and this server has no keys".to_owned()
            }
            (fault, _) => fault.to_string(),
        }
    }

    /// Closes the connection of a peer that is not allowed.
    fn reject(&mut self, slot: usize, key: Option<[u8; 32]>) {
        let address = self.slots.get(slot).and_then(Option::as_ref);
        if let Some(address) = address.map(|peer| peer.address)
            && self.lines.take(now())
        {
            let who = key.map_or_else(
                || "without a key".to_owned(),
                |key| format!("with the key {}", PublicKey::from_bytes(key)),
            );
            warn!(target: TASKS, "A client at {address} {who} is not allowed and was rejected.");
        }
        self.close(slot, None);
    }
}
