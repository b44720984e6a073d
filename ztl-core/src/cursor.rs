//! A place in a text.

use crate::is_blank;

/// A text, and how much of it is read.
///
/// Its methods are functions of their own in firmware, where each inlined is larger than a call;
/// elsewhere they are inlined, since a call takes longer.
#[derive(Clone, Copy)]
pub(crate) struct Cursor<'a> {
    text: &'a str,
    /// Bytes read.
    pub(crate) at: usize,
}

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

    /// What stands between two places; empty unless these are boundaries of characters.
    pub(crate) fn part(&self, start: usize, end: usize) -> &'a str {
        self.text.get(start..end).unwrap_or_default()
    }

    /// The byte so far ahead; 0 behind the end, and for a 0 in the text.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn ahead(&self, bytes: usize) -> u8 {
        let at = self.at.wrapping_add(bytes);
        self.text.as_bytes().get(at).copied().unwrap_or(0)
    }

    /// The next byte, as [`ahead`](Self::ahead).
    pub(crate) fn peek(&self) -> u8 {
        self.ahead(0)
    }

    /// Reads this byte, if it is the next.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn take(&mut self, byte: u8) -> bool {
        let there = self.peek() == byte;
        self.at += usize::from(there);
        there
    }

    /// Reads a sign, if there is one; whether it is `-`.
    pub(crate) fn take_sign(&mut self) -> bool {
        let negative = self.take(b'-');
        if !negative {
            self.take(b'+');
        }
        negative
    }

    /// Goes to the next byte that is no blank, and shows it.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn skip_blanks(&mut self) -> u8 {
        while is_blank(self.peek()) {
            self.at += 1;
        }
        self.peek()
    }
}
