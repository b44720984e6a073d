//! Frames: `addr · seq · body · CRC-32`, COBS-encoded and terminated by a zero byte.
//!
//! The checksum also covers the session number, which is not sent, so a frame of another session is invalid. COBS is
//! implemented here because the streaming decoder of the crate `cobs` reports a truncated frame as complete after an
//! overrun. The CRC uses a table of 64 bytes instead of 1 KiB; a test compares it with the crate `crc`, whose variant
//! without a table takes 300 bytes.

use super::body::{Body, LinkCommand};
use super::wire::BodyError;
use crate::sink::{BufferTooSmall, Sink};

/// Address of the only node on a line; the nodes of a bus have others.
pub const ADDR_ONLY_NODE: u8 = 0;

/// A frame with a valid checksum, as a view of a decoder's buffer.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame<'a> {
    /// Address of the node: [`ADDR_ONLY_NODE`].
    pub addr: u8,
    /// Sequence number of the command, or of the command that it answers; 0 for `Hello` and all other frames.
    pub seq: u8,
    /// The message.
    pub body: Body<'a>,
}

/// A frame of a gateway, as a node parses it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CommandFrame<'a> {
    /// Index of the session that verified it.
    pub session_index: usize,
    /// Address of the node: [`ADDR_ONLY_NODE`].
    pub addr: u8,
    /// Sequence number of the command; 0 for `Hello` and `Ack`.
    pub seq: u8,
    /// The message.
    pub command: LinkCommand<'a>,
}

/// Why received bytes are not a frame. They are dropped and counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameError {
    /// The frame ends before its COBS blocks do, or is shorter than any frame.
    Truncated,
    /// The frame is longer than the buffer; dropped up to its delimiter.
    TooLong,
    /// The checksum is wrong: damaged, or of another session.
    Check,
    /// The checksum is valid but the body is not a message: another version.
    Body(BodyError),
}

impl core::fmt::Display for FrameError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Truncated => f.write_str("truncated frame"),
            Self::TooLong => f.write_str("frame longer than the buffer"),
            Self::Check => f.write_str("wrong checksum"),
            Self::Body(cause) => write!(f, "not a message: {cause}"),
        }
    }
}

impl core::error::Error for FrameError {}

/// Writes a frame of `session` into `buffer`, with its delimiter, and returns its length.
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

/// Writes a frame into a caller's buffer, piece by piece. Keeps counting when the buffer is full.
///
/// [`Body::put`] writes the body. If the message is known at compile time, firmware contains only the code for that
/// message. [`encode`] writes any message.
#[derive(Debug)]
pub struct FrameWriter<'a> {
    check: u32,
    buffer: &'a mut [u8],
    /// Position of the current block's code byte.
    code_at: usize,
    /// Position of the next byte.
    len: usize,
}

impl<'a> FrameWriter<'a> {
    /// Starts a frame of `session`.
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

    /// Puts `count` bytes that are in the buffer already, from position `start` on. They must be at least 4 bytes, plus one
    /// for each 254, behind the bytes written so far; otherwise they are overwritten before they are read.
    pub fn put_own(&mut self, start: usize, count: usize) {
        for at in start..start.saturating_add(count) {
            let byte = self.buffer.get(at).copied().unwrap_or_default();
            self.put(&[byte]);
        }
    }

    /// Completes the frame and returns its length with the delimiter; `None` if it does not fit the buffer.
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
        if let Some(slot) = self.buffer.get_mut(at) {
            *slot = byte;
        }
    }

    /// Writes the code byte of the block, its length plus 1, and reserves that of the next block.
    fn close_block(&mut self) {
        self.set(self.code_at, (self.len - self.code_at) as u8);
        self.code_at = self.len;
        self.len += 1;
    }
}

impl Sink for FrameWriter<'_> {
    fn put(&mut self, bytes: &[u8]) {
        self.check = checked(self.check, bytes);
        for &byte in bytes {
            // A full block is closed only if another byte follows.
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

/// CRC of each four bits. With this table a byte takes a third of the time of a bitwise CRC on a Cortex-M0.
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

/// The CRC-32/ISO-HDLC register after the session number, before the first byte.
pub(super) fn begin(session: u32) -> u32 {
    checked(u32::MAX, &session.to_le_bytes())
}

/// The CRC register after these bytes; the checksum is its complement.
// Not inlined and `step` inlined for speed; see the cycles in `examples/firmware/README.md`.
#[inline(never)]
pub(super) fn checked(mut check: u32, mut bytes: &[u8]) -> u32 {
    // Two bytes at a time, without an inner loop, because this dominates the time to receive a byte.
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
    // The index is always valid.
    let nibble = |check: u32| {
        let entry = NIBBLES.get(check as usize & 15).copied();
        check >> 4 ^ entry.unwrap_or_default()
    };
    nibble(nibble(check ^ u32::from(byte)))
}

#[cfg(test)]
mod tests {
    use super::super::decoder::Decoder;
    use super::*;
    use std::vec::Vec;

    #[test]
    fn the_checksum_is_crc_32_iso_hdlc() {
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

    /// Feeds `bytes` and returns the result at each delimiter.
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
    fn a_frame_round_trips_and_noise_before_it_is_dropped() {
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
    fn a_frame_of_another_session_is_invalid() {
        assert_eq!(
            decode::<16>(8, &encoded(7, &ping(3))),
            [Err(FrameError::Check)]
        );
    }

    #[test]
    fn a_frame_that_overruns_the_buffer_is_never_complete() {
        // Every prefix of a long frame, then a valid frame.
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
    fn every_length_around_the_block_size_round_trips() {
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
    fn a_frame_with_one_flipped_bit_is_dropped() {
        let good = encoded(7, &ping(3));
        for bit in 0..good.len() * 8 {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            bytes.push(0);
            assert!(
                decode::<16>(7, &bytes).iter().all(Result::is_err),
                "bit {bit}"
            );
        }
    }

    #[test]
    fn a_buffer_that_is_too_small_reports_the_needed_length() {
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
