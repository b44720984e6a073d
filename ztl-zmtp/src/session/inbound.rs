//! The receiving half of a connection.

mod handshake;

use alloc::vec::Vec;
use core::marker::PhantomData;
use core::time::Duration;

use ztl_core::Instant;

use super::ENVELOPES;
#[cfg(feature = "curve")]
use super::frames::header;
use super::frames::{Message, Scan, scan};
use super::obstacle::Obstacle;
use super::outbound::Outbound;
use super::security::Security;
#[cfg(feature = "curve")]
use crate::curve::{Cipher, Handshake};
use crate::fault::Fault;
#[cfg(feature = "curve")]
use crate::wire::COMMAND;
use crate::wire::{GREETING, MECHANISM, PARTIAL, PING, Socket};

/// Most commands between the frames of one message.
const WITHIN: u8 = 64;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// The first 11 bytes, which tell the peer's version.
    Signature,
    /// The rest of the greeting.
    Greeting,
    /// A ZMTP 2.0 peer sends its socket type, then its identity as a frame.
    OldGreeting,
    Handshake,
    /// Whether the peer is accepted has to be decided.
    Asking,
    /// As `Traffic`, without commands.
    OldTraffic,
    Traffic,
}

/// How far a peer is in the handshake that it has not finished.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// It has not sent signature and version.
    Silent,
    /// It has.
    Greeted,
    /// It has sent a `HELLO` that was made for this server.
    Opened,
}

/// What [`Inbound::next`] found.
#[derive(Debug, PartialEq, Eq)]
pub enum Step<'a> {
    /// All bytes are taken.
    Taken,
    /// The peer has said who it is. Call [`Inbound::accept`], or close the connection.
    Asks,
    /// A message; there may be more.
    Message(Message<'a>),
    /// The command of a subscriber of ZMTP 3.1, which begins (`true`) or ends a subscription to this topic (RFC 37,
    /// Publish-Subscribe). Older ones send a message, whose first byte is 1 or 0.
    Subscription(bool, Vec<u8>),
}

/// Makes messages of received bytes, as a socket of type `S`.
#[derive(Debug)]
pub struct Inbound<S> {
    phase: Phase,
    /// Whether the peer speaks ZMTP 2.0.
    old: bool,
    security: Security,
    /// Bytes that wait for others, from `begin` on.
    held: Vec<u8>,
    begin: usize,
    /// Where the next frame of the incomplete message begins.
    scanned: usize,
    /// Commands between the frames of the incomplete message.
    within: u8,
    /// The longest frame.
    most: usize,
    /// How long the peer may be silent; zero for any time.
    ttl: Duration,
    deadline: Instant,
    #[cfg(feature = "curve")]
    handshake: Option<alloc::boxed::Box<Handshake>>,
    #[cfg(feature = "curve")]
    cipher: Option<Cipher>,
    /// The decrypted frames of the current message.
    #[cfg(feature = "curve")]
    plain: Vec<u8>,
    #[cfg(feature = "curve")]
    delivered: bool,
    socket: PhantomData<S>,
}

impl<S: Socket> Inbound<S> {
    /// A new connection, whose frames have at most `most` bytes, and messages at most [`ENVELOPES`] more. Its greeting is in `out`.
    /// The handshake may take until `deadline`.
    pub fn open(deadline: Instant, security: Security, most: usize, out: &mut Outbound) -> Self {
        out.raw(GREETING.get(..PARTIAL).unwrap_or_default());
        Self {
            phase: Phase::Signature,
            old: false,
            security,
            held: Vec::new(),
            begin: 0,
            scanned: 0,
            within: 0,
            most,
            ttl: Duration::ZERO,
            deadline,
            #[cfg(feature = "curve")]
            handshake: None,
            #[cfg(feature = "curve")]
            cipher: None,
            #[cfg(feature = "curve")]
            plain: Vec::new(),
            #[cfg(feature = "curve")]
            delivered: false,
            socket: PhantomData,
        }
    }

    /// Whether the handshake is complete.
    #[must_use]
    pub const fn is_ready(&self) -> bool {
        matches!(self.phase, Phase::Traffic | Phase::OldTraffic)
    }

    /// How far the handshake is, until it is complete.
    #[must_use]
    pub fn stage(&self) -> Stage {
        #[cfg(feature = "curve")]
        if self.handshake.as_ref().is_some_and(|one| one.has_begun()) {
            return Stage::Opened;
        }
        match self.phase {
            Phase::Signature => Stage::Silent,
            _ => Stage::Greeted,
        }
    }

    /// Until when the peer has to be heard; [`Instant::NEVER`] if it may be silent.
    #[must_use]
    pub const fn deadline(&self) -> Instant {
        match (self.is_ready(), self.ttl.is_zero()) {
            (true, true) => Instant::NEVER,
            _ => self.deadline,
        }
    }

    /// Bytes that the buffers take.
    #[must_use]
    pub const fn held(&self) -> usize {
        #[cfg(feature = "curve")]
        return self.held.capacity() + self.plain.capacity();
        #[cfg(not(feature = "curve"))]
        self.held.capacity()
    }

