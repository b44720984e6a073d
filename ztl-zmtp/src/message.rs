//! A received message, as a view of a connection's buffer.

use ztl_core::envelope::Envelope;

use super::wire::{DELIMITER, LONG, MORE};

/// A message: the frames before the empty delimiter, and the content after it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Message<'a> {
    /// The frames before the delimiter.
    pub envelope: Frames<'a>,
    /// The content after the delimiter.
    pub content: Content<'a>,
}

/// The part of a message after its delimiter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Content<'a> {
    /// One frame.
    One(&'a [u8]),
    /// Several frames, which are dropped: no client sends them (wire specification 2.4).
    Several,
    /// A frame that is longer than the buffer and was dropped.
    TooLong,
}

impl Message<'_> {
    /// Our clients' envelope, if the last two frames before the delimiter form one.
    #[must_use]
    pub fn envelope(&self) -> Option<Envelope> {
        envelope(self.envelope.bytes)
    }
}

/// Our clients' envelope, if the last two of these frames before the delimiter form one. A proxy puts its own frames
/// before them.
#[must_use]
pub fn envelope(frames: &[u8]) -> Option<Envelope> {
    // The length of the two frames with their headers, and the delimiter.
    let tail: &[u8; 34] = frames.last_chunk()?;
    let headers = (&tail[..2], &tail[22..24], &tail[32..]);
    if headers != (&[MORE, 20], &[MORE, 8], &DELIMITER) {
        return None;
    }
    Envelope::parse(&tail[2..22], &tail[24..32])
}

/// Consecutive frames, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frames<'a> {
    pub(crate) bytes: &'a [u8],
}

impl<'a> Iterator for Frames<'a> {
    type Item = &'a [u8];

    /// The next frame's body; `None` at the delimiter.
    fn next(&mut self) -> Option<&'a [u8]> {
        let (&flags, rest) = self.bytes.split_first()?;
        // A size of 8 bytes announces more than 255.
        let (size, rest) = match flags & LONG {
            0 => rest.split_at_checked(1)?,
            _ => rest.split_at_checked(8)?,
        };
        let append = |size: usize, &byte: &u8| size << 8 | usize::from(byte);
        let size = size.iter().fold(0, append);
        let (frame, rest) = rest.split_at_checked(size)?;
        self.bytes = rest;
        // An empty frame is the delimiter.
        (size > 0).then_some(frame)
    }
}
