//! Numbers as Python and YAML write them.

use super::decimal::{Format, Wide, digit};
use crate::cursor::Cursor;

/// A number read from text.
pub(super) struct Number {
    form: Form,
    negative: bool,
    magnitude: Wide,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    /// Without decimal point and exponent.
    Whole,
    Decimal,
    Infinity,
    Nan,
}

/// An integer, in the form that serde takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Whole {
    Negative(i64),
    Positive(u64),
}

impl Number {
    pub(super) const ZERO: Self = Self {
        form: Form::Whole,
        negative: false,
        magnitude: Wide::ZERO,
    };

    /// Reads the whole text into a number that was zero; returns whether it is valid.
    pub(super) fn read(&mut self, text: &str) -> bool {
        let mut text = Cursor::new(text);
        self.negative = text.take_sign();
        if self.is_word(&text) {
            // NaN takes no sign.
            return self.form == Form::Infinity || text.at == 0;
        }
        self.read_digits(&mut text) && text.is_at_end()
    }

    /// Recognises infinity and NaN: lower case, or after a point in three spellings.
    fn is_word(&mut self, text: &Cursor<'_>) -> bool {
        // The cursor returns zeros past the end.
        const INFINITIES: [u32; 4] = [word(b"inf\0"), word(b".inf"), word(b".Inf"), word(b".INF")];
        const NANS: [u32; 4] = [word(b"nan\0"), word(b".nan"), word(b".NaN"), word(b".NAN")];
        let next = (0..4).fold(0, |word, place| word << 8 | u32::from(text.ahead(place)));
        if INFINITIES.contains(&next) {
            self.form = Form::Infinity;
        } else if NANS.contains(&next) {
            self.form = Form::Nan;
        }
        self.form != Form::Whole && text.ahead(4) == 0
    }

    fn read_digits(&mut self, text: &mut Cursor<'_>) -> bool {
        let zero = text.peek() == b'0';
        let radix = radix(text);
        let mut digits = self.magnitude.read(text, radix);
        if radix != 10 {
            // Digits beyond the capacity overflow any float.
            self.magnitude.tens = 1000 * i32::from(self.magnitude.tens > 0);
            return digits > 0;
        }
        let whole = text.at;
        if text.take(b'.') {
            let behind = self.magnitude.read(text, 10);
            self.magnitude.tens -= behind;
            digits += behind;
        }
        if digits == 0 {
            return false;
        }
        if text.take(b'e') || text.take(b'E') {
            let below = text.take_sign();
            let start = text.at;
            let mut power = 0;
            while let Some(digit) = digit(text, 10, text.at > start) {
                // Bounded, but larger than the length of any text.
                power = i32::min(power * 10 + i32::from(digit), 1 << 27);
            }
            if text.at == start {
                return false;
            }
            self.magnitude.tens += if below { -power } else { power };
        }
        if text.at != whole {
            self.form = Form::Decimal;
            return true;
        }
        // Rejects `010`: 8 in YAML, 10 to a person, an error in Python.
        !zero || self.magnitude.is_zero()
    }

    /// The number if it is an integer; the inner `None` means that it does not fit.
    pub(super) fn whole(&self) -> Option<Option<Whole>> {
        if self.form != Form::Whole {
            return None;
        }
        let magnitude = self.magnitude.to_u64();
        Some(if self.negative {
            let value = magnitude.and_then(|magnitude| 0i64.checked_sub_unsigned(magnitude));
            value.map(Whole::Negative)
        } else {
            magnitude.map(Whole::Positive)
        })
    }

    /// The bits of the nearest number of this format; `None` if it is too large.
    pub(super) fn nearest(&mut self, format: &Format) -> Option<u64> {
        let magnitude = match self.form {
            Form::Infinity => format.infinity(),
            Form::Nan => format.sign() - 1,
            _ => format.nearest(&mut self.magnitude)?,
        };
        Some(if self.negative {
            magnitude | format.sign()
        } else {
            magnitude
        })
    }
}

const fn word(bytes: &[u8; 4]) -> u32 {
    u32::from_be_bytes(*bytes)
}

/// Consumes the prefix of digits that are not decimal.
fn radix(text: &mut Cursor<'_>) -> u8 {
    let radix = match text.ahead(1) | 0x20 {
        b'x' => 16,
        b'o' => 8,
        b'b' => 2,
        _ => 10,
    };
    if radix == 10 || text.peek() != b'0' {
        return 10;
    }
    text.at += 2;
    radix
}
