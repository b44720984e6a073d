//! The receiving half of a connection.

use super::connection::{Connection, Flaw, Next, Part, Phase, Turn};
use super::fault::Fault;
use super::wire::{
    COMMAND, DELIMITER, GREETING, LONG, LONGEST_PING, MECHANISM, MORE, PING, SIGNATURE, SKIPPED,
    Socket,
};

// The inline attributes of these methods together save 108 bytes in `microbit-zmtp`.
impl<S: Socket, B: AsRef<[u8]> + AsMut<[u8]>> Connection<S, B> {
    /// Takes at least the first byte and returns how many were taken; 0 if they have to wait.
    pub(crate) fn take(&mut self, bytes: &[u8]) -> usize {
        let Some(&first) = bytes.first() else {
            return 0;
        };
        match self.phase {
            // Discarded: the connection no longer reads.
            Phase::Closed | Phase::Ending => return bytes.len(),
            Phase::Greeting(place) => self.on_greeting(place, first),
            Phase::OldSocket => {
                self.phase = Phase::OldIdentity;
                if !S::PARTNERS.iter().any(|(_, code)| *code == first) {
                    self.fail(Fault::SocketType);
                }
            }
            _ => return self.take_of_frame(first, bytes),
        }
        1
    }

    /// Handles a byte of the greeting (RFC 37, Formal Grammar and Version Negotiation).
    fn on_greeting(&mut self, place: u8, byte: u8) {
        let at = usize::from(place);
        self.phase = Phase::Greeting(place + 1);
        if at == 0 && byte != 0xFF || at == SIGNATURE - 1 && byte & 1 == 0 {
            // The start of a ZMTP 1.0 peer (RFC 37, Detecting ZMTP 1.0 and 2.0 Peers).
            self.fail(Fault::NotZmtp);
        } else if at == SIGNATURE {
            match byte {
                0 => return self.fail(Fault::NotZmtp),
                1 | 2 => self.phase = Phase::OldSocket,
                _ => {}
            }
            self.hello_due = 2;
        } else if MECHANISM.contains(&at) && GREETING.get(at) != Some(&byte) {
            // The peer may wait for the rest of our greeting (RFC 37, Authentication and Confidentiality).
            self.end(Fault::Mechanism, 2);
        } else if at + 1 == GREETING.len() {
            self.phase = Phase::Handshake;
            if !S::BINDS {
                self.hello_due = 3;
            }
        }
    }

    /// Takes bytes of a frame (RFC 37, Framing).
    // Not inlined in firmware: that saves 144 bytes in `lm3s6965evb-zmtp`.
    #[cfg_attr(target_os = "none", inline(never))]
    fn take_of_frame(&mut self, first: u8, bytes: &[u8]) -> usize {
        match self.next {
            Next::Flags => {
                let command = first & COMMAND != 0;
                // A message waits for its turn, and any frame until the `PONG` is sent.
                if self.pong > 0 || !command && self.turn != Turn::Receive {
                    return 0;
                }
                let old = matches!(self.phase, Phase::OldIdentity | Phase::OldTraffic);
                if first & !(COMMAND | LONG | MORE) != 0
                    || command && (old || first & MORE != 0)
                    || self.phase == Phase::OldIdentity && first & MORE != 0
                {
                    self.fail(Fault::Flags);
                } else if !command && self.phase == Phase::Handshake {
                    self.fail(Fault::Unexpected);
                } else {
                    self.flags = first;
                    self.size = 0;
                    self.next = Next::Size(if first & LONG == 0 { 1 } else { 8 });
                }
                1
            }
            Next::Size(left) => {
                // Once beyond the limit, it stays there.
                self.size = match self.size >> 24 {
                    0 => self.size << 8 | u32::from(first),
                    _ => u32::MAX,
                };
                self.next = Next::Size(left - 1);
                if left <= 1 {
                    self.next = Next::Body;
                    self.on_header();
                }
                1
            }
            Next::Body => {
                let count = bytes.len().min(self.size as usize);
                let piece = bytes.get(..count).unwrap_or_default();
                if self.keep {
                    if self.flags & COMMAND == 0 {
                        // It fits: that was checked with the header.
                        self.keep_bytes(piece);
                    } else {
                        self.keep_command(piece);
                    }
                }
                self.size -= count as u32;
                if self.size == 0 {
                    self.on_frame_end();
                }
                count
            }
        }
    }

