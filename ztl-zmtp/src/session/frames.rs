//! Frames as they are on the wire (RFC 37, Framing).

use crate::fault::Fault;
use crate::wire::{COMMAND, LONG, MORE};

/// A complete message: its frames, as on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Message<'a> {
    pub(super) bytes: &'a [u8],
}

impl<'a> Message<'a> {
    /// The bodies of the frames.
    pub fn frames(self) -> impl Iterator<Item = &'a [u8]> {
        let mut rest = self.bytes;
        core::iter::from_fn(move || {
            let (header, size) = header(rest).ok()??;
            let (frame, after) = rest.get(header..)?.split_at_checked(size)?;
            rest = after;
            Some(frame)
        })
    }

    /// The frames before the first empty one, as on the wire; then the only frame after it, or `None` if there are none
    /// or several. `None` without an empty frame.
    #[must_use]
    pub fn split(self) -> Option<(&'a [u8], Option<&'a [u8]>)> {
        let mut end = 0;
        let content = loop {
            let (length, size) = header(self.bytes.get(end..)?).ok()??;
            if size == 0 {
                break end + length;
            }
            end += length + size;
        };
        let (envelope, content) = (self.bytes.get(..end)?, self.bytes.get(content..)?);
        let mut frames = Message { bytes: content }.frames();
        let only = frames.next().filter(|_| frames.next().is_none());
        Some((envelope, only))
    }

    /// The frames before the last one, as on the wire, and the last one.
    #[must_use]
    pub fn split_last(self) -> (&'a [u8], &'a [u8]) {
        let mut at = 0;
        while let Ok(Some((length, size))) = header(self.bytes.get(at..).unwrap_or_default()) {
            let end = at + length + size;
            if end >= self.bytes.len() {
                let last = self.bytes.get(at + length..).unwrap_or_default();
                return (self.bytes.get(..at).unwrap_or_default(), last);
            }
            at = end;
        }
        (self.bytes, &[])
    }
}

/// The lengths of the header and the body of the frame that begins here; `None` if the header is not complete.
pub(super) fn header(bytes: &[u8]) -> Result<Option<(usize, usize)>, Fault> {
    let Some((&flags, rest)) = bytes.split_first() else {
        return Ok(None);
    };
    if flags & !(COMMAND | LONG | MORE) != 0 || flags & (COMMAND | MORE) == COMMAND | MORE {
        return Err(Fault::Flags);
    }
    if flags & LONG == 0 {
        return Ok(rest.first().map(|&size| (2, usize::from(size))));
    }
    let Some(size) = rest.first_chunk() else {
        return Ok(None);
    };
    // Also where a length has 32 bits.
    let size = usize::try_from(u64::from_be_bytes(*size)).map_err(|_| Fault::TooLong)?;
    Ok(Some((9, size)))
}

/// The header of a frame with these flags and a body of this length, in the shortest form.
pub(crate) fn put_header(flags: u8, size: usize, out: &mut alloc::vec::Vec<u8>) {
    match u8::try_from(size) {
        Ok(size) => out.extend_from_slice(&[flags, size]),
        Err(_) => {
            out.push(flags | LONG);
            out.extend_from_slice(&(size as u64).to_be_bytes());
        }
    }
}

/// What begins a buffer.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Scan {
    /// Part of a message or command.
    Incomplete,
    /// A message of this length.
    Message(usize),
    /// A command: where its frame begins, where its body, and where both end. It may be between the frames of a
    /// message.
    Command(usize, usize, usize),
}

/// Looks for the end of a message, from the frame that begins at `from`. No frame may be longer than `most`, and all
/// together with their headers not longer than `total`.
pub(super) fn scan(
    bytes: &[u8],
    from: &mut usize,
    most: usize,
    total: usize,
) -> Result<Scan, Fault> {
    loop {
        let rest = bytes.get(*from..).unwrap_or_default();
        let Some((length, size)) = header(rest)? else {
            return Ok(Scan::Incomplete);
        };
        let body = *from + length;
        let end = body.checked_add(size);
        let end = end.filter(|end| size <= most && *end <= total);
        let end = end.ok_or(Fault::TooLong)?;
        if end > bytes.len() {
            return Ok(Scan::Incomplete);
        }
        let flags = rest.first().copied().unwrap_or_default();
        if flags & COMMAND != 0 {
            return Ok(Scan::Command(*from, body, end));
        }
        *from = end;
        if flags & MORE == 0 {
            *from = 0;
            return Ok(Scan::Message(end));
        }
    }
}
