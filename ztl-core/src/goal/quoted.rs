//! Quoted texts, as Python's `repr` and as YAML write them.

use core::str::CharIndices;

use super::error::Fault;
use crate::cursor::Cursor;

/// A quoted text as written.
struct Quoted<'a> {
    quote: u8,
    /// The part between the quotes.
    inner: &'a str,
}

impl<'a> Quoted<'a> {
    /// Takes the text with its quotes.
    fn new(text: &'a str) -> Self {
        Self {
            quote: text.bytes().next().unwrap_or_default(),
            inner: text.get(1..text.len() - 1).unwrap_or_default(),
        }
    }

    /// Decodes the text and returns the size needed, which may exceed the scratch. The error is the offset of
    /// a bad escape in `inner`.
    fn unescape(&self, scratch: &mut [u8]) -> Result<usize, usize> {
        let mut out = Out { scratch, len: 0 };
        // Whitespace before a line break is dropped back to this length.
        let mut lasting = 0;
        let mut rest = self.inner.char_indices();
        while let Some((at, c)) = rest.next() {
            match c {
                '\\' => self.escape(&mut rest, &mut out).ok_or(at)?,
                '\'' if self.quote == b'\'' => {
                    rest.next();
                    out.push(c);
                }
                '\n' => {
                    out.len = lasting;
                    fold(&mut rest, &mut out);
                }
                ' ' | '\t' | '\r' => {
                    out.push(c);
                    continue;
                }
                _ => out.push(c),
            }
            lasting = out.len;
        }
        Ok(out.len)
    }

    /// Decodes the escape after a backslash.
    fn escape(&self, rest: &mut CharIndices<'_>, out: &mut Out<'_>) -> Option<()> {
        let double = self.quote == b'"';
        let (_, c) = rest.next()?;
        let meant = match c {
            '\\' | '\'' | '"' => c,
            'n' => '\n',
            'r' => '\r',
            't' => '\t',
            'a' => '\x07',
            'b' => '\x08',
            'f' => '\x0c',
            'v' => '\x0b',
            'x' => char::from_u32(hex(rest, 2)?)?,
            'u' => utf16(rest)?,
            'U' => char::from_u32(hex(rest, 8)?)?,
            // YAML's own escapes; Python's `repr` never writes them.
            '0' if double => '\0',
            'e' if double => '\x1b',
            ' ' | '/' | '\t' if double => c,
            'N' if double => '\u{85}',
            '_' if double => '\u{a0}',
            'L' if double => '\u{2028}',
            'P' if double => '\u{2029}',
            _ if double => return None,
            // Python's escapes that its `repr` never writes.
            'N' | '0'..='7' | '\n' => return None,
            // In single quotes, Python leaves any other backslash as it is, and YAML knows no escapes.
            _ => {
                out.push('\\');
                c
            }
        };
        out.push(meant);
        Some(())
    }
}

/// Decodes the text whose opening quote is at `start` and whose closing quote was just read.
type Unescape<'de> =
    fn(&mut Scratch<'de>, start: usize, text: &mut Cursor<'_>) -> Result<&'de str, Fault>;

/// Buffer for decoded texts.
pub(super) struct Scratch<'de> {
    /// The unused part.
    room: &'de mut [u8],
    /// Bytes used, or needed.
    used: usize,
    available: usize,
    unescape: Unescape<'de>,
}

impl<'de> Scratch<'de> {
    pub(super) fn new(room: &'de mut [u8]) -> Self {
        let available = room.len();
        Self {
            room,
            used: 0,
            available,
            // By pointer, so that firmware without scratch does not link it.
            unescape: Self::unescape_here,
        }
    }

    /// Decodes the text whose opening quote is at `start` and whose closing quote was just read.
    pub(super) fn unescape(
        &mut self,
        start: usize,
        text: &mut Cursor<'_>,
    ) -> Result<&'de str, Fault> {
        (self.unescape)(self, start, text)
    }

    /// Bytes used or needed, and bytes available.
    pub(super) fn room(&self) -> (usize, usize) {
        (self.used, self.available)
    }

    fn unescape_here(&mut self, start: usize, text: &mut Cursor<'_>) -> Result<&'de str, Fault> {
        let room = core::mem::take(&mut self.room);
        let quoted = Quoted::new(text.part(start, text.at));
        let len = quoted.unescape(room).map_err(|at| {
            text.at = start + 1 + at;
            Fault::BadEscape
        })?;
        self.used += len;
        let Some((meant, left)) = room.split_at_mut_checked(len) else {
            text.at = start;
            return Err(Fault::ScratchTooSmall);
        };
        self.room = left;
        // Only whole characters were written.
        Ok(core::str::from_utf8(meant).unwrap_or_default())
    }
}

/// Reads a YAML line break and the whitespace after it: the first break becomes a space, further ones stay.
fn fold(rest: &mut CharIndices<'_>, out: &mut Out<'_>) {
    let mut further = false;
    while let Some((_, c @ (' ' | '\t' | '\r' | '\n'))) = rest.clone().next() {
        rest.next();
        if c == '\n' {
            further = true;
            out.push(c);
        }
    }
    if !further {
        out.push(' ');
    }
}

/// Reads `digits` hexadecimal digits.
fn hex(rest: &mut CharIndices<'_>, digits: u32) -> Option<u32> {
    (0..digits).try_fold(0, |value, _| {
        let (_, c) = rest.next()?;
        Some(value << 4 | c.to_digit(16)?)
    })
}

/// Reads the digits after `\u`. JSON writes a character beyond U+FFFF as a pair of them.
fn utf16(rest: &mut CharIndices<'_>) -> Option<char> {
    let first = hex(rest, 4)?;
    if !matches!(first, 0xd800..0xdc00) {
        return char::from_u32(first);
    }
    let pair = [rest.next()?.1, rest.next()?.1];
    let second = hex(rest, 4)?;
    if pair != ['\\', 'u'] || !matches!(second, 0xdc00..0xe000) {
        return None;
    }
    char::from_u32(0x10000 + ((first & 0x3ff) << 10 | second & 0x3ff))
}

/// Writes into the scratch; keeps counting when it is full.
struct Out<'a> {
    scratch: &'a mut [u8],
    len: usize,
}

impl Out<'_> {
    fn push(&mut self, c: char) {
        let end = self.len + c.len_utf8();
        if let Some(room) = self.scratch.get_mut(self.len..end) {
            let mut bytes = [0; 4];
            c.encode_utf8(&mut bytes);
            room.iter_mut().zip(bytes).for_each(|(to, byte)| *to = byte);
        }
        self.len = end;
    }
}
