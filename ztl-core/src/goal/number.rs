//! Numbers as Python and YAML write them.

use super::decimal::{F32, F64};

/// What a text says that is a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Number {
    /// A whole number of 64 bits.
    Whole {
        negative: bool,
        magnitude: u64,
    },
    /// Any other, as `mantissa × 10^exponent`.
    Decimal {
        negative: bool,
        mantissa: u64,
        exponent: i32,
        /// Whether there are digits that the mantissa does not hold.
        more: bool,
        /// Whether it was written without point and exponent: a whole number of more than 64 bits.
        whole: bool,
    },
    Infinity {
        negative: bool,
    },
    Nan,
}

/// A whole number beyond the target's range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct OutOfRange;

/// A whole number, as serde takes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Whole {
    Negative(i64),
    Positive(u64),
}

impl Number {
    /// Reads the whole text; `None` when it is no number.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let (negative, unsigned) = match text.as_bytes() {
            b"nan" | b".nan" | b".NaN" | b".NAN" => return Some(Self::Nan),
            [b'-', unsigned @ ..] => (true, unsigned),
            [b'+', unsigned @ ..] | unsigned => (false, unsigned),
        };
        let radix = match unsigned {
            b"inf" | b".inf" | b".Inf" | b".INF" => return Some(Self::Infinity { negative }),
            [b'0', b'x' | b'X', ..] => 16,
            [b'0', b'o' | b'O', ..] => 8,
            [b'0', b'b' | b'B', ..] => 2,
            _ => 10,
        };
        match unsigned {
            [_, _, digits @ ..] if radix != 10 => Digits::new(digits).in_radix(negative, radix),
            digits => Digits::new(digits).in_decimal(negative),
        }
    }

    /// The number when it is whole; `None` when it is none.
    pub(super) fn whole(self) -> Option<Result<Whole, OutOfRange>> {
        match self {
            Self::Whole {
                negative: false,
                magnitude,
            } => Some(Ok(Whole::Positive(magnitude))),
            Self::Whole { magnitude, .. } => {
                let value = 0i64.checked_sub_unsigned(magnitude);
                Some(value.map(Whole::Negative).ok_or(OutOfRange))
            }
            Self::Decimal { whole: true, .. } => Some(Err(OutOfRange)),
            _ => None,
        }
    }

    /// The nearest `f32`.
    pub(super) fn to_f32(self) -> Result<f32, OutOfRange> {
        let (negative, magnitude) = match self.parts() {
            Ok((negative, mantissa, exponent, more)) => {
                let bits = F32.nearest(mantissa, exponent, more).ok_or(OutOfRange)?;
                (negative, f32::from_bits(bits as u32))
            }
            Err(Some(negative)) => (negative, f32::INFINITY),
            Err(None) => (false, f32::NAN),
        };
        Ok(if negative { -magnitude } else { magnitude })
    }

    /// The nearest `f64`.
    pub(super) fn to_f64(self) -> Result<f64, OutOfRange> {
        let (negative, magnitude) = match self.parts() {
            Ok((negative, mantissa, exponent, more)) => {
                let bits = F64.nearest(mantissa, exponent, more).ok_or(OutOfRange)?;
                (negative, f64::from_bits(bits))
            }
            Err(Some(negative)) => (negative, f64::INFINITY),
            Err(None) => (false, f64::NAN),
        };
        Ok(if negative { -magnitude } else { magnitude })
    }

    /// Sign, mantissa, exponent and whether digits are left; else the sign of infinity, else none.
    fn parts(self) -> Result<(bool, u64, i32, bool), Option<bool>> {
        match self {
            Self::Whole {
                negative,
                magnitude,
            } => Ok((negative, magnitude, 0, false)),
            Self::Decimal {
                negative,
                mantissa,
                exponent,
                more,
                ..
            } => Ok((negative, mantissa, exponent, more)),
            Self::Infinity { negative } => Err(Some(negative)),
            Self::Nan => Err(None),
        }
    }
}

