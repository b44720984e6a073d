//! Greeting and handshake of a connection.

#[cfg(feature = "curve")]
use alloc::vec::Vec;

use super::super::BEFORE;
use super::super::frames::header;
use super::super::outbound::Outbound;
use super::super::security::Security;
use super::{Inbound, Phase};
#[cfg(feature = "curve")]
use crate::curve::Handshake;
use crate::fault::Fault;
use crate::receive::first_property;
use crate::wire::{COMMAND, GREETING, MECHANISM, PARTIAL, SIGNATURE, Socket, old_greeting};

impl<S: Socket> Inbound<S> {
    /// A step of greeting and handshake; `false` if bytes are missing.
    pub(super) fn greet(&mut self, bytes: &mut &[u8], out: &mut Outbound) -> Result<bool, Fault> {
        let room = BEFORE.saturating_sub(self.waiting().len());
        let (mut now, later) = bytes.split_at(bytes.len().min(room));
        self.keep(&mut now);
        *bytes = later;
        let waiting = self.held.get(self.begin..).unwrap_or_default();
        let taken = match self.phase {
            Phase::Signature => {
                let wrong = |&(at, byte): &(usize, &u8)| match at {
                    0 => *byte != 0xFF,
                    // The start of a ZMTP 1.0 peer (RFC 37, Detecting ZMTP 1.0 and 2.0 Peers).
                    9 => byte & 1 == 0,
                    SIGNATURE => *byte == 0,
                    _ => false,
                };
                if waiting
                    .iter()
                    .enumerate()
                    .take(PARTIAL)
                    .any(|at| wrong(&at))
                {
                    return Err(Fault::NotZmtp);
                }
                match waiting.get(SIGNATURE) {
                    None => 0,
                    Some(1 | 2) if !matches!(self.security, Security::Null) => {
                        return Err(Fault::Mechanism);
                    }
                    Some(1 | 2) => {
                        out.raw(&old_greeting(S::CODE));
                        self.phase = Phase::OldGreeting;
                        PARTIAL
                    }
                    Some(_) => {
                        self.put_greeting(out);
                        self.phase = Phase::Greeting;
                        PARTIAL
                    }
                }
            }
            Phase::Greeting => match waiting.get(..GREETING.len() - PARTIAL) {
                None => 0,
                Some(greeting) => {
                    let mechanism = MECHANISM.start - PARTIAL..MECHANISM.end - PARTIAL;
                    let mechanism = greeting.get(mechanism).unwrap_or_default();
                    let padding = mechanism.strip_prefix(self.security.mechanism());
                    if padding.is_none_or(|padding| padding.iter().any(|byte| *byte != 0)) {
                        return Err(Fault::Mechanism);
                    }
                    self.phase = Phase::Handshake;
                    self.begin_handshake(out);
                    GREETING.len() - PARTIAL
                }
            },
            Phase::OldGreeting => {
                let Some((socket, identity)) = waiting.split_first() else {
                    return Ok(false);
                };
                if !S::PARTNERS.iter().any(|(_, code)| code == socket) {
                    return Err(Fault::SocketType);
                }
                match header(identity)? {
                    Some((length, size)) if size > 255 || length > 2 => return Err(Fault::TooLong),
                    Some((length, size)) if identity.len() >= length + size => {
                        self.old = true;
                        self.phase = Phase::Asking;
                        1 + length + size
                    }
                    _ => 0,
                }
            }
            _ => match header(waiting)? {
                Some(_) if waiting.first().is_none_or(|flags| flags & COMMAND == 0) => {
                    return Err(Fault::Unexpected);
                }
                Some((length, size)) if length + size > BEFORE => return Err(Fault::TooLong),
                Some((length, size)) => match waiting.get(length..length + size) {
                    None => 0,
                    Some(command) => {
                        let mut copy = [0; BEFORE];
                        let copy = copy.get_mut(..size).unwrap_or_default();
                        copy.copy_from_slice(command);
                        self.on_handshake(copy, out)?;
                        length + size
                    }
                },
                None => 0,
            },
        };
        self.begin += taken;
        if taken == 0 && self.waiting().len() >= BEFORE {
            return Err(Fault::TooLong);
        }
        Ok(taken > 0)
    }

