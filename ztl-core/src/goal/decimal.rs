//! Conversion between decimal and binary floating point, correctly rounded, with integer arithmetic only.
//!
//! The standard library's parser and formatter take 20 KB of flash on a Cortex-M0, where a float
//! multiplication is a library call as well.

use crate::cursor::Cursor;

/// A binary floating-point format.
#[derive(Debug)]
pub(super) struct Format {
    /// Width of the fraction field in bits.
    fraction: u32,
    /// Exponent of the smallest normal number.
    least: i32,
}

pub(super) const F32: Format = Format {
    fraction: 23,
    least: -126,
};

pub(super) const F64: Format = Format {
    fraction: 52,
    least: -1022,
};

/// Enough digits to tell any number from all others.
const LONGEST: usize = 17;

impl Format {
    /// The bits of infinity: all ones in the exponent field.
    pub(super) const fn infinity(&self) -> u64 {
        ((2 - 2 * self.least) as u64 + 1) << self.fraction
    }

    /// The sign bit.
    pub(super) const fn sign(&self) -> u64 {
        self.infinity() + (1 << self.fraction)
    }

    /// The bits of the number nearest to `wide`; a tie goes to the even one. `None` if it is too large.
    ///
    /// Exact for up to 64 bits. The product of such a number and a power of ten in the range of `f64` is
    /// either the exact middle of two neighbours, or further from it than about 2^-128 of itself (Mushtak and
    /// Lemire, "Fast number parsing without fallback"). [`Wide`] errs by less than 2^-140, and knows when it
    /// is exact.
    pub(super) fn nearest(&self, wide: &mut Wide) -> Option<u64> {
        if wide.is_zero() {
            return Some(0);
        }
        // Outside this range the result is zero or too large anyway; the clamp bounds the work.
        wide.tens = wide.tens.clamp(-400, 400);
        wide.scale();
        // Takes one bit more than the result has. The value is `kept × 2^power` plus the fraction left in
        // `wide`.
        let lowest = self.least - self.fraction as i32 - 1;
        let mut power = wide.exponent + 8 * BYTES as i32;
        let mut kept = 0;
        while kept >> self.fraction < 2 && power > lowest {
            kept = kept << 1 | u64::from(wide.step(2, 0));
            power -= 1;
        }
        let field = (power - lowest).max(0) as u64;
        let up = kept & 1 != 0 && (kept & 2 != 0 || wide.more || !wide.is_zero());
        // The leading one increments the exponent field; so does a carry.
        let bits = (field << self.fraction) + (kept >> 1) + u64::from(up);
        (bits < self.infinity()).then_some(bits)
    }

    /// The first decimal digits of a number given by its bits, finite and above zero.
    fn digits(&self, bits: u64) -> Digits {
        let field = bits >> self.fraction;
        let mut mantissa = bits & ((1 << self.fraction) - 1);
        if field > 0 {
            mantissa |= 1 << self.fraction;
        }
        let binary = self.least - self.fraction as i32 + field.saturating_sub(1) as i32;
        // The decimal logarithm of the highest bit, rounded down: log10(2) ≈ 78913 / 2^18.
        let highest = binary + 63 - mantissa.leading_zeros() as i32;
        let power = (highest * 78913) >> 18;
        let mut wide = Wide::new(mantissa);
        wide.exponent = binary;
        wide.tens = Digits::COUNT as i32 - 1 - power;
        wide.scale();
        let (whole, more) = wide.whole();
        // There is one digit more if the number is above the next power of ten.
        let text = Whole::of(whole);
        Digits {
            power: power + text.digits().len() as i32 - Digits::COUNT as i32,
            text,
            more,
        }
    }

