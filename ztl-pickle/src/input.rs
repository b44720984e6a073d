//! The bytes of a pickle, and the texts of protocol 0.

use crate::Error;

/// What is left of a pickle.
pub(crate) struct Input<'a> {
    rest: &'a [u8],
    len: usize,
}

impl<'a> Input<'a> {
    pub(crate) const fn new(bytes: &'a [u8]) -> Self {
        let len = bytes.len();
        Self { rest: bytes, len }
    }

    /// The number of bytes that were read.
    pub(crate) const fn at(&self) -> usize {
        self.len - self.rest.len()
    }

    const fn truncated(&self) -> Error {
        Error::Truncated { at: self.len }
    }

    /// The next bytes. The length comes from outside: nothing is allocated for it.
    pub(crate) fn take(&mut self, len: u64) -> Result<&'a [u8], Error> {
        let len = usize::try_from(len).ok();
        let split = len.and_then(|len| self.rest.split_at_checked(len));
        let (bytes, rest) = split.ok_or_else(|| self.truncated())?;
        self.rest = rest;
        Ok(bytes)
    }

    /// Checks that so many bytes follow.
    pub(crate) fn expect(&self, len: u64) -> Result<(), Error> {
        match u64::try_from(self.rest.len()) {
            Ok(left) if left < len => Err(self.truncated()),
            _ => Ok(()),
        }
    }

    pub(crate) fn array<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let (bytes, rest) = self.rest.split_first_chunk().ok_or(self.truncated())?;
        self.rest = rest;
        Ok(*bytes)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, Error> {
        Ok(u8::from_le_bytes(self.array()?))
    }

    pub(crate) fn u32(&mut self) -> Result<u32, Error> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    /// A length that Python stores with a sign.
    pub(crate) fn signed_len(&mut self) -> Result<u64, Error> {
        let len = i32::from_le_bytes(self.array()?);
        u64::try_from(len).map_err(|_| malformed("a negative length"))
    }

    pub(crate) fn u64(&mut self) -> Result<u64, Error> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    /// The bytes before the next line feed, which is skipped.
    pub(crate) fn line(&mut self) -> Result<&'a [u8], Error> {
        let end = self.rest.iter().position(|byte| *byte == b'\n');
        let line = self.take(end.ok_or_else(|| self.truncated())? as u64)?;
        self.take(1)?;
        Ok(line)
    }
}

/// The reader adds the place.
pub(crate) const fn malformed(what: &'static str) -> Error {
    Error::Malformed { at: 0, what }
}

/// Whether it is UTF-8 but for surrogates, as texts are in a pickle.
pub(crate) fn is_text(mut bytes: &[u8]) -> bool {
    while let Err(error) = std::str::from_utf8(bytes) {
        match bytes.get(error.valid_up_to()..) {
            Some([0xed, 0xa0..=0xbf, 0x80..=0xbf, rest @ ..]) => bytes = rest,
            _ => return false,
        }
    }
    true
}

/// The bytes that a Python 2 literal means: its content, without the quotes.
pub(crate) fn unescape(literal: &[u8]) -> Result<Vec<u8>, Error> {
    const WRONG: Error = malformed("an invalid literal");
    let inner = match literal {
        [b'\'', inner @ .., b'\''] | [b'"', inner @ .., b'"'] => inner,
        _ => return Err(WRONG),
    };
    let mut out = Vec::with_capacity(inner.len());
    let mut bytes = inner.iter().copied().peekable();
    while let Some(byte) = bytes.next() {
        if byte != b'\\' {
            out.push(byte);
            continue;
        }
        match bytes.next().ok_or(WRONG)? {
            b'\n' => {}
            b'a' => out.push(7),
            b'b' => out.push(8),
            b't' => out.push(b'\t'),
            b'n' => out.push(b'\n'),
            b'v' => out.push(11),
            b'f' => out.push(12),
            b'r' => out.push(b'\r'),
            b'x' => {
                let digits = [bytes.next(), bytes.next()];
                let code = digits.iter().try_fold(0, |code, digit| {
                    Some(code * 16 + char::from((*digit)?).to_digit(16)?)
                });
                out.push(code.ok_or(WRONG)? as u8);
            }
            first @ b'0'..=b'7' => {
                let mut code = u32::from(first - b'0');
                for _ in 0..2 {
                    match bytes.next_if(|byte| matches!(byte, b'0'..=b'7')) {
                        Some(digit) => code = code * 8 + u32::from(digit - b'0'),
                        None => break,
                    }
                }
                out.push(code as u8);
            }
            same @ (b'\\' | b'\'' | b'"') => out.push(same),
            other => out.extend([b'\\', other]),
        }
    }
    Ok(out)
}

