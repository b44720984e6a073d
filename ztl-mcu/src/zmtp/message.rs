//! A message that has arrived, as a view over a connection's buffer.

use ztl_core::envelope::Envelope;

use super::wire::{DELIMITER, LONG, MORE};

/// A message: what stood before the empty delimiter, and what came after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Message<'a> {
    /// The frames before the delimiter.
    pub envelope: Frames<'a>,
    /// What the message says.
    pub content: Content<'a>,
}

/// What stood after the delimiter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Content<'a> {
    /// One frame.
    One(&'a [u8]),
    /// Several frames, which are dropped: nothing here sends such (wire specification 2.4).
    Several,
    /// A frame that is longer than the buffer, which is dropped.
    TooLong,
}

impl Message<'_> {
    /// Our clients' envelope: the two frames before the delimiter, if they are one.
    #[must_use]
    pub fn envelope(&self) -> Option<Envelope> {
        // As long as two of theirs with their headers, and the delimiter.
        let tail: &[u8; 34] = self.envelope.bytes.last_chunk()?;
        let headers = (&tail[..2], &tail[22..24], &tail[32..]);
        if headers != (&[MORE, 20], &[MORE, 8], &DELIMITER) {
            return None;
        }
        Envelope::parse(&tail[2..22], &tail[24..32])
    }
}

/// Frames one after the other, as they stand on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frames<'a> {
    pub(super) bytes: &'a [u8],
}

impl<'a> Iterator for Frames<'a> {
    type Item = &'a [u8];

    /// The next frame's body; none at the delimiter.
    fn next(&mut self) -> Option<&'a [u8]> {
        let (&flags, rest) = self.bytes.split_first()?;
        // Longer than 255 bytes only where a size of 8 bytes says so.
        let (size, rest) = match flags & LONG {
            0 => rest.split_at_checked(1)?,
            _ => rest.split_at_checked(8)?,
        };
        let append = |size: usize, &byte: &u8| size << 8 | usize::from(byte);
        let size = size.iter().fold(0, append);
        let (frame, rest) = rest.split_at_checked(size)?;
        self.bytes = rest;
        // The delimiter is the end.
        (size > 0).then_some(frame)
    }
}