    /// The shortest decimal number that reads back as these bits (finite, above zero); if there are several,
    /// the nearest. Returns its digits and the power of ten of the first one.
    pub(super) fn shortest(&self, bits: u64) -> (u64, i32) {
        let all = self.digits(bits);
        let mut shortest = all.rounded(LONGEST);
        // If a number of `n` digits reads back, so does one of `n + 1`.
        let (mut least, mut most) = (1, LONGEST);
        while least < most {
            let count = (least + most) / 2;
            let (down, up) = all.cut(count);
            let unit = all.power + 1 - count as i32;
            let near = down + u64::from(up);
            let far = down + u64::from(!up);
            let reads_back = |&digits: &u64| {
                let mut wide = Wide::new(digits);
                wide.tens = unit;
                self.nearest(&mut wide) == Some(bits)
            };
            match [near, far].into_iter().find(reads_back) {
                Some(digits) => {
                    shortest = all.carried(digits, count);
                    most = count;
                }
                None => least = count + 1,
            }
        }
        shortest
    }

    /// The number (finite, above zero) rounded to `decimals` digits after the point; a tie goes to the even
    /// digit. `None` means zero.
    pub(super) fn fixed(&self, bits: u64, decimals: i32) -> Option<(u64, i32)> {
        let all = self.digits(bits);
        let count = all.power + 1 + decimals;
        if count < 0 {
            return None;
        }
        let count = (count as usize).min(LONGEST);
        let (digits, power) = all.rounded(count);
        (digits > 0).then_some((digits, power))
    }
}

/// A number's first digits, at least [`COUNT`](Self::COUNT) of them.
struct Digits {
    text: Whole,
    /// The power of ten of the first digit.
    power: i32,
    /// Whether nonzero digits follow.
    more: bool,
}

impl Digits {
    const COUNT: usize = 18;

    /// The first `count` digits, and whether to round up; a tie goes to the even digit.
    fn cut(&self, count: usize) -> (u64, bool) {
        let mut digits = self.text.digits().iter().map(|digit| digit - b'0');
        let kept = digits.by_ref().take(count);
        let down = kept.fold(0, |value, digit| value * 10 + u64::from(digit));
        let next = digits.next().unwrap_or(0);
        let more = self.more || digits.any(|digit| digit != 0);
        (down, next > 5 || next == 5 && (more || down & 1 != 0))
    }

    /// The number rounded to `count` digits.
    fn rounded(&self, count: usize) -> (u64, i32) {
        let (down, up) = self.cut(count);
        self.carried(down + u64::from(up), count)
    }

    /// Adjusts for a carry after rounding: 99 may have become 100. Returns the digits and the power of ten of
    /// the first one.
    fn carried(&self, digits: u64, count: usize) -> (u64, i32) {
        if digits == power_of_ten(count) {
            (1, self.power + 1)
        } else {
            (digits, self.power)
        }
    }
}

/// The decimal digits of an integer.
pub(super) struct Whole {
    buffer: [u8; 20],
}

impl Whole {
    pub(super) fn of(mut number: u64) -> Self {
        let mut buffer = [b'0'; 20];
        // By subtraction: a 64-bit division takes 900 bytes of flash.
        for (digit, power) in buffer.iter_mut().zip((0..20).rev()) {
            let unit = power_of_ten(power);
            while number >= unit {
                number -= unit;
                *digit += 1;
            }
        }
        Self { buffer }
    }

    /// The digits without leading zeros; `0` for zero.
    pub(super) fn digits(&self) -> &[u8] {
        let zeros = self
            .buffer
            .iter()
            .take(19)
            .take_while(|&&digit| digit == b'0');
        self.buffer.get(zeros.count()..).unwrap_or_default()
    }
}

/// `10^power`, for `power` up to 19.
fn power_of_ten(power: usize) -> u64 {
    (0..power).fold(1, |product, _| product * 10)
}

/// Size of a [`Wide`] in bytes.
const BYTES: usize = 20;

/// A number with more than 150 bits: `bytes × 2^exponent × 10^tens`, or slightly more.
///
/// Made of bytes, so that each product and quotient fits an instruction of a Cortex-M0.
pub(super) struct Wide {
    /// Most significant byte first.
    bytes: [u8; BYTES],
    exponent: i32,
    pub(super) tens: i32,
    /// Whether the true number is greater, by less than one unit.
    more: bool,
}

