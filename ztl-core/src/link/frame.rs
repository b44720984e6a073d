//! Frames: `addr · seq · body · CRC-32`, COBS-encoded and ended by a zero byte.
//!
//! The check covers the session's number too, which is not sent: a frame of another session fails
//! it at no cost. COBS is a dozen lines each way, and the crate's streaming decoder reports a
//! truncated frame as complete after an overrun. So is the check, with a table of 64 bytes in place of
//! 1 KiB; a test compares it with the crate `crc`, whose own form without one takes 300 bytes.

use super::body::{Body, BodyError};
use crate::sink::{BufferTooSmall, Sink};

/// `addr` when there is one node on the line; others are kept for shared buses.
pub const ADDR_ONLY_NODE: u8 = 0;

/// Bytes a frame adds to a body of at most 248 bytes: address, sequence, check, COBS, delimiter.
pub const OVERHEAD: usize = 8;

/// A frame whose check was right, as a view over a decoder's buffer.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Which node; [`ADDR_ONLY_NODE`].
    pub addr: u8,
    /// Which command it is or answers; 0 for `Hello` and for what answers nothing.
    pub seq: u8,
    /// The message.
    pub body: Body<'a>,
}

/// Why received bytes are no frame. Nothing changes by them, but a counter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// The frame ended before its COBS blocks did, or is shorter than any.
    Truncated,
    /// Longer than the buffer; dropped up to its delimiter.
    TooLong,
    /// The check is wrong: damaged, or of another session.
    Check,
    /// The check is right and the body is no message: another version's.
    Body(BodyError),
}

impl core::fmt::Display for FrameError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Truncated => f.write_str("truncated frame"),
            Self::TooLong => f.write_str("frame longer than the buffer"),
            Self::Check => f.write_str("wrong check"),
            Self::Body(cause) => write!(f, "no message: {cause}"),
        }
    }
}

impl core::error::Error for FrameError {}

/// Writes a frame for `session` into `buffer`, its delimiter included, and returns its length.
///
/// # Errors
/// [`BufferTooSmall`] with the length needed.
pub fn encode(session: u32, frame: &Frame<'_>, buffer: &mut [u8]) -> Result<usize, BufferTooSmall> {
    let mut writer = Writer {
        cobs: Cobs::new(buffer),
        check: Check::of(session),
    };
    writer.put(&[frame.addr, frame.seq]);
    frame.body.put(&mut writer);
    let Writer { mut cobs, check } = writer;
    cobs.put(&check.value().to_le_bytes());
    cobs.finish()
}

/// CRC-32/ISO-HDLC over the session's number and what is put.
struct Check(u32);

impl Check {
    fn of(session: u32) -> Self {
        let mut check = Self(u32::MAX);
        check.put(&session.to_le_bytes());
        check
    }

    fn value(&self) -> u32 {
        !self.0
    }
}

/// What four bits do to the check. A byte takes a Cortex-M0 a third of the time that it does bit by bit.
static NIBBLES: [u32; 16] = {
    let mut table = [0; 16];
    let mut rest = table.as_mut_slice();
    let mut nibble = 0u32;
    while let Some((entry, others)) = rest.split_first_mut() {
        let mut value = nibble;
        let mut bit = 0;
        while bit < 4 {
            value = value >> 1 ^ 0xEDB8_8320 & (value & 1).wrapping_neg();
            bit += 1;
        }
        *entry = value;
        nibble += 1;
        rest = others;
    }
    table
};

impl Sink for Check {
    #[inline(never)]
    fn put(&mut self, bytes: &[u8]) {
        let mut check = self.0;
        for &byte in bytes {
            check ^= u32::from(byte);
            for _ in 0..2 {
                // Always there.
                let entry = NIBBLES.get(check as usize & 15).copied();
                check = check >> 4 ^ entry.unwrap_or_default();
            }
        }
        self.0 = check;
    }
}