/// Digits with single `_` between them.
struct Digits<'a> {
    rest: core::slice::Iter<'a, u8>,
    after_digit: bool,
}

impl<'a> Digits<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self {
            rest: bytes.iter(),
            after_digit: false,
        }
    }

    /// The next byte that is no `_` between two digits.
    fn next(&mut self, radix: u32) -> Option<(u8, Option<u32>)> {
        let digit = |byte: u8| match byte {
            b'0'..=b'9' => Some(u32::from(byte - b'0')).filter(|&digit| digit < radix),
            b'a'..=b'f' if radix == 16 => Some(u32::from(byte - b'a') + 10),
            b'A'..=b'F' if radix == 16 => Some(u32::from(byte - b'A') + 10),
            _ => None,
        };
        let mut byte = *self.rest.next()?;
        if byte == b'_' && self.after_digit {
            let following = self.rest.clone().next();
            if let Some(&following) = following.filter(|&&byte| digit(byte).is_some()) {
                byte = following;
                self.rest.next();
            }
        }
        self.after_digit = digit(byte).is_some();
        Some((byte, digit(byte)))
    }

    fn in_radix(mut self, negative: bool, radix: u32) -> Option<Number> {
        let mut magnitude = Some(0u64);
        let mut digits = 0usize;
        while let Some((_, digit)) = self.next(radix) {
            let digit = u64::from(digit?);
            magnitude = magnitude
                .and_then(|value| value.checked_mul(radix.into()))
                .and_then(|value| value.checked_add(digit));
            digits += 1;
        }
        (digits > 0).then_some(match magnitude {
            Some(magnitude) => Number::Whole {
                negative,
                magnitude,
            },
            // Beyond the range of every target but a float's, for which nobody writes this.
            None => Number::Decimal {
                negative,
                mantissa: 1,
                exponent: i32::MAX,
                more: true,
                whole: true,
            },
        })
    }

    fn in_decimal(mut self, negative: bool) -> Option<Number> {
        let (mut mantissa, mut exponent, mut full, mut more) = (0u64, 0i32, false, false);
        let (mut digits, mut point, mut whole, mut leading_zero) = (0usize, false, true, false);
        while let Some((byte, digit)) = self.next(10) {
            match (byte, digit) {
                (_, Some(digit)) => {
                    let longer = mantissa
                        .checked_mul(10)
                        .and_then(|value| value.checked_add(digit.into()));
                    match longer.filter(|_| !full) {
                        Some(longer) => {
                            mantissa = longer;
                            exponent = exponent.saturating_sub(point.into());
                        }
                        None => {
                            full = true;
                            more |= digit != 0;
                            exponent = exponent.saturating_add((!point).into());
                        }
                    }
                    leading_zero |= digits == 0 && digit == 0;
                    digits += 1;
                }
                (b'.', _) if !point => (point, whole) = (true, false),
                (b'e' | b'E', _) if digits > 0 => {
                    whole = false;
                    exponent = exponent.saturating_add(self.exponent()?);
                    break;
                }
                _ => return None,
            }
        }
        // 010 is 8 for YAML, 10 for a person, and an error for Python.
        if digits == 0 || whole && leading_zero && mantissa > 0 {
            return None;
        }
        Some(if whole && !full {
            Number::Whole {
                negative,
                magnitude: mantissa,
            }
        } else {
            Number::Decimal {
                negative,
                mantissa,
                exponent,
                more,
                whole,
            }
        })
    }

    /// What stands behind an `e`.
    fn exponent(&mut self) -> Option<i32> {
        let (negative, digits) = match self.rest.as_slice() {
            [b'-', digits @ ..] => (true, digits),
            [b'+', digits @ ..] | digits => (false, digits),
        };
        let mut digits = Digits::new(digits);
        let mut exponent = 0i32;
        let mut any = false;
        while let Some((_, digit)) = digits.next(10) {
            let digit = digit? as i32;
            exponent = exponent.saturating_mul(10).saturating_add(digit);
            any = true;
        }
        any.then_some(if negative { -exponent } else { exponent })
    }
}