impl Wide {
    pub(super) const ZERO: Self = Self {
        bytes: [0; BYTES],
        exponent: 0,
        tens: 0,
        more: false,
    };

    fn new(whole: u64) -> Self {
        let mut wide = Self::ZERO;
        if let Some(low) = wide.bytes.last_chunk_mut() {
            *low = whole.to_be_bytes();
        }
        wide
    }

    pub(super) fn is_zero(&self) -> bool {
        self.bytes.iter().all(|&byte| byte == 0)
    }

    /// Appends digits with single `_` between them; returns how many there were.
    pub(super) fn read(&mut self, text: &mut Cursor<'_>, radix: u8) -> i32 {
        let mut count = 0;
        while let Some(digit) = digit(text, radix, count > 0) {
            count += 1;
            if let [0, ..] = self.bytes {
                self.step(radix.into(), digit);
            } else {
                // No room is left for this digit.
                self.more |= digit != 0;
                self.tens += 1;
            }
        }
        count
    }

    /// The number, if it is an integer and fits.
    pub(super) fn to_u64(&self) -> Option<u64> {
        let (high, low) = self.bytes.split_last_chunk()?;
        high.iter()
            .all(|&byte| byte == 0)
            .then_some(u64::from_be_bytes(*low))
    }

    /// Multiplies by up to 256, adds, and returns the overflow.
    fn step(&mut self, factor: u16, plus: u8) -> u8 {
        let mut carry = u16::from(plus);
        for byte in self.bytes.iter_mut().rev() {
            let product = u16::from(*byte) * factor + carry;
            *byte = product as u8;
            carry = product >> 8;
        }
        carry as u8
    }

    /// Divides by 5 or 8. `inverse` is 2^18 / divisor, rounded up, because a division is a library call.
    fn divide(&mut self, divisor: u32, inverse: u32) {
        let mut rest = 0;
        for byte in &mut self.bytes {
            let part = rest << 8 | u32::from(*byte);
            let quotient = (part * inverse) >> 18;
            *byte = quotient as u8;
            rest = part - quotient * divisor;
        }
        self.more |= rest != 0;
    }

    /// Shifts the number, which is above zero, left until its highest byte is used.
    fn fill(&mut self) {
        while let [0, ..] = self.bytes {
            self.step(256, 0);
            self.exponent -= 8;
        }
    }

    /// Folds the power of ten into the number, which is above zero.
    fn scale(&mut self) {
        while self.tens != 0 {
            self.fill();
            if self.tens > 0 {
                // 10 = 16 × 5/8.
                self.divide(8, 1 << 15);
                self.step(5, 0);
                self.exponent += 4;
                self.tens -= 1;
            } else {
                self.divide(5, 52429);
                self.exponent -= 1;
                self.tens += 1;
            }
        }
    }

    /// The integer part of a number from 1 to below 2^64, and whether there is a fraction.
    fn whole(mut self) -> (u64, bool) {
        let mut whole = 0;
        for _ in 0..self.exponent + 8 * BYTES as i32 {
            whole = whole << 1 | u64::from(self.step(2, 0));
        }
        let more = self.more || !self.is_zero();
        (whole, more)
    }
}

/// Consumes a digit, and a `_` before it if `inner` is set.
pub(super) fn digit(text: &mut Cursor<'_>, radix: u8, inner: bool) -> Option<u8> {
    let mark = usize::from(inner && text.peek() == b'_');
    let digit = match text.ahead(mark) {
        byte @ b'0'..=b'9' => byte - b'0',
        // Maps letters to 10 and above; other bytes become too large for any radix.
        byte => (byte | 0x20).wrapping_sub(b'a').saturating_add(10),
    };
    if digit >= radix {
        return None;
    }
    text.at += mark + 1;
    Some(digit)
}
