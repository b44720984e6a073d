//! Texts in quotes, as Python's `repr` and as YAML write them.

use core::str::CharIndices;

use super::error::Fault;
use crate::cursor::Cursor;

/// A text in quotes, as it is written.
struct Quoted<'a> {
    quote: u8,
    /// What stands between the quotes.
    inner: &'a str,
}

impl<'a> Quoted<'a> {
    /// Of a text with its quotes.
    fn new(text: &'a str) -> Self {
        Self {
            quote: text.bytes().next().unwrap_or_default(),
            inner: text.get(1..text.len() - 1).unwrap_or_default(),
        }
    }

    /// Writes what is meant, and says how many bytes that takes, which may be more than there are.
    /// The error is the place of a bad escape in `inner`.
    fn unescape(&self, scratch: &mut [u8]) -> Result<usize, usize> {
        let mut out = Out { scratch, len: 0 };
        // Up to here the text stays, even when a line break follows.
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

    /// Reads what stands behind a backslash.
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
            // YAML's own; Python's `repr` writes none of them.
            '0' if double => '\0',
            'e' if double => '\x1b',
            ' ' | '/' | '\t' if double => c,
            'N' if double => '\u{85}',
            '_' if double => '\u{a0}',
            'L' if double => '\u{2028}',
            'P' if double => '\u{2029}',
            _ if double => return None,
            // Python's, which its `repr` does not write either.
            'N' | '0'..='7' | '\n' => return None,
            // Python leaves any other backslash there; to YAML none is an escape here.
            _ => {
                out.push('\\');
                c
            }
        };
        out.push(meant);
        Some(())
    }
}

/// Writes what the text means that begins there with its quote, and ends here with it.
type Unescape<'de> =
    fn(&mut Scratch<'de>, start: usize, text: &mut Cursor<'_>) -> Result<&'de str, Fault>;

/// Where texts with escapes are written to.
pub(super) struct Scratch<'de> {
    /// What is not in use.
    room: &'de mut [u8],
    /// Bytes in use, or needed.
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
            // By its address, so that firmware that never has scratch does not link it.
            unescape: Self::unescape_here,
        }
    }

    /// What the text means that begins there with its quote, and ends here with it.
    pub(super) fn unescape(
        &mut self,
        start: usize,
        text: &mut Cursor<'_>,
    ) -> Result<&'de str, Fault> {
        (self.unescape)(self, start, text)
    }

    /// Bytes in use or needed, and bytes that there were.
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
        // Whole characters were written.
        Ok(core::str::from_utf8(meant).unwrap_or_default())
    }
}

/// Reads a line break of YAML with the blanks behind it: one means a blank, further ones stay.
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

/// Reads so many hexadecimal digits.
fn hex(rest: &mut CharIndices<'_>, digits: u32) -> Option<u32> {
    (0..digits).try_fold(0, |value, _| {
        let (_, c) = rest.next()?;
        Some(value << 4 | c.to_digit(16)?)
    })
}

/// Reads what stands behind `\u`. JSON writes a character beyond U+FFFF as two of them.
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

/// Counts on when the scratch is full.
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
