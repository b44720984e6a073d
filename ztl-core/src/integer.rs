//! Whole numbers as Python's `int()` reads them (wire specification 3.4).

use crate::cursor::Cursor;
use crate::sink::Sink;

/// Longest number read, in digits; Python's own limit (`sys.int_info.default_max_str_digits`).
pub const MAX_DIGITS: usize = 4300;

/// A whole number of any size, as a view over its text.
///
/// The original's ids have no bound, and an answer repeats the id of the request, so the digits are
/// kept where they stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Integer<'a> {
    negative: bool,
    /// Digits and single `_` between them, without leading zeros (empty is zero).
    digits: &'a str,
}

/// The text is no whole number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParseIntegerError {
    /// Nothing but blanks and perhaps a sign.
    Empty,
    /// A byte that belongs in no number stands at this offset.
    Unexpected {
        /// Offset in bytes.
        at: usize,
    },
    /// More than [`MAX_DIGITS`] digits.
    TooLong,
}

impl core::fmt::Display for ParseIntegerError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Empty => f.write_str("no digits"),
            Self::Unexpected { at } => write!(f, "not a digit at byte {at}"),
            Self::TooLong => write!(f, "more than {MAX_DIGITS} digits"),
        }
    }
}

impl core::error::Error for ParseIntegerError {}

impl<'a> Integer<'a> {
    /// The id of an INIT, and of an answer that is about no task.
    pub const MINUS_ONE: Integer<'static> = Integer {
        negative: true,
        digits: "1",
    };

    /// The id of an answer of the reserved scope that is about no INIT.
    pub const ZERO: Integer<'static> = Integer {
        negative: false,
        digits: "",
    };

    /// Reads blanks, one sign, digits with single `_` between them, blanks.
    ///
    /// ASCII only: the original also takes other alphabets' digits and blanks, which no client
    /// sends (the list of differences in `docs/compatibility.md` names it).
    ///
    /// # Errors
    /// [`ParseIntegerError`] says where the text stops being a number.
    pub fn parse(text: &'a str) -> Result<Self, ParseIntegerError> {
        // By bytes: `trim` and its like decode characters, which costs a Cortex-M0 0.5 KiB.
        let mut text = Cursor::new(text);
        text.skip_blanks();
        let negative = text.take_sign();
        let (mut first, mut count) = (usize::MAX, 0);
        let mut before = 0;
        loop {
            let byte = text.peek();
            if byte.is_ascii_digit() {
                count += 1;
                if byte > b'0' {
                    first = first.min(text.at);
                }
            } else if byte != b'_' || !u8::is_ascii_digit(&before) {
                break;
            }
            before = byte;
            text.at += 1;
        }
        let end = text.at;
        text.skip_blanks();
        if !text.is_at_end() {
            return Err(ParseIntegerError::Unexpected { at: end });
        }
        if before == b'_' {
            return Err(ParseIntegerError::Unexpected { at: end - 1 });
        }
        match count {
            0 => Err(ParseIntegerError::Empty),
            1..=MAX_DIGITS => Ok(Self {
                negative: negative && first < end,
                digits: text.part(first.min(end), end),
            }),
            _ => Err(ParseIntegerError::TooLong),
        }
    }

    /// The number, when it fits.
    #[must_use]
    pub fn value(self) -> Option<i64> {
        let (mut magnitude, mut count) = (0u64, 0);
        for byte in self.digits.bytes() {
            if byte != b'_' {
                let digit = u64::from(byte & 0xf);
                magnitude = magnitude.wrapping_mul(10).wrapping_add(digit);
                count += 1;
            }
        }
        // So many digits always fit into 64 bits; whether into one less, the sign tells.
        let mut value = magnitude as i64;
        if self.negative {
            value = value.wrapping_neg();
        }
        (count <= 19 && (value < 0) == self.negative).then_some(value)
    }

    /// Writes the number in plain ASCII digits with an optional `-`.
    pub fn put(self, sink: &mut (impl Sink + ?Sized)) {
        if self.negative {
            sink.put(b"-");
        }
        if self.digits.is_empty() {
            sink.put(b"0");
        }
        for byte in self.digits.bytes() {
            if byte != b'_' {
                sink.put(&[byte]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(integer: Integer<'_>) -> std::string::String {
        let mut out = std::vec::Vec::new();
        integer.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
        std::string::String::from_utf8(out).unwrap()
    }

    #[test]
    fn numbers_are_read_as_python_reads_them_and_written_plainly() {
        for (written, plain, value) in [
            (" 1_0 ", "10", Some(10)),
            ("+007", "7", Some(7)),
            ("-0", "0", Some(0)),
            ("0_0", "0", Some(0)),
            ("\t-12\n", "-12", Some(-12)),
            ("9223372036854775807", "9223372036854775807", Some(i64::MAX)),
            (
                "-9223372036854775808",
                "-9223372036854775808",
                Some(i64::MIN),
            ),
            ("99999999999999999999", "99999999999999999999", None),
        ] {
            let integer = Integer::parse(written).unwrap();
            assert_eq!((text(integer).as_str(), integer.value()), (plain, value));
        }
    }

    #[test]
    fn what_is_no_number_is_named_by_its_place() {
        use ParseIntegerError::{Empty, Unexpected};
        for (written, error) in [
            ("", Empty),
            ("  ", Empty),
            ("-", Empty),
            ("1.0", Unexpected { at: 1 }),
            (" - 1", Unexpected { at: 2 }),
            ("1__0", Unexpected { at: 2 }),
            ("2_", Unexpected { at: 1 }),
            ("_2", Unexpected { at: 0 }),
            ("0x1", Unexpected { at: 1 }),
        ] {
            assert_eq!(Integer::parse(written), Err(error), "{written:?}");
        }
        let long = std::string::String::from_utf8(std::vec![b'9'; 4301]).unwrap();
        assert_eq!(Integer::parse(&long), Err(ParseIntegerError::TooLong));
        assert!(Integer::parse(&long[1..]).is_ok());
    }
}