/// The text of protocol 0: Latin-1 with `\u` and `\U`.
pub(crate) fn raw_unicode(line: &[u8]) -> Result<Vec<u8>, Error> {
    let mut out = Vec::with_capacity(line.len());
    let mut rest = line;
    while let [byte, after @ ..] = rest {
        rest = after;
        let digits = match (byte, after) {
            (b'\\', [b'u', ..]) => 4,
            (b'\\', [b'U', ..]) => 8,
            (b'\\', [other, after @ ..]) => {
                out.push(b'\\');
                put_code(u32::from(*other), &mut out);
                rest = after;
                continue;
            }
            _ => {
                put_code(u32::from(*byte), &mut out);
                continue;
            }
        };
        let hex = after
            .get(1..=digits)
            .and_then(|hex| std::str::from_utf8(hex).ok());
        let hex = hex.filter(|hex| hex.bytes().all(|digit| digit.is_ascii_hexdigit()));
        let code = hex.and_then(|hex| u32::from_str_radix(hex, 16).ok());
        let code = code.filter(|code| *code < 0x11_0000);
        put_code(code.ok_or(malformed("an invalid escape"))?, &mut out);
        rest = after.get(1 + digits..).unwrap_or_default();
    }
    Ok(out)
}

/// Appends the character in UTF-8, also a surrogate.
pub(crate) fn put_code(code: u32, out: &mut Vec<u8>) {
    match char::from_u32(code) {
        Some(c) => out.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes()),
        None => {
            let part = |shift: u32| 0x80 | (code >> shift & 0x3f) as u8;
            out.extend([0xed, part(6), part(0)]);
        }
    }
}

/// The bytes of a text with characters below 256, as Python 3 stores bytes in old protocols.
pub(crate) fn latin1(text: &[u8]) -> Option<Vec<u8>> {
    let text = std::str::from_utf8(text).ok()?;
    text.chars()
        .map(|c| u8::try_from(u32::from(c)).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_may_have_surrogates() {
        assert!(is_text("aä€🤖".as_bytes()));
        assert!(is_text(b"a\xed\xa0\xbd\xed\xb8\x80b"));
        for wrong in [
            &b"\xff"[..],
            b"\xc0\xaf",
            b"\xed\xa0",
            b"\xf4\x90\x80\x80",
            b"\xed\xa0\x41",
        ] {
            assert!(!is_text(wrong), "{wrong:?}");
        }
        let mut out = Vec::new();
        put_code(0xdfff, &mut out);
        assert_eq!(out, b"\xed\xbf\xbf");
    }

    #[test]
    fn literals_of_python_2_are_unescaped() {
        let plain = unescape(br#"'a\\\'\"\n\t\r\a\b\f\v\x41\101\0\q'"#).unwrap();
        assert_eq!(plain, b"a\\'\"\n\t\r\x07\x08\x0c\x0bAA\0\\q");
        for wrong in [&b"'"[..], b"abc", b"'a\"", b"'\\", b"'\\'", b"'\\x4'", b""] {
            assert!(unescape(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn raw_unicode_has_only_two_escapes() {
        let text = raw_unicode(b"\\u0041\\U0001f916\\\\u0041\\x\xe4\\ud800").unwrap();
        assert_eq!(text, b"A\xf0\x9f\xa4\x96\\\\u0041\\x\xc3\xa4\xed\xa0\x80");
        for wrong in [&b"\\u004"[..], b"\\U00110000", b"\\u+041", b"\\u"] {
            assert!(raw_unicode(wrong).is_err(), "{wrong:?}");
        }
        assert_eq!(raw_unicode(b"\\").unwrap(), b"\\");
    }
}
