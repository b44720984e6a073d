//! Base64 as the original reads and writes it: strict when writing, lenient when reading.
//!
//! Like Python's `b64decode`, the decoder skips every character outside the alphabet and stops at the padding
//! that completes a group. The crate `base64` takes six times as much flash on a Cortex-M0, and no crate is
//! lenient in exactly this way.

use crate::sink::Sink;

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/// Why a text is not valid base64.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DecodeError {
    /// The last group lacks its padding.
    IncorrectPadding,
    /// One character is left over, which encodes less than a byte.
    LoneCharacter {
        /// Number of alphabet characters found.
        characters: usize,
    },
    /// The caller's buffer is too small.
    BufferTooSmall {
        /// Size of the buffer in bytes.
        available: usize,
    },
}

impl core::fmt::Display for DecodeError {
    /// Uses the original's texts where it has them (`docs/protocol.md` [5.3]).
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::IncorrectPadding => f.write_str("Incorrect padding"),
            Self::LoneCharacter { characters } => write!(
                f,
                "Invalid base64-encoded string: number of data characters ({characters}) cannot be 1 more than a multiple of 4"
            ),
            Self::BufferTooSmall { available } => {
                write!(f, "task too long: at most {available} bytes fit")
            }
        }
    }
}

impl core::error::Error for DecodeError {}

/// Decodes `text` into `buffer` and returns the filled part.
///
/// A buffer of three quarters of the text's length is always large enough.
///
/// # Errors
/// [`DecodeError`] if the text is not valid base64 or `buffer` is too small.
pub fn decode<'b>(text: &[u8], buffer: &'b mut [u8]) -> Result<&'b [u8], DecodeError> {
    let available = buffer.len();
    let mut len = 0;
    let mut characters = 0usize;
    let mut pads = 0;
    let mut bits = 0u32;
    for &byte in text {
        let place = characters % 4;
        if let Some(six) = value(byte) {
            pads = 0;
            characters += 1;
            // Of these bits, 6, 12, 10 or 8 are not written yet, in this order within a group.
            bits = bits << 6 | u32::from(six);
            if place != 0 {
                *buffer
                    .get_mut(len)
                    .ok_or(DecodeError::BufferTooSmall { available })? =
                    (bits >> (6 - 2 * place)) as u8;
                len += 1;
            }
        } else if byte == b'=' && place >= 2 {
            pads += 1;
            if place + pads >= 4 {
                characters = 0;
                break;
            }
        }
    }
    match characters % 4 {
        0 => Ok(buffer.get(..len).unwrap_or_default()),
        1 => Err(DecodeError::LoneCharacter { characters }),
        _ => Err(DecodeError::IncorrectPadding),
    }
}

fn value(byte: u8) -> Option<u8> {
    Some(match byte {
        b'A'..=b'Z' => byte - b'A',
        b'a'..=b'z' => byte - b'a' + 26,
        b'0'..=b'9' => byte - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        _ => return None,
    })
}

/// A sink that encodes its input as base64 and passes it on.
///
/// Call [`finish`](Self::finish) at the end: it writes the last group and its padding.
#[derive(Debug)]
pub struct Encoder<'a, S: Sink + ?Sized> {
    out: &'a mut S,
    group: u32,
    /// Bytes in `group`, 0 to 2.
    held: u8,
}

impl<'a, S: Sink + ?Sized> Encoder<'a, S> {
    /// Creates an encoder that writes to `out`.
    pub fn new(out: &'a mut S) -> Self {
        Self {
            out,
            group: 0,
            held: 0,
        }
    }

    /// Writes the last group, padded with `=`.
    pub fn finish(self) {
        if self.held > 0 {
            let missing = 3 - self.held;
            let group = self.group << (8 * missing);
            put_group(self.out, group, usize::from(self.held) + 1);
        }
    }
}

impl<S: Sink + ?Sized> Sink for Encoder<'_, S> {
    fn put(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.group = self.group << 8 | u32::from(byte);
            self.held += 1;
            if self.held == 3 {
                put_group(self.out, self.group, 4);
                self.group = 0;
                self.held = 0;
            }
        }
    }
}

/// Writes the 24 bits of `group` as four characters; those after the first `used` are padding.
fn put_group(out: &mut (impl Sink + ?Sized), group: u32, used: usize) {
    let mut text = [b'='; 4];
    for (place, character) in text.iter_mut().enumerate().take(used) {
        let six = group >> (18 - 6 * place) & 0x3f;
        *character = ALPHABET.get(six as usize).copied().unwrap_or_default();
    }
    out.put(&text);
}