    /// Handles the header of a frame, once its size is known.
    // Not inlined in firmware: with the others in this crate, that saves 268 bytes in `microbit-zmtp`.
    #[cfg_attr(target_os = "none", inline(never))]
    fn on_header(&mut self) {
        if self.size > SKIPPED {
            return self.fail(Fault::TooLong);
        }
        self.keep = true;
        let mut fits = true;
        let more = self.flags & MORE != 0;
        if self.flags & COMMAND != 0 {
            self.command = 0;
        } else if self.phase == Phase::OldIdentity {
            self.keep = false;
        } else {
            match self.part {
                // No delimiter, or nothing after it: not a request (RFC 28).
                Part::Envelope if !more => self.part = Part::Nothing,
                Part::Envelope if self.size == 0 => {
                    self.keep = self.keep_bytes(&DELIMITER);
                    self.envelope = self.filled;
                }
                Part::Envelope => fits = self.keep_header(self.size),
                Part::Body if more => self.flaw = Flaw::Several,
                Part::Body if self.size as usize > self.room().saturating_sub(self.filled) => {
                    self.flaw = Flaw::TooLong;
                }
                _ => {}
            }
            self.keep &= self.flaw == Flaw::None && self.part != Part::Nothing;
        }
        if !fits {
            self.fail(Fault::TooLong);
        } else if self.size == 0 {
            self.on_frame_end();
        }
    }

    fn on_frame_end(&mut self) {
        self.next = Next::Flags;
        if self.flags & COMMAND != 0 {
            return self.on_command();
        }
        if self.phase == Phase::OldIdentity {
            return self.on_handshake(Phase::OldTraffic);
        }
        let delimiter = self.part == Part::Envelope && self.envelope > 0;
        match self.part {
            Part::Envelope if delimiter => self.part = Part::Body,
            Part::Body => self.part = Part::Rest,
            _ => {}
        }
        if self.flags & MORE == 0 {
            match self.part {
                Part::Rest => self.turn = Turn::Received,
                _ => self.forget(),
            }
        }
    }

    /// Where a command is stored, as start and end. In the handshake there is no message yet.
    fn command_range(&self) -> (usize, usize) {
        match self.phase {
            Phase::Handshake => (0, self.room()),
            _ => (self.room(), self.room() + LONGEST_PING),
        }
    }

    /// Stores as much of a command as fits; no command needs more.
    fn keep_command(&mut self, piece: &[u8]) {
        let (begin, end) = self.command_range();
        let room = self.buffer.as_mut().get_mut(begin + self.command..end);
        for (to, from) in room.unwrap_or_default().iter_mut().zip(piece) {
            *to = *from;
            self.command += 1;
        }
    }

    /// Handles a complete command (RFC 37, Commands).
    fn on_command(&mut self) {
        let (begin, _) = self.command_range();
        let buffer = self.buffer.as_mut();
        let body = buffer.get_mut(begin..begin + self.command);
        let body = body.unwrap_or_default();
        if body.starts_with(b"\x05ERROR") {
            return self.fail(Fault::Refused);
        }
        if self.phase != Phase::Handshake {
            // Unknown commands are ignored.
            if body.starts_with(PING)
                && let [four, p, i, n, g, ttl, low, ..] = body
            {
                self.ttl = u16::from_be_bytes([*ttl, *low]);
                // A `PONG` has the length of the `PING` without flags and size; the context stays in place.
                (*four, *p) = (COMMAND, self.command as u8 - 2);
                (*i, *n, *g, *ttl, *low) = (4, b'P', b'O', b'N', b'G');
                self.pong = self.command as u8;
            }
            return;
        }
        let Some(metadata) = body.strip_prefix(b"\x05READY") else {
            return self.fail(Fault::Unexpected);
        };
        let name = property(metadata, b"Socket-Type");
        let known = |name| S::PARTNERS.iter().any(|(partner, _)| *partner == name);
        if name.is_some_and(known) {
            return self.on_handshake(Phase::Traffic);
        }
        self.end(Fault::SocketType, if S::BINDS { 3 } else { 4 });
    }

    fn on_handshake(&mut self, phase: Phase) {
        self.phase = phase;
        if phase == Phase::Traffic {
            self.hello_due = 3;
        }
    }
}

/// The value of a property, whose name is case-insensitive (RFC 37, The NULL Security Mechanism).
fn property<'a>(mut metadata: &'a [u8], wanted: &[u8]) -> Option<&'a [u8]> {
    loop {
        let (name, value, rest) = first_property(metadata)?;
        if name.eq_ignore_ascii_case(wanted) {
            return Some(value);
        }
        metadata = rest;
    }
}

/// Name and value of the first property, and what follows it; `None` if it is not complete.
#[inline(always)]
pub(crate) fn first_property(metadata: &[u8]) -> Option<(&[u8], &[u8], &[u8])> {
    let (&length, rest) = metadata.split_first()?;
    let (name, rest) = rest.split_at_checked(usize::from(length))?;
    let (size, rest) = rest.split_at_checked(4)?;
    let append = |size: usize, &byte: &u8| size << 8 | usize::from(byte);
    let (value, rest) = rest.split_at_checked(size.iter().fold(0, append))?;
    Some((name, value, rest))
}
