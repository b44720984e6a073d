//! The decoder of one device's log.

use std::path::Path;
use std::sync::Arc;

use super::args::Reader;
use super::message::Message;
use super::table::{ElfError, Encoding, Table};
use super::text;
use crate::files;

/// Longest ELF file that is read, in bytes.
const MAX_FILE: u64 = 1 << 30;
/// Longest encoded message; a longer one is dropped.
const LONGEST: usize = 64 * 1024;

/// Bytes that are not a message of this firmware: damaged, or from another build.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Malformed;

impl std::fmt::Display for Malformed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("not a message of this firmware")
    }
}

impl std::error::Error for Malformed {}

/// Decodes the log of one device. Work and memory are proportional to the length of any input.
#[derive(Debug)]
pub struct Decoder {
    table: Arc<Table>,
    /// Bytes of the next message.
    waiting: Vec<u8>,
    /// Skips to the end of a message that is too long or incomplete.
    skipping: bool,
}

impl Decoder {
    /// Creates a decoder from the content of the firmware's ELF file.
    ///
    /// # Errors
    /// [`ElfError`] if the file is not usable.
    fn of_elf(elf: &[u8]) -> Result<Self, ElfError> {
        Ok(Self {
            table: Arc::new(Table::of_elf(elf)?),
            waiting: Vec::new(),
            skipping: false,
        })
    }

    /// Creates a decoder from the firmware's ELF file.
    ///
    /// # Errors
    /// [`ElfError`] if the file is not usable.
    pub fn of_file(path: &Path) -> Result<Self, ElfError> {
        let elf = files::read(path, MAX_FILE).map_err(|error| ElfError::Read(error.to_string()))?;
        Self::of_elf(&elf)
    }

    /// Reports that bytes are missing before the next ones.
    pub fn skip(&mut self) {
        self.skipping = !self.waiting.is_empty() || self.skipping;
        self.waiting.clear();
    }

    /// Feeds the next bytes, split anywhere; passes each complete message to `out`.
    pub fn push(&mut self, bytes: &[u8], out: &mut dyn FnMut(Result<Message, Malformed>)) {
        match self.table.encoding {
            Encoding::Rzcobs => self.push_frames(bytes, out),
            Encoding::Raw => self.push_raw(bytes, out),
        }
    }

    fn push_frames(&mut self, bytes: &[u8], out: &mut dyn FnMut(Result<Message, Malformed>)) {
        for &byte in bytes {
            if byte != 0 {
                self.skipping |= self.waiting.len() >= LONGEST;
                if !self.skipping {
                    self.waiting.push(byte);
                }
                continue;
            }
            let frame = std::mem::take(&mut self.waiting);
            if std::mem::take(&mut self.skipping) {
                out(Err(Malformed));
            } else if !frame.is_empty() {
                let message = unstuffed(&frame).and_then(|frame| decode(&self.table, &frame));
                out(message.map(|(message, _)| message).ok_or(Malformed));
            }
        }
    }

    /// Without frame ends there is no resynchronisation after damage; pending bytes are dropped.
    fn push_raw(&mut self, bytes: &[u8], out: &mut dyn FnMut(Result<Message, Malformed>)) {
        self.waiting.extend_from_slice(bytes);
        while let Some((message, used)) = decode(&self.table, &self.waiting) {
            self.waiting.drain(..used.min(self.waiting.len()));
            out(Ok(message));
        }
        if self.waiting.len() > LONGEST {
            self.waiting.clear();
            out(Err(Malformed));
        }
    }
}

/// Decodes the message at the start of `bytes`; also returns its length.
fn decode(table: &Table, bytes: &[u8]) -> Option<(Message, usize)> {
    let mut reader = Reader::new(table, bytes);
    let entry = table.entry(reader.number()?)?;
    let level = entry.level?;
    let timestamp = match table.timestamp() {
        Some(format) => Some((format, reader.args(format)?)),
        None => None,
    };
    let args = reader.args(&entry.text)?;
    let message = Message {
        level,
        timestamp: timestamp.map(|(format, args)| text::of(table, format, &args)),
        text: text::of(table, &entry.text, &args),
        place: entry.place.clone(),
    };
    Some((message, bytes.len() - reader.left()))
}

/// Decodes a frame (defmt's book, "rzCOBS").
fn unstuffed(frame: &[u8]) -> Option<Vec<u8>> {
    // From end to start, as the encoding is defined.
    let mut message = Vec::new();
    let mut bytes = frame.iter().rev().copied();
    while let Some(mark) = bytes.next() {
        match mark {
            0 => return None,
            0x01..=0x7f => {
                for bit in (0..7).rev() {
                    let zero = mark & (1 << bit) != 0;
                    message.push(if zero { 0 } else { bytes.next()? });
                }
            }
            0x80..=0xfe => {
                message.push(0);
                for _ in 0..(mark & 0x7f) + 7 {
                    message.push(bytes.next()?);
                }
            }
            0xff => {
                for _ in 0..134 {
                    message.push(bytes.next()?);
                }
            }
        }
    }
    message.reverse();
    Some(message)
}

#[cfg(test)]
mod tests;