    /// The rest of our greeting.
    fn put_greeting(&self, out: &mut Outbound) {
        let mut greeting = *GREETING;
        let mechanism = greeting.iter_mut().skip(MECHANISM.start);
        let name = self.security.mechanism();
        let padded = name.iter().chain(core::iter::repeat(&0));
        for (to, from) in mechanism.take(MECHANISM.len()).zip(padded) {
            *to = *from;
        }
        // The server of an encrypted connection says that it is one.
        if let Some(server) = greeting.get_mut(MECHANISM.end)
            && !matches!(self.security, Security::Null)
        {
            *server = u8::from(S::BINDS);
        }
        out.raw(greeting.get(PARTIAL..).unwrap_or_default());
    }

    fn begin_handshake(&mut self, out: &mut Outbound) {
        match &self.security {
            Security::Null if !S::BINDS => out.raw(S::READY),
            Security::Null => {}
            #[cfg(feature = "curve")]
            Security::Curve(keys) => {
                let mut handshake = Handshake::new(keys);
                if let Some(hello) = handshake.hello() {
                    out.command(&hello);
                }
                self.handshake = Some(alloc::boxed::Box::new(handshake));
            }
        }
    }

    /// Handles a command of the handshake.
    fn on_handshake(&mut self, command: &[u8], out: &mut Outbound) -> Result<(), Fault> {
        if command.starts_with(b"\x05ERROR") {
            return Err(Fault::Refused);
        }
        #[cfg(feature = "curve")]
        if let Some(handshake) = &mut self.handshake {
            let mut metadata = Vec::new();
            let answer = handshake.on_command(command, metadata_of::<S>(), &mut metadata)?;
            if let Some(answer) = answer {
                out.command(&answer);
            }
            if handshake.is_known() {
                check_partner::<S>(&metadata, out)?;
                self.phase = Phase::Asking;
            }
            return Ok(());
        }
        let metadata = command.strip_prefix(b"\x05READY");
        check_partner::<S>(metadata.ok_or(Fault::Unexpected)?, out)?;
        self.phase = Phase::Asking;
        Ok(())
    }

    /// Accepts the peer that [asks](super::Step::Asks).
    pub fn accept(&mut self, out: &mut Outbound) {
        if self.phase != Phase::Asking {
            return;
        }
        self.phase = Phase::Traffic;
        if self.old {
            self.phase = Phase::OldTraffic;
            return;
        }
        #[cfg(feature = "curve")]
        if let Some(mut handshake) = self.handshake.take() {
            if let Some(ready) = handshake.ready(metadata_of::<S>()) {
                out.command(&ready);
            }
            let [sending, receiving] = handshake.ciphers();
            out.cipher = Some(sending);
            self.cipher = Some(receiving);
            return;
        }
        if S::BINDS {
            out.raw(S::READY);
        }
    }
}

/// The properties in our `READY`.
#[cfg(feature = "curve")]
fn metadata_of<S: Socket>() -> &'static [u8] {
    S::READY.get(8..).unwrap_or_default()
}

/// Checks that the peer's properties are complete, and that its socket type matches ours.
fn check_partner<S: Socket>(mut metadata: &[u8], out: &mut Outbound) -> Result<(), Fault> {
    let mut types = 0;
    let mut known = 0;
    while !metadata.is_empty() {
        let (name, value, rest) = first_property(metadata).ok_or(Fault::Unexpected)?;
        if name.eq_ignore_ascii_case(b"Socket-Type") {
            types += 1;
            known += usize::from(S::PARTNERS.iter().any(|(partner, _)| *partner == value));
        }
        metadata = rest;
    }
    if types > 0 && types == known {
        return Ok(());
    }
    out.raw(S::ERROR);
    Err(Fault::SocketType)
}
