//! Frames: `addr · seq · body · CRC-32`, COBS-encoded and ended by a zero byte.
//!
//! The check covers the session's number too, which is not sent: a frame of another session fails
//! it at no cost. COBS is a dozen lines each way, and the crate's streaming decoder reports a
//! truncated frame as complete after an overrun. So is the check, with a table of 64 bytes in place of
//! 1 KiB; a test compares it with the crate `crc`, whose own form without one takes 300 bytes.

use super::body::{Body, Command};
use super::wire::BodyError;
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

/// The same of a gateway, as a node reads it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CommandFrame<'a> {
    /// Index of the session that verified it.
    pub session_index: usize,
    /// Which node; [`ADDR_ONLY_NODE`].
    pub addr: u8,
    /// Which command it is; 0 for `Hello` and `Ack`.
    pub seq: u8,
    /// The message.
    pub command: Command<'a>,
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
    let mut writer = FrameWriter::new(session, frame.addr, frame.seq, buffer);
    frame.body.put(&mut writer);
    let (needed, available) = (writer.end(), writer.buffer.len());
    if needed <= available {
        Ok(needed)
    } else {
        Err(BufferTooSmall { needed, available })
    }
}

/// Writes a frame into a caller's buffer, piece by piece; counts on when that is full.
///
/// What is put is the body: [`Body::put`] does it, of whose code a firmware that knows the message takes only what that
/// needs. [`encode`] does all of it for any message.
#[derive(Debug)]
pub struct FrameWriter<'a> {
    check: u32,
    buffer: &'a mut [u8],
    /// Where the present block's code byte stands.
    code_at: usize,
    /// Where the next byte goes.
    len: usize,
}

impl<'a> FrameWriter<'a> {
    /// Begins a frame of `session`.
    #[cfg_attr(target_os = "none", inline(never))]
    #[must_use]
    pub fn new(session: u32, addr: u8, seq: u8, buffer: &'a mut [u8]) -> Self {
        let mut writer = Self {
            check: begin(session),
            buffer,
            code_at: 0,
            len: 1,
        };
        writer.put(&[addr, seq]);
        writer
    }

    /// Takes so many bytes that stand in the buffer already, from this place on: at least 4 bytes, and one for each 254,
    /// further back than what was put is long. Those nearer to the front are overwritten before they are taken.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn put_own(&mut self, place: usize, count: usize) {
        for at in place..place.saturating_add(count) {
            let byte = self.buffer.get(at).copied().unwrap_or_default();
            self.put(&[byte]);
        }
    }

    /// Ends the frame and returns its length, its delimiter included; `None` when it does not fit into the buffer.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn finish(mut self) -> Option<usize> {
        let len = self.end();
        (len <= self.buffer.len()).then_some(len)
    }

    fn end(&mut self) -> usize {
        let check = !self.check;
        self.put(&check.to_le_bytes());
        self.close_block();
        self.set(self.code_at, 0);
        self.len
    }

    fn set(&mut self, at: usize, byte: u8) {
        if let Some(place) = self.buffer.get_mut(at) {
            *place = byte;
        }
    }

    /// Writes the block's code, 1 and the bytes in it, and makes room for the next one's.
    #[cfg_attr(target_os = "none", inline(never))]
    fn close_block(&mut self) {
        self.set(self.code_at, (self.len - self.code_at) as u8);
        self.code_at = self.len;
        self.len += 1;
    }
}

impl Sink for FrameWriter<'_> {
    #[cfg_attr(target_os = "none", inline(never))]
    fn put(&mut self, bytes: &[u8]) {
        self.check = checked(self.check, bytes);
        for &byte in bytes {
            // A full block is closed only when another byte follows.
            if self.len - self.code_at == 0xff {
                self.close_block();
            }
            if byte == 0 {
                self.close_block();
            } else {
                self.set(self.len, byte);
                self.len += 1;
            }
        }
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

/// The check before the first byte: CRC-32/ISO-HDLC begins with the session's number.
fn begin(session: u32) -> u32 {
    checked(u32::MAX, &session.to_le_bytes())
}

/// The check after these bytes; its value is the complement.
#[inline(never)]
fn checked(mut check: u32, mut bytes: &[u8]) -> u32 {
    // By twos, and no loop within, since this is a good part of what receiving a byte takes.
    while let [first, second, rest @ ..] = bytes {
        check = step(step(check, *first), *second);
        bytes = rest;
    }
    if let [last] = bytes {
        check = step(check, *last);
    }
    check
}

#[inline(always)]
fn step(check: u32, byte: u8) -> u32 {
    // Both are always there.
    let nibble = |check: u32| {
        let entry = NIBBLES.get(check as usize & 15).copied();
        check >> 4 ^ entry.unwrap_or_default()
    };
    nibble(nibble(check ^ u32::from(byte)))
}

/// What bytes have ended, by [`Decoder::push_all`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Pushed {
    /// No frame yet.
    Nothing,
    /// A frame, which is now to be read.
    Frame,
    /// One that is dropped: [`FrameError::Truncated`].
    Truncated,
    /// One that is dropped: [`FrameError::TooLong`].
    TooLong,
}

/// Copies at most so many bytes, up to the first zero, as far as there is room; how many.
#[cfg_attr(target_os = "none", inline(never))]
fn copy(to: &mut [u8], from: &[u8], most: usize) -> usize {
    let mut count = 0;
    for (to, from) in to.iter_mut().zip(from).take(most) {
        if *from == 0 {
            break;
        }
        *to = *from;
        count += 1;
    }
    count
}

