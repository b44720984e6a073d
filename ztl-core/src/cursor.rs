//! A position in a text.

use crate::text::is_blank;

/// A text and a reading position.
#[derive(Clone, Copy)]
pub(crate) struct Cursor<'a> {
    text: &'a str,
    /// Position in bytes.
    pub(crate) at: usize,
}

// Not inlining these methods, with the order of fields of `goal::Reader`, saves 190 bytes in the image `standard`.
impl<'a> Cursor<'a> {
    pub(crate) fn new(text: &'a str) -> Self {
        Self { text, at: 0 }
    }

    pub(crate) fn text(&self) -> &'a str {
        self.text
    }

    pub(crate) fn is_at_end(&self) -> bool {
        self.at == self.text.len()
    }

    /// The text between two positions; empty if either is not a character boundary.
    pub(crate) fn part(&self, start: usize, end: usize) -> &'a str {
        self.text.get(start..end).unwrap_or_default()
    }

    /// The byte `bytes` ahead; 0 past the end, like a NUL in the text.
    pub(crate) fn ahead(&self, bytes: usize) -> u8 {
        let at = self.at.wrapping_add(bytes);
        self.text.as_bytes().get(at).copied().unwrap_or(0)
    }

    /// The next byte; see [`ahead`](Self::ahead).
    pub(crate) fn peek(&self) -> u8 {
        self.ahead(0)
    }

    /// Consumes the next byte if it is `byte`, and returns whether it was.
    pub(crate) fn take(&mut self, byte: u8) -> bool {
        let there = self.peek() == byte;
        self.at += usize::from(there);
        there
    }

    /// Consumes an optional sign and returns whether it is `-`.
    pub(crate) fn take_sign(&mut self) -> bool {
        let negative = self.take(b'-');
        if !negative {
            self.take(b'+');
        }
        negative
    }

    /// Skips whitespace and returns the next byte without consuming it.
    pub(crate) fn skip_blanks(&mut self) -> u8 {
        while is_blank(self.peek()) {
            self.at += 1;
        }
        self.peek()
    }
}
