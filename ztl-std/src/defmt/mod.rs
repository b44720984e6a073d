//! What firmware logs by `defmt`: bytes on the link, made readable with the firmware's ELF file.
//!
//! `defmt-decoder` does the same for a debugger's user. It is not used here: it allocates what a
//! damaged stream or another firmware's file asks for, and it switches on a feature of `serde_json`
//! that changes how everything else in the process is read.

mod args;
mod table;
mod text;

use std::path::Path;
use std::sync::Arc;

pub use table::ElfError;
use table::{Encoding, Table};

/// Longest encoded message; a longer one is dropped.
const LONGEST: usize = 64 * 1024;

/// How grave a message is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// `defmt::trace!`
    Trace,
    /// `defmt::debug!`
    Debug,
    /// `defmt::info!`
    Info,
    /// `defmt::warn!`
    Warn,
    /// `defmt::error!`
    Error,
}

/// A message that firmware has logged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// `None` for `defmt::println!`.
    pub level: Option<Level>,
    /// By the firmware's clock, if it has one for its log.
    pub timestamp: Option<String>,
    /// What it says.
    pub text: String,
    /// `src/main.rs:42`, when the file has debug information.
    pub place: Option<String>,
}

/// Bytes that are no message of this firmware: damaged, or of another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Malformed;

impl std::fmt::Display for Malformed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("no message of this firmware")
    }
}

impl std::error::Error for Malformed {}

/// Decodes the log of one device. Work and memory are bounded by the bytes given, whatever they are.
#[derive(Debug)]
pub struct Decoder {
    table: Arc<Table>,
    /// What has come of the next message.
    waiting: Vec<u8>,
    /// The message is too long, or its beginning is not known: dropped up to its end.
    skipping: bool,
}

impl Decoder {
    /// With the content of the firmware's ELF file.
    ///
    /// # Errors
    /// As [`ElfError`] says.
    pub fn of_elf(elf: &[u8]) -> Result<Self, ElfError> {
        Ok(Self {
            table: Arc::new(Table::of_elf(elf)?),
            waiting: Vec::new(),
            skipping: false,
        })
    }

    /// With the firmware's ELF file.
    ///
    /// # Errors
    /// As [`ElfError`] says.
    pub fn of_file(path: &Path) -> Result<Self, ElfError> {
        let elf = std::fs::read(path).map_err(|error| ElfError::Read(error.to_string()))?;
        Self::of_elf(&elf)
    }

    /// Some bytes are missing before those that come next.
    pub fn skip(&mut self) {
        self.skipping = !self.waiting.is_empty() || self.skipping;
        self.waiting.clear();
    }

    /// The next bytes, cut anywhere; each message that is whole goes to `out`.
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
                let message = unstuffed(&frame).and_then(|frame| self.table.message(&frame));
                out(message.map(|(message, _)| message).ok_or(Malformed));
            }
        }
    }

    /// Without ends of messages there is no way back after damage; what waits is given up.
    fn push_raw(&mut self, bytes: &[u8], out: &mut dyn FnMut(Result<Message, Malformed>)) {
        self.waiting.extend_from_slice(bytes);
        while let Some((message, used)) = self.table.message(&self.waiting) {
            self.waiting.drain(..used.min(self.waiting.len()));
            out(Ok(message));
        }
        if self.waiting.len() > LONGEST {
            self.waiting.clear();
            out(Err(Malformed));
        }
    }
}

/// A message as it was before it got its ends (defmt's book, "rzCOBS").
fn unstuffed(frame: &[u8]) -> Option<Vec<u8>> {
    // From its end to its beginning, as it is defined.
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