/// Takes a stream apart into frames of at most `N` decoded bytes (address, sequence, body, check).
///
/// After an overrun it stays deaf until the next delimiter, so a truncated frame is never taken
/// for a whole one.
#[derive(Clone)]
pub struct Decoder<const N: usize> {
    buffer: [u8; N],
    /// `N + 1` after an overrun.
    len: usize,
    /// Bytes left in the present COBS block.
    left: u8,
    /// Whether the present block ends in a zero that was taken out.
    zero: bool,
    /// The last byte completed a frame; the next one begins anew.
    complete: bool,
}

impl<const N: usize> Decoder<N> {
    /// What decides about all that is still to come; not what is left of frames before.
    fn state(&self) -> (&[u8], usize, u8, bool, bool) {
        let frame = self.buffer.get(..self.len).unwrap_or_default();
        (frame, self.len, self.left, self.zero, self.complete)
    }
}

/// Shows the bytes of the frame that is coming in, and not the whole buffer.
impl<const N: usize> core::fmt::Debug for Decoder<N> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (frame, ..) = self.state();
        f.debug_struct("Decoder")
            .field("frame", &frame)
            .field("overrun", &(self.len > N))
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
            complete: false,
        }
    }

    /// Forgets what has come of the present frame, after a reconnection.
    pub fn reset(&mut self) {
        self.len = 0;
        self.left = 0;
        self.zero = false;
        self.complete = false;
    }

    /// Whether part of a frame has come, and not its end.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        !self.complete && (self.len | self.left as usize | self.zero as usize) > 0
    }

    /// Takes the next byte. `true` when it ended a frame that is now to be read with
    /// [`frame`](Self::frame), before the next byte comes.
    ///
    /// # Errors
    /// [`FrameError::Truncated`] or [`FrameError::TooLong`], told at the delimiter.
    pub fn push(&mut self, byte: u8) -> Result<bool, FrameError> {
        match self.push_all(&mut [byte].as_slice()) {
            Pushed::Nothing => Ok(false),
            Pushed::Frame => Ok(true),
            Pushed::Truncated => Err(FrameError::Truncated),
            Pushed::TooLong => Err(FrameError::TooLong),
        }
    }

    /// Takes the next bytes, up to the end of a frame; those behind it are left in `bytes`. To be called again until
    /// none is left; the frame is to be read before.
    pub fn push_all(&mut self, bytes: &mut &[u8]) -> Pushed {
        if self.complete {
            self.reset();
        }
        let (mut len, mut left) = (self.len, usize::from(self.left));
        let mut taken = 0;
        let ended = loop {
            // Most bytes stand within a block.
            if let (Some(to), Some(from)) = (self.buffer.get_mut(len..), bytes.get(taken..)) {
                let count = copy(to, from, left);
                (taken, len, left) = (taken + count, len + count, left - count);
            }
            let Some(&byte) = bytes.get(taken) else {
                break false;
            };
            taken += 1;
            if byte == 0 {
                break true;
            }
            if left == 0 {
                left = usize::from(byte);
                len = self.begin_block(len, byte);
            } else {
                // There is no room for it.
                len = N + 1;
            }
            left -= 1;
        };
        *bytes = bytes.get(taken..).unwrap_or_default();
        (self.len, self.left) = (len, left as u8);
        if !ended {
            return Pushed::Nothing;
        }
        if len <= N && left == 0 {
            // A delimiter by itself flushes the line.
            self.complete = len > 0 || self.zero;
            return if self.complete {
                Pushed::Frame
            } else {
                Pushed::Nothing
            };
        }
        self.reset();
        if len > N {
            Pushed::TooLong
        } else {
            Pushed::Truncated
        }
    }

    /// Keeps the zero that the block before stands for; how many bytes there are then.
    fn begin_block(&mut self, len: usize, code: u8) -> usize {
        if !core::mem::replace(&mut self.zero, code != 0xff) {
            return len;
        }
        match self.buffer.get_mut(len) {
            Some(place) => {
                *place = 0;
                len + 1
            }
            None => N + 1,
        }
    }

    /// The frame that the last byte ended, if its check is right under one of the `sessions`.
    ///
    /// Says which of them it was, by its place.
    ///
    /// # Errors
    /// As [`FrameError`] says.
    pub fn frame(&self, sessions: &[u32]) -> Result<(usize, Frame<'_>), FrameError> {
        let (session_index, addr, seq, body) = self.checked(sessions)?;
        let body = Body::parse(body).map_err(FrameError::Body)?;
        Ok((session_index, Frame { addr, seq, body }))
    }

    /// As [`frame`](Self::frame), of a gateway only: for a node.
    ///
    /// # Errors
    /// As [`FrameError`] says; a node's messages are not known.
    pub fn command(&self, sessions: &[u32]) -> Result<CommandFrame<'_>, FrameError> {
        let (session_index, addr, seq, body) = self.checked(sessions)?;
        let command = Command::parse(body).map_err(FrameError::Body)?;
        Ok(CommandFrame {
            session_index,
            addr,
            seq,
            command,
        })
    }

    /// Which session it is of, the address, `seq`, and the body.
    fn checked(&self, sessions: &[u32]) -> Result<(usize, u8, u8, &[u8]), FrameError> {
        let whole = self.buffer.get(..self.len).unwrap_or_default();
        let (covered, sent) = whole.split_last_chunk::<4>().ok_or(FrameError::Truncated)?;
        let [addr, seq, body @ ..] = covered else {
            return Err(FrameError::Truncated);
        };
        let sent = u32::from_le_bytes(*sent);
        let session_index = sessions
            .iter()
            .position(|session| !checked(begin(*session), covered) == sent)
            .ok_or(FrameError::Check)?;
        Ok((session_index, *addr, *seq, body))
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
        let mut check = begin(0x0403_0201);
        for byte in 0..=255 {
            bytes.push(byte);
            check = checked(check, &[byte]);
            assert_eq!(!check, crate_check.checksum(&bytes));
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
