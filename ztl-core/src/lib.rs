#![doc = include_str!("../README.md")]
#![no_std]

#[cfg(test)]
extern crate std;

pub mod base64;
pub mod client;
#[cfg(feature = "serde")]
mod cursor;
pub mod dispatcher;
pub mod envelope;
#[cfg(feature = "serde")]
pub mod goal;
pub mod integer;
pub mod lifecycle;
pub mod link;
pub mod memory;
pub mod message;
pub mod reply;
pub mod repr;
pub mod sink;
pub mod spec;
pub mod tasks;
pub mod time;

pub use lifecycle::{Event, Request, State};
pub use message::Message;
pub use spec::TaskSpec;
pub use time::Instant;

/// Version of this crate, as `$ztl` reports it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The number that a server assigns to an accepted task, from 1 to `u32::MAX`; never reused while the server
/// runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TaskId(core::num::NonZeroU32);

impl TaskId {
    /// The id with this number, or `None` for 0, which means "not accepted" on the wire.
    #[must_use]
    pub const fn new(number: u32) -> Option<Self> {
        match core::num::NonZeroU32::new(number) {
            Some(number) => Some(Self(number)),
            None => None,
        }
    }

    /// The highest id.
    pub const MAX: Self = Self(core::num::NonZeroU32::MAX);

    /// The number as sent on the wire.
    #[must_use]
    pub const fn get(self) -> u32 {
        self.0.get()
    }

    /// The next id, or `None` after the last one: ids are never reused.
    #[must_use]
    pub fn next(self) -> Option<Self> {
        self.0.checked_add(1).map(Self)
    }
}

/// The longest valid UTF-8 prefix of `bytes`.
///
/// `from_utf8` is faster on long texts, but takes more flash.
#[must_use]
pub fn valid_start(bytes: &[u8]) -> &str {
    let chunk = bytes.utf8_chunks().next();
    chunk.map_or("", |chunk| chunk.valid())
}

/// Whether Python treats this ASCII byte as whitespace.
pub(crate) fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t'..=b'\r')
}

/// Splits `text` at the first `mark`, an ASCII character.
///
/// Used in place of `str::split_once`, whose panic branch the compiler cannot remove.
fn split_at_mark(text: &str, mark: char) -> Option<(&str, &str)> {
    let at = text.bytes().position(|byte| char::from(byte) == mark)?;
    Some((text.get(..at)?, text.get(at + 1..)?))
}

impl core::fmt::Display for TaskId {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.get().fmt(f)
    }
}
