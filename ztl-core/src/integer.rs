//! Whole numbers as Python's `int()` reads them (wire specification 3.4).

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
        // By bytes: `trim_matches` decodes characters, which costs a Cortex-M0 0.5 KiB.
        let blank = |byte: u8| matches!(byte, b' ' | b'\t'..=b'\r');
        let mut start = 0;
        let mut end = text.len();
        let at = |place: usize| text.as_bytes().get(place).copied();
        while at(start).is_some_and(blank) {
            start += 1;
        }
        while end > start && at(end - 1).is_some_and(blank) {
            end -= 1;
        }
        let negative = at(start) == Some(b'-');
        if negative || at(start) == Some(b'+') {
            start += 1;
        }
        let digits = text.get(start..end).unwrap_or_default();
        if digits.is_empty() {
            return Err(ParseIntegerError::Empty);
        }
        let mut after_digit = false;
        let mut count = 0usize;
        for (at, byte) in digits.bytes().enumerate() {
            match byte {
                b'0'..=b'9' => {
                    after_digit = true;
                    count += 1;
                }
                b'_' if after_digit && at + 1 < digits.len() => after_digit = false,
                _ => {
                    return Err(ParseIntegerError::Unexpected { at: start + at });
                }
            }
        }
        if count > MAX_DIGITS {
            return Err(ParseIntegerError::TooLong);
        }
        let first = digits.bytes().position(|byte| byte != b'0' && byte != b'_');
        let digits = first.and_then(|at| digits.get(at..)).unwrap_or_default();
        Ok(Self {
            negative: negative && !digits.is_empty(),
            digits,
        })
    }

    /// The number, when it fits.
    #[must_use]
    pub fn value(self) -> Option<i64> {
        let mut value = 0i64;
        for byte in self.digits.bytes().filter(u8::is_ascii_digit) {
            let digit = i64::from(byte - b'0');
            value = value.checked_mul(10)?;
            value = if self.negative {
                value.checked_sub(digit)?
            } else {
                value.checked_add(digit)?
            };
        }
        Some(value)
    }

    /// Writes the number in plain ASCII digits with an optional `-`.
    pub fn put(self, sink: &mut (impl Sink + ?Sized)) {
        if self.negative {
            sink.put(b"-");
        }
        if self.digits.is_empty() {
            sink.put(b"0");
        }
        for run in self.digits.as_bytes().split(|&byte| byte == b'_') {
            sink.put(run);
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
