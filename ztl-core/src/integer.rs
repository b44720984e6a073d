//! Integers as Python's `int()` reads them (`docs/protocol.md` [2.3]).

use crate::sink::Sink;
use crate::text::is_blank;

/// Most digits accepted: Python's own limit (`sys.int_info.default_max_str_digits`).
pub const MAX_DIGITS: usize = 4300;

/// An integer of any size, as a view of its text.
///
/// Ids have no bound in the original, and a reply repeats the request's id. So the digits stay in the
/// request.
#[derive(Debug, Clone, Copy)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Integer<'a> {
    /// An optional sign, then digits with single `_` between them; empty for zero.
    text: &'a str,
}

/// Why a text is not an integer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParseIntegerError {
    /// Nothing but whitespace and perhaps a sign.
    Empty,
    /// A byte at this offset cannot be part of an integer.
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
    /// The id in an INIT, and in a reply that is about no task.
    pub const MINUS_ONE: Integer<'static> = Integer { text: "-1" };

    /// The id in a reply of the reserved scope that is about no INIT.
    pub const ZERO: Integer<'static> = Integer { text: "" };

    /// Parses whitespace, an optional sign, digits with single `_` between them, whitespace.
    ///
    /// ASCII only. The original also accepts other Unicode digits and whitespace, which no client sends;
    /// `docs/compatibility.md` lists the difference.
    ///
    /// # Errors
    /// [`ParseIntegerError`] says where the text stops being an integer.
    pub fn parse(text: &'a str) -> Result<Self, ParseIntegerError> {
        // Works on bytes: `trim` decodes characters, which costs 0.5 KiB on a Cortex-M0.
        let mut rest = text.as_bytes();
        while let [blank, behind @ ..] = rest
            && is_blank(*blank)
        {
            rest = behind;
        }
        let start = text.len() - rest.len();
        if let [b'-' | b'+', behind @ ..] = rest {
            rest = behind;
        }
        let (mut count, mut zero) = (0, true);
        let mut before = 0;
        while let [byte, behind @ ..] = rest {
            if byte.is_ascii_digit() {
                count += 1;
                zero &= *byte == b'0';
            } else if *byte != b'_' || !u8::is_ascii_digit(&before) {
                break;
            }
            before = *byte;
            rest = behind;
        }
        let end = text.len() - rest.len();
        if !rest.iter().all(|&byte| is_blank(byte)) {
            return Err(ParseIntegerError::Unexpected { at: end });
        }
        if before == b'_' {
            return Err(ParseIntegerError::Unexpected { at: end - 1 });
        }
        match count {
            0 => Err(ParseIntegerError::Empty),
            1..=MAX_DIGITS => Ok(Self {
                text: text
                    .get(if zero { end } else { start }..end)
                    .unwrap_or_default(),
            }),
            _ => Err(ParseIntegerError::TooLong),
        }
    }

    /// The value, if it fits.
    #[must_use]
    pub fn value(self) -> Option<i64> {
        match self.magnitude() {
            Some(magnitude) if self.is_negative() => 0i64.checked_sub_unsigned(magnitude),
            Some(magnitude) => i64::try_from(magnitude).ok(),
            None => None,
        }
    }

    /// The value if it is between 0 and 2^63 - 1, else `u64::MAX`: cheaper to return than an `Option` on a
    /// Cortex-M0.
    pub(crate) fn natural(self) -> u64 {
        match self.magnitude() {
            Some(number) if number >> 63 == 0 && !self.is_negative() => number,
            _ => u64::MAX,
        }
    }

    /// The absolute value, if it has at most 19 digits.
    fn magnitude(self) -> Option<u64> {
        let (mut high, mut low, mut count) = (0u32, 0u32, 0);
        for digit in self.text.bytes().filter(u8::is_ascii_digit) {
            // In halves: a 64-bit multiplication is a library call on a Cortex-M0.
            let quarter = (low & 0xffff) * 10 + u32::from(digit & 0xf);
            let next = (low >> 16) * 10 + (quarter >> 16);
            low = next << 16 | quarter & 0xffff;
            high = high.wrapping_mul(10).wrapping_add(next >> 16);
            // Leading zeros do not count. Testing the value instead would fail at 2^64, where it wraps to 0.
            count += u32::from(count != 0 || digit != b'0');
        }
        (count <= 19).then_some(u64::from(high) << 32 | u64::from(low))
    }

    /// Whether it is above 0, as an id that names a task.
    #[must_use]
    pub fn is_positive(self) -> bool {
        !self.text.is_empty() && !self.is_negative()
    }

    fn is_negative(self) -> bool {
        self.text.as_bytes().first() == Some(&b'-')
    }

    /// Writes the integer in plain ASCII digits with an optional `-`.
    pub fn put(self, sink: &mut (impl Sink + ?Sized)) {
        if self.text.is_empty() {
            sink.put(b"0");
        }
        let mut begun = false;
        for byte in self.text.bytes() {
            begun |= matches!(byte, b'1'..=b'9');
            if byte == b'-' || begun && byte != b'_' {
                sink.put(&[byte]);
            }
        }
    }
}

impl PartialEq for Integer<'_> {
    fn eq(&self, other: &Self) -> bool {
        let digits = |number: &Self| {
            let digits = number.text.bytes().filter(u8::is_ascii_digit);
            digits.skip_while(|&digit| digit == b'0')
        };
        self.is_negative() == other.is_negative() && digits(self).eq(digits(other))
    }
}

impl Eq for Integer<'_> {}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(integer: Integer<'_>) -> std::string::String {
        let mut out = std::vec::Vec::new();
        integer.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
        std::string::String::from_utf8(out).unwrap()
    }

    #[test]
    fn integers_are_read_as_python_does_and_written_in_plain_digits() {
        for (written, plain, value) in [
            (" 1_0 ", "10", Some(10)),
            ("+007", "7", Some(7)),
            ("-0", "0", Some(0)),
            ("-0_01_0", "-10", Some(-10)),
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
    fn integers_compare_by_value() {
        for (one, other, equal) in [
            ("-0_012", " -12 ", true),
            ("+0", "-0", true),
            ("12", "-12", false),
            ("1", "10", false),
        ] {
            let [one, other] = [one, other].map(|text| Integer::parse(text).unwrap());
            assert_eq!(one == other, equal, "{one:?} {other:?}");
        }
        for (text, positive) in [("1", true), ("+0_1", true), ("00", false), ("-1", false)] {
            assert_eq!(
                Integer::parse(text).unwrap().is_positive(),
                positive,
                "{text}"
            );
        }
        assert_eq!(Integer::parse("-01"), Ok(Integer::MINUS_ONE));
        assert_eq!(Integer::parse("00"), Ok(Integer::ZERO));
    }

    #[test]
    fn an_invalid_integer_reports_the_offending_byte() {
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

    #[test]
    fn an_integer_beyond_64_bits_has_no_value() {
        for digits in [
            "18446744073709551616",
            "0018446744073709551616",
            "36893488147419103232",
        ] {
            let number = Integer::parse(digits).unwrap();
            assert_eq!(number.value(), None, "{digits}");
            assert_eq!(number.natural(), u64::MAX, "{digits}");
        }
    }
}