struct Writer<'a> {
    cobs: Cobs<'a>,
    check: Check,
}

impl Sink for Writer<'_> {
    fn put(&mut self, bytes: &[u8]) {
        self.check.put(bytes);
        self.cobs.put(bytes);
    }
}

/// Consistent Overhead Byte Stuffing into a caller's buffer; counts on when that is full.
struct Cobs<'a> {
    buffer: &'a mut [u8],
    /// Where the present block's code byte stands.
    code_at: usize,
    /// The present block's code: 1 and the bytes in it.
    code: u8,
    /// Where the next byte goes.
    len: usize,
}

impl<'a> Cobs<'a> {
    fn new(buffer: &'a mut [u8]) -> Self {
        Self {
            buffer,
            code_at: 0,
            code: 1,
            len: 1,
        }
    }

    fn set(&mut self, at: usize, byte: u8) {
        if let Some(place) = self.buffer.get_mut(at) {
            *place = byte;
        }
    }

    fn close_block(&mut self) {
        self.set(self.code_at, self.code);
        self.code_at = self.len;
        self.code = 1;
        self.len += 1;
    }

    fn finish(mut self) -> Result<usize, BufferTooSmall> {
        self.set(self.code_at, self.code);
        self.set(self.len, 0);
        let needed = self.len + 1;
        let available = self.buffer.len();
        if needed <= available {
            Ok(needed)
        } else {
            Err(BufferTooSmall { needed, available })
        }
    }
}

impl Sink for Cobs<'_> {
    fn put(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            // A full block is closed only when another byte follows.
            if self.code == 0xff {
                self.close_block();
            }
            if byte == 0 {
                self.close_block();
            } else {
                self.set(self.len, byte);
                self.len += 1;
                self.code += 1;
            }
        }
    }
}

/// Takes a stream apart into frames of at most `N` decoded bytes (address, sequence, body, check).
///
/// After an overrun it stays deaf until the next delimiter, so a truncated frame is never taken
/// for a whole one.
#[derive(Clone)]
pub struct Decoder<const N: usize> {
    buffer: [u8; N],
    len: usize,
    /// Bytes left in the present COBS block.
    left: u8,
    /// Whether the present block ends in a zero that was taken out.
    zero: bool,
    poisoned: bool,
    /// The last byte completed a frame; the next one begins anew.
    complete: bool,
}

impl<const N: usize> Decoder<N> {
    /// What decides about all that is still to come; not what is left of frames before.
    fn state(&self) -> (&[u8], u8, bool, bool, bool) {
        let frame = self.buffer.get(..self.len).unwrap_or_default();
        (frame, self.left, self.zero, self.poisoned, self.complete)
    }
}

/// Shows the bytes of the frame that is coming in, and not the whole buffer.
impl<const N: usize> core::fmt::Debug for Decoder<N> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (frame, ..) = self.state();
        f.debug_struct("Decoder")
            .field("frame", &frame)
            .field("poisoned", &self.poisoned)
            .finish_non_exhaustive()
    }
}

impl<const N: usize> PartialEq for Decoder<N> {
    fn eq(&self, other: &Self) -> bool {
        self.state() == other.state()
    }
}

impl<const N: usize> Eq for Decoder<N> {}

impl<const N: usize> core::hash::Hash for Decoder<N> {
    fn hash<H: core::hash::Hasher>(&self, hasher: &mut H) {
        self.state().hash(hasher);
    }
}

