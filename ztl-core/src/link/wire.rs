//! Values in postcard's wire format: varints, byte strings, and little-endian floats.

use super::link_id::LinkId;
use crate::sink::Sink;

/// Why bytes are not a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum BodyError {
    /// They end too early.
    Truncated,
    /// More bytes follow the message.
    Trailing {
        /// How many.
        extra: usize,
    },
    /// No message has this number.
    UnknownTag {
        /// The number.
        tag: u32,
    },
    /// An invalid value: a number that is too large, a state that is not final, text that is not UTF-8.
    BadValue,
}

impl core::fmt::Display for BodyError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Truncated => f.write_str("too short"),
            Self::Trailing { extra } => write!(f, "{extra} bytes too long"),
            Self::UnknownTag { tag } => write!(f, "unknown message {tag}"),
            Self::BadValue => f.write_str("meaningless value"),
        }
    }
}

impl core::error::Error for BodyError {}

/// Writes encoded values to a sink.
///
/// Each method returns the sink: on a Cortex-M0 it then stays in its register for the next call.
// The inline attributes here and of `Body::put` together save 584 bytes in `microbit-smallest`.
pub(super) trait WriteValues: Sink {
    fn byte(&mut self, byte: u8) -> &mut Self;

    fn long(&mut self, number: u64) -> &mut Self;

    fn number(&mut self, number: u32) -> &mut Self;

    fn bytes(&mut self, bytes: &[u8]) -> &mut Self;

    fn tagged(&mut self, tag: u8, task: LinkId) -> &mut Self;
}

impl<S: Sink + ?Sized> WriteValues for S {
    fn byte(&mut self, byte: u8) -> &mut Self {
        self.put(&[byte]);
        self
    }

    fn long(&mut self, number: u64) -> &mut Self {
        // In two halves: on a Cortex-M0 a 64-bit shift is a library call.
        let (mut low, mut high) = (number as u32, (number >> 32) as u32);
        while high > 0 || low >= 0x80 {
            self.byte(low as u8 | 0x80);
            low = low >> 7 | high << 25;
            high >>= 7;
        }
        self.byte(low as u8)
    }

    fn number(&mut self, number: u32) -> &mut Self {
        self.long(number.into())
    }

    fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.number(bytes.len() as u32).put(bytes);
        self
    }

    fn tagged(&mut self, tag: u8, task: LinkId) -> &mut Self {
        self.byte(tag).number(task.0)
    }
}

/// Reads encoded values. After the first missing or invalid value, all others read as zero or empty, and
/// [`finish`](Self::finish) returns the error. So reading a value takes a call but no branch.
pub(super) struct Reader<'a> {
    rest: &'a [u8],
    error: Option<BodyError>,
}

impl<'a> Reader<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: bytes,
            error: None,
        }
    }

    pub(super) fn finish<T>(self, value: T) -> Result<T, BodyError> {
        match (self.error, self.rest.len()) {
            (Some(error), _) => Err(error),
            (None, 0) => Ok(value),
            (None, extra) => Err(BodyError::Trailing { extra }),
        }
    }

    /// Whether all bytes are read.
    pub(super) const fn is_at_end(&self) -> bool {
        self.rest.is_empty()
    }

    pub(super) fn fail<T>(&mut self, error: BodyError, fallback: T) -> T {
        self.end(error);
        fallback
    }

    fn end(&mut self, error: BodyError) {
        self.error.get_or_insert(error);
        self.rest = &[];
    }

    // Not inlined in firmware: that saves 260 bytes in `microbit-parameters`, 68 in `microbit`.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn u8(&mut self) -> u8 {
        match self.rest.split_first() {
            Some((first, rest)) => {
                self.rest = rest;
                *first
            }
            None => self.fail(BodyError::Truncated, 0),
        }
    }

    pub(super) fn u64(&mut self) -> u64 {
        let end = self.rest.iter().position(|byte| *byte < 0x80);
        let number = end.and_then(|end| self.rest.split_at_checked(end + 1));
        let Some((bytes, rest)) = number else {
            return self.fail(BodyError::Truncated, 0);
        };
        // The tenth byte contains the last bit.
        if bytes.len() > 10 || bytes.get(9).is_some_and(|tenth| *tenth > 1) {
            return self.fail(BodyError::BadValue, 0);
        }
        self.rest = rest;
        // In two halves: on a Cortex-M0 a 64-bit shift is a library call.
        let (mut low, mut high) = (0u32, 0u32);
        for byte in bytes.iter().rev() {
            high = high << 7 | low >> 25;
            low = low << 7 | u32::from(byte & 0x7f);
        }
        u64::from(high) << 32 | u64::from(low)
    }

    pub(super) fn u32(&mut self) -> u32 {
        match u32::try_from(self.u64()) {
            Ok(value) => value,
            Err(_) => self.fail(BodyError::BadValue, 0),
        }
    }

    pub(super) fn u16(&mut self) -> u16 {
        match u16::try_from(self.u64()) {
            Ok(value) => value,
            Err(_) => self.fail(BodyError::BadValue, 0),
        }
    }

    pub(super) fn f32(&mut self) -> f32 {
        f32::from_le_bytes([self.u8(), self.u8(), self.u8(), self.u8()])
    }

    pub(super) fn bytes(&mut self) -> &'a [u8] {
        let len = usize::try_from(self.u32()).unwrap_or(usize::MAX);
        match self.rest.split_at_checked(len) {
            Some((bytes, rest)) => {
                self.rest = rest;
                bytes
            }
            None => self.fail(BodyError::Truncated, &[]),
        }
    }

    pub(super) fn text(&mut self) -> &'a str {
        let bytes = self.bytes();
        self.valid(bytes)
    }

    pub(super) fn valid(&mut self, bytes: &'a [u8]) -> &'a str {
        match core::str::from_utf8(bytes) {
            Ok(text) => text,
            Err(_) => self.fail(BodyError::BadValue, ""),
        }
    }

    /// Skips this many numbers, and returns their bytes.
    pub(super) fn numbers(&mut self, count: usize) -> &'a [u8] {
        let start = self.rest;
        for _ in 0..count {
            self.u32();
            if self.error.is_some() {
                break;
            }
        }
        let used = start.len() - self.rest.len();
        start.get(..used).unwrap_or_default()
    }

    pub(super) fn task(&mut self) -> LinkId {
        LinkId(self.u32())
    }
}