    /// Whether [`next`](Self::next) may find something without further bytes.
    #[must_use]
    pub const fn has_more(&self) -> bool {
        self.begin < self.held.len()
    }

    /// The public key of a peer that [asks](Step::Asks), if the connection is encrypted.
    #[cfg(feature = "curve")]
    #[must_use]
    pub fn peer_key(&self) -> Option<[u8; 32]> {
        let handshake = self.handshake.as_ref()?;
        handshake.is_known().then(|| handshake.peer())
    }

    /// What keeps this end, a client, from the peer. Call it when the connection ends: by a fault, or because the peer
    /// closed it. `None` if the handshake was complete, or if the end says nothing.
    #[must_use]
    pub fn obstacle(&self, fault: Option<Fault>) -> Option<Obstacle> {
        match (self.phase, fault) {
            (Phase::OldTraffic | Phase::Traffic, _) => None,
            (Phase::Signature, Some(Fault::Mechanism)) => Some(Obstacle::PeerIsPlain),
            (Phase::Greeting, Some(Fault::Mechanism)) => {
                let mechanism = MECHANISM.start - PARTIAL..MECHANISM.end - PARTIAL;
                let mechanism = self.waiting().get(mechanism).unwrap_or_default();
                Some(match mechanism.split(|byte| *byte == 0).next() {
                    Some(b"CURVE") => Obstacle::PeerEncrypts,
                    Some(b"NULL") => Obstacle::PeerIsPlain,
                    _ => Obstacle::OtherMechanism,
                })
            }
            #[cfg(feature = "curve")]
            (Phase::Handshake, Some(Fault::Security)) if !self.trusts_peer() => {
                Some(Obstacle::OtherKey)
            }
            (Phase::Handshake, None | Some(Fault::Refused)) => Some(match &self.security {
                // Refused for another reason than who this end is.
                _ if fault.is_some() && !self.is_refused_by_code() => {
                    Obstacle::Fault(Fault::Refused)
                }
                Security::Null => Obstacle::NotAdmitted,
                #[cfg(feature = "curve")]
                Security::Curve(_) if self.trusts_peer() => Obstacle::KeyNotAdmitted,
                #[cfg(feature = "curve")]
                Security::Curve(_) => Obstacle::OtherKey,
            }),
            (_, fault) => fault.map(Obstacle::Fault),
        }
    }

    /// Whether the `ERROR` that has ended the handshake has the status code of an authenticator (RFC 27): `400` or
    /// another number.
    fn is_refused_by_code(&self) -> bool {
        let command = self.waiting().get(2..).unwrap_or_default();
        let reason = command.strip_prefix(b"\x05ERROR").unwrap_or_default();
        reason.get(1).is_some_and(u8::is_ascii_digit)
    }

    /// Whether the peer has proved that it has the key that this end, a client, expects.
    #[cfg(feature = "curve")]
    fn trusts_peer(&self) -> bool {
        let handshake = self.handshake.as_ref();
        handshake.is_some_and(|handshake| handshake.trusts_peer())
    }

    /// Keeps bytes for a later [`next`](Self::next).
    pub fn keep(&mut self, bytes: &mut &[u8]) {
        if bytes.is_empty() && self.has_more() {
            return;
        }
        self.drop_begin();
        self.held.extend_from_slice(bytes);
        *bytes = &[];
    }

    /// Notes that the peer was heard.
    pub fn on_heard(&mut self, now: Instant) {
        if !self.ttl.is_zero() {
            self.deadline = now + self.ttl;
        }
    }