impl<const N: usize> Default for Decoder<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> Decoder<N> {
    /// A decoder at the start of a frame.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            buffer: [0; N],
            len: 0,
            left: 0,
            zero: false,
            poisoned: false,
            complete: false,
        }
    }

    /// Forgets what has come of the present frame, after a reconnection.
    pub fn reset(&mut self) {
        self.len = 0;
        self.left = 0;
        self.zero = false;
        self.poisoned = false;
        self.complete = false;
    }

    /// Whether part of a frame has come, and not its end.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        !self.complete && (self.len > 0 || self.left > 0 || self.zero || self.poisoned)
    }

    /// Takes the next byte. `true` when it ended a frame that is now to be read with
    /// [`frame`](Self::frame), before the next byte comes.
    ///
    /// # Errors
    /// [`FrameError::Truncated`] or [`FrameError::TooLong`], told at the delimiter.
    pub fn push(&mut self, byte: u8) -> Result<bool, FrameError> {
        if self.complete {
            self.reset();
        }
        if byte != 0 {
            self.push_data(byte);
            return Ok(false);
        }
        let (poisoned, left, len) = (self.poisoned, self.left, self.len);
        let empty = len == 0 && !self.zero && left == 0;
        if poisoned || left != 0 || empty {
            self.reset();
            return match (poisoned, empty) {
                (true, _) => Err(FrameError::TooLong),
                // A delimiter by itself flushes the line.
                (false, true) => Ok(false),
                (false, false) => Err(FrameError::Truncated),
            };
        }
        self.complete = true;
        Ok(true)
    }

    fn push_data(&mut self, byte: u8) {
        if self.left == 0 {
            if self.zero {
                self.keep(0);
            }
            self.left = byte - 1;
            self.zero = byte != 0xff;
        } else {
            self.left -= 1;
            self.keep(byte);
        }
    }

    fn keep(&mut self, byte: u8) {
        match self.buffer.get_mut(self.len) {
            Some(place) => {
                *place = byte;
                self.len += 1;
            }
            None => self.poisoned = true,
        }
    }

    /// The frame that the last byte ended, if its check is right under one of the `sessions`.
    ///
    /// Says which of them it was, by its place.
    ///
    /// # Errors
    /// As [`FrameError`] says.
    pub fn frame(&self, sessions: &[u32]) -> Result<(usize, Frame<'_>), FrameError> {
        self.read(sessions, Body::parse)
    }

    /// As [`frame`](Self::frame), of a gateway only: for a node.
    ///
    /// # Errors
    /// As [`FrameError`] says; a node's messages are not known.
    pub fn command(&self, sessions: &[u32]) -> Result<(usize, Frame<'_>), FrameError> {
        self.read(sessions, Body::parse_command)
    }

    #[inline(always)] // Else both readers stand in a node's firmware.
    fn read<'a>(
        &'a self,
        sessions: &[u32],
        parse: impl Fn(&'a [u8]) -> Result<Body<'a>, BodyError>,
    ) -> Result<(usize, Frame<'a>), FrameError> {
        let whole = self.buffer.get(..self.len).unwrap_or_default();
        let (covered, sent) = whole.split_last_chunk::<4>().ok_or(FrameError::Truncated)?;
        let [addr, seq, body @ ..] = covered else {
            return Err(FrameError::Truncated);
        };
        let sent = u32::from_le_bytes(*sent);
        let place = sessions
            .iter()
            .position(|session| {
                let mut check = Check::of(*session);
                check.put(covered);
                check.value() == sent
            })
            .ok_or(FrameError::Check)?;
        let body = parse(body).map_err(FrameError::Body)?;
        let (addr, seq) = (*addr, *seq);
        Ok((place, Frame { addr, seq, body }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn the_check_is_crc_32_iso_hdlc() {
        let crate_check = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
        let mut bytes = 0x0403_0201u32.to_le_bytes().to_vec();
        let mut check = Check::of(0x0403_0201);
        for byte in 0..=255 {
            bytes.push(byte);
            check.put(&[byte]);
            assert_eq!(check.value(), crate_check.checksum(&bytes));
        }
    }

    fn ping(seq: u8) -> Frame<'static> {
        Frame {
            addr: ADDR_ONLY_NODE,
            seq,
            body: Body::Ping,
        }
    }

    fn encoded(session: u32, frame: &Frame<'_>) -> Vec<u8> {
        let mut buffer = [0xA5; 600];
        let len = encode(session, frame, &mut buffer).unwrap();
        buffer[..len].to_vec()
    }

    /// Feeds `bytes` and gives back what each delimiter brought.
    fn decode<const N: usize>(session: u32, bytes: &[u8]) -> Vec<Result<u8, FrameError>> {
        let mut decoder = Decoder::<N>::new();
        let mut seen = Vec::new();
        for &byte in bytes {
            match decoder.push(byte) {
                Ok(false) => {}
                Ok(true) => seen.push(decoder.frame(&[session]).map(|(_, frame)| frame.seq)),
                Err(error) => seen.push(Err(error)),
            }
        }
        seen
    }

    #[test]
    fn a_frame_comes_back_and_noise_before_it_is_dropped() {
        let mut bytes = std::vec![0x31, 0x00];
        bytes.extend(encoded(7, &ping(3)));
        bytes.extend([0, 0]);
        bytes.extend(encoded(7, &ping(4)));
        assert_eq!(
            decode::<16>(7, &bytes),
            [Err(FrameError::Truncated), Ok(3), Ok(4)]
        );
    }

    #[test]
    fn a_frame_of_another_session_fails_the_check() {
        assert_eq!(
            decode::<16>(8, &encoded(7, &ping(3))),
            [Err(FrameError::Check)]
        );
    }

    #[test]
    fn a_frame_that_overruns_the_buffer_is_never_taken_for_a_whole_one() {
        // Every prefix of a long frame, delimited, and then a good frame.
        let goal = "x".repeat(40);
        let start = Body::Start {
            task: super::super::LinkId(1),
            component: 0,
            goal: &goal,
            before_ms: 0,
        };
        let long = encoded(
            7,
            &Frame {
                addr: 0,
                seq: 1,
                body: start,
            },
        );
        for cut in 1..long.len() {
            let mut bytes = long[..cut].to_vec();
            bytes.push(0);
            bytes.extend(encoded(7, &ping(9)));
            let seen = decode::<16>(7, &bytes);
            assert!(seen[0].is_err(), "cut after {cut}: {seen:?}");
            assert_eq!(seen[1], Ok(9));
        }
    }

    #[test]
    fn every_length_around_the_block_size_comes_back_whole() {
        for len in 0..600 {
            for fill in ["x", "\0"] {
                let goal = fill.repeat(len);
                let start = Body::Start {
                    task: super::super::LinkId(1),
                    component: 0,
                    goal: &goal,
                    before_ms: 0,
                };
                let mut buffer = [0xA5; 700];
                let frame = Frame {
                    addr: 0,
                    seq: 1,
                    body: start,
                };
                let used = encode(7, &frame, &mut buffer).unwrap();
                assert!(!buffer[..used - 1].contains(&0), "a zero inside the frame");
                let mut decoder = Decoder::<700>::new();
                for &byte in &buffer[..used - 1] {
                    assert_eq!(decoder.push(byte), Ok(false));
                }
                assert_eq!(decoder.push(0), Ok(true));
                assert_eq!(decoder.frame(&[7]).unwrap().1, frame);
            }
        }
    }

    #[test]
    fn one_flipped_bit_anywhere_changes_nothing_but_a_counter() {
        let good = encoded(7, &ping(3));
        for place in 0..good.len() * 8 {
            let mut bytes = good.clone();
            bytes[place / 8] ^= 1 << (place % 8);
            bytes.push(0);
            assert!(
                decode::<16>(7, &bytes).iter().all(Result::is_err),
                "bit {place}"
            );
        }
    }

    #[test]
    fn a_buffer_too_small_says_what_is_needed() {
        let whole = encoded(7, &ping(3)).len();
        let mut buffer = [0xA5; 4];
        assert_eq!(
            encode(7, &ping(3), &mut buffer),
            Err(BufferTooSmall {
                needed: whole,
                available: 4
            })
        );
    }
}