    /// Takes bytes, up to the next message.
    ///
    /// # Errors
    /// Why the connection is to be closed, after what is in `out` was sent.
    pub fn next<'a, 'b: 'a>(
        &'a mut self,
        bytes: &mut &'b [u8],
        out: &mut Outbound,
    ) -> Result<Step<'a>, Fault> {
        while !self.is_ready() {
            if self.phase == Phase::Asking {
                return Ok(Step::Asks);
            }
            if !self.greet(bytes, out)? {
                return Ok(Step::Taken);
            }
        }
        #[cfg(feature = "curve")]
        if self.cipher.is_some() {
            return self.next_encrypted(bytes, out);
        }
        loop {
            // Without bytes from before, messages are read where they are.
            let direct = !self.has_more();
            if direct {
                self.drop_begin();
            } else if !bytes.is_empty() {
                self.keep(bytes);
            }
            let from = if direct { *bytes } else { self.waiting() };
            let mut scanned = self.scanned;
            let found = scan(from, &mut scanned, self.most, self.total())?;
            self.scanned = scanned;
            if matches!(found, Scan::Message(_)) {
                self.within = 0;
            }
            match found {
                Scan::Incomplete => {
                    if direct {
                        self.keep(bytes);
                    }
                    return Ok(Step::Taken);
                }
                Scan::Message(length) if direct => {
                    let (message, rest) = bytes.split_at_checked(length).unwrap_or_default();
                    *bytes = rest;
                    return Ok(Step::Message(Message { bytes: message }));
                }
                Scan::Message(length) => {
                    let begin = self.begin;
                    self.begin += length;
                    let message = self.held.get(begin..self.begin).unwrap_or_default();
                    return Ok(Step::Message(Message { bytes: message }));
                }
                Scan::Command(begin, body, end) => {
                    if self.phase == Phase::OldTraffic {
                        return Err(Fault::Flags);
                    }
                    let said = if direct && begin == 0 {
                        let (command, rest) = bytes.split_at_checked(end).unwrap_or_default();
                        *bytes = rest;
                        on_command(command.get(body..).unwrap_or_default(), out)?
                    } else {
                        if direct {
                            self.keep(bytes);
                        }
                        let command = self.waiting().get(body..end).unwrap_or_default();
                        let said = on_command(command, out)?;
                        if begin == 0 {
                            self.begin += end;
                        } else {
                            // Between the frames of a message. Each moves what follows it, so there may be few.
                            self.within = self.within.saturating_add(1);
                            if self.within > WITHIN {
                                return Err(Fault::Unexpected);
                            }
                            self.held.drain(self.begin + begin..self.begin + end);
                        }
                        said
                    };
                    if let Some(step) = self.on_said(said) {
                        return Ok(step);
                    }
                }
            }
        }
    }

    /// The next message of a peer that encrypts each frame.
    #[cfg(feature = "curve")]
    fn next_encrypted<'a>(
        &'a mut self,
        bytes: &mut &[u8],
        out: &mut Outbound,
    ) -> Result<Step<'a>, Fault> {
        if core::mem::take(&mut self.delivered) {
            self.plain.clear();
            if self.plain.capacity() > 4096 {
                self.plain = Vec::new();
            }
        }
        self.keep(bytes);
        loop {
            let waiting = self.held.get(self.begin..).unwrap_or_default();
            let Some((length, size)) = header(waiting)? else {
                return Ok(Step::Taken);
            };
            // Encrypted, as libzmq counts it.
            if size > self.most || size + self.plain.len() > self.total() {
                return Err(Fault::TooLong);
            }
            let end = length + size;
            let Some(body) = waiting.get(length..end) else {
                return Ok(Step::Taken);
            };
            let cipher = self.cipher.as_mut().ok_or(Fault::Unexpected)?;
            let begin = self.plain.len();
            let flags = cipher.decrypt(body, &mut self.plain)?;
            self.begin += end;
            if flags & COMMAND != 0 {
                let command = self.plain.split_off(begin);
                let (length, _) = header(&command)?.unwrap_or_default();
                let command = command.get(length..).unwrap_or_default();
                let said = on_command(command, out)?;
                if let Some(step) = self.on_said(said) {
                    return Ok(step);
                }
            } else if flags & crate::wire::MORE == 0 {
                self.delivered = true;
                return Ok(Step::Message(Message { bytes: &self.plain }));
            }
        }
    }

    fn on_said<'a>(&mut self, said: Said) -> Option<Step<'a>> {
        match said {
            Said::Nothing => None,
            Said::Ttl(ttl) => {
                self.ttl = ttl;
                None
            }
            Said::Subscription(begins, topic) => Some(Step::Subscription(begins, topic)),
        }
    }

    /// The longest message, with all its frames and their headers.
    const fn total(&self) -> usize {
        self.most.saturating_add(ENVELOPES)
    }

    /// The bytes that wait for others.
    fn waiting(&self) -> &[u8] {
        self.held.get(self.begin..).unwrap_or_default()
    }

    /// Drops what has been read.
    fn drop_begin(&mut self) {
        if self.begin == 0 {
            return;
        }
        if self.begin >= self.held.len() {
            // An idle connection takes no memory; a busy one does not ask for it again and again.
            match self.held.capacity() > 4096 {
                true => self.held = Vec::new(),
                false => self.held.clear(),
            }
        } else {
            self.held.drain(..self.begin);
        }
        self.begin = 0;
    }
}

/// What a command says.
enum Said {
    Nothing,
    /// How long the peer is silent at most.
    Ttl(Duration),
    Subscription(bool, Vec<u8>),
}

/// Handles a command after the handshake.
fn on_command(body: &[u8], out: &mut Outbound) -> Result<Said, Fault> {
    if body.starts_with(b"\x05ERROR") {
        return Err(Fault::Refused);
    }
    if let Some(topic) = body.strip_prefix(b"\x09SUBSCRIBE") {
        return Ok(Said::Subscription(true, topic.to_vec()));
    }
    if let Some(topic) = body.strip_prefix(b"\x06CANCEL") {
        return Ok(Said::Subscription(false, topic.to_vec()));
    }
    let Some((ttl, context)) = body.strip_prefix(PING).and_then(<[u8]>::split_first_chunk) else {
        // Unknown commands are ignored.
        return Ok(Said::Nothing);
    };
    let context = context.get(..16).unwrap_or(context);
    out.command(&[b"\x04PONG", context].concat());
    let tenths = u64::from(u16::from_be_bytes(*ttl));
    Ok(Said::Ttl(Duration::from_millis(tenths * 100)))
}
