//! Decimal numbers to binary ones and back, correctly rounded, in whole-number arithmetic only.
//!
//! The standard library's reader and writer take 20 KB of a Cortex-M0's flash, and a multiplication
//! of floats there is a library call as well.

use crate::cursor::Cursor;

/// A format of binary floating-point numbers.
#[derive(Debug)]
pub(super) struct Format {
    /// Bits of the fraction field.
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

/// Digits that tell any number from all others.
const LONGEST: usize = 17;

impl Format {
    /// The bits of infinity: an exponent field of ones.
    pub(super) const fn infinity(&self) -> u64 {
        ((2 - 2 * self.least) as u64 + 1) << self.fraction
    }

    /// The bit that says below zero.
    pub(super) const fn sign(&self) -> u64 {
        self.infinity() + (1 << self.fraction)
    }

    /// The bits of the number nearest to `wide`, of two equally near ones the even; `None` beyond the
    /// greatest.
    ///
    /// Exact for up to 64 bits: no product of these and a power of ten in the range of `f64` comes
    /// closer to the middle of two neighbours than some 2^-128 of itself (Mushtak and Lemire, "Fast
    /// number parsing without fallback"), unless it is the middle; [`Wide`] errs by less than
    /// 2^-140, and knows when not at all.
    pub(super) fn nearest(&self, wide: &mut Wide) -> Option<u64> {
        if wide.is_zero() {
            return Some(0);
        }
        // Beyond this it is zero or too much, which bounds the work.
        wide.tens = wide.tens.clamp(-400, 400);
        wide.scale();
        // Bit by bit, and one bit more than the number has: it is `kept × 2^power`, and `0.wide` more.
        let lowest = self.least - self.fraction as i32 - 1;
        let mut power = wide.exponent + 8 * BYTES as i32;
        let mut kept = 0;
        while kept >> self.fraction < 2 && power > lowest {
            kept = kept << 1 | u64::from(wide.step(2, 0));
            power -= 1;
        }
        let field = (power - lowest).max(0) as u64;
        let up = kept & 1 != 0 && (kept & 2 != 0 || wide.more || !wide.is_zero());
        // The leading one adds itself to the exponent field; so does a carry.
        let bits = (field << self.fraction) + (kept >> 1) + u64::from(up);
        (bits < self.infinity()).then_some(bits)
    }

    /// The first decimal digits of the number with these bits, finite and above zero.
    fn digits(&self, bits: u64) -> Digits {
        let field = bits >> self.fraction;
        let mut mantissa = bits & ((1 << self.fraction) - 1);
        if field > 0 {
            mantissa |= 1 << self.fraction;
        }
        let binary = self.least - self.fraction as i32 + field.saturating_sub(1) as i32;
        // The logarithm of the highest bit, rounded down: 78913 / 2^18 is that of 2.
        let highest = binary + 63 - mantissa.leading_zeros() as i32;
        let power = (highest * 78913) >> 18;
        let mut wide = Wide::new(mantissa);
        wide.exponent = binary;
        wide.tens = Digits::COUNT as i32 - 1 - power;
        wide.scale();
        let (whole, more) = wide.whole();
        // One digit more, when the number is above the next power of ten.
        let text = Whole::of(whole);
        Digits {
            power: power + text.digits().len() as i32 - Digits::COUNT as i32,
            text,
            more,
        }
    }

    /// The shortest decimal number that reads back as these bits, finite and above zero; of several
    /// the nearest. As `digits` and the power of ten of the first of them.
    pub(super) fn shortest(&self, bits: u64) -> (u64, i32) {
        let all = self.digits(bits);
        let mut shortest = all.rounded(LONGEST);
        // With a number that reads back, one digit more does too.
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

    /// The number with these bits, finite and above zero, rounded to so many digits after the
    /// point; of two equally near ones the even. `None` is zero.
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

/// A number's first digits, at least [`COUNT`](Self::COUNT).
struct Digits {
    text: Whole,
    /// The power of ten of the first.
    power: i32,
    /// Whether other digits than 0 follow.
    more: bool,
}

impl Digits {
    const COUNT: usize = 18;

    /// The first `count` digits, and whether the number is nearer to one more; half way it is when
    /// that is even.
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

    /// The first `count` digits after rounding, and the power of ten of the first of them: 99 may
    /// have become 100.
    fn carried(&self, digits: u64, count: usize) -> (u64, i32) {
        if digits == power_of_ten(count) {
            (1, self.power + 1)
        } else {
            (digits, self.power)
        }
    }
}

/// A whole number in decimal.
pub(super) struct Whole {
    buffer: [u8; 20],
}

impl Whole {
    pub(super) fn of(mut number: u64) -> Self {
        let mut buffer = [b'0'; 20];
        // By subtraction, for a division of 64 bits takes 900 bytes of flash.
        for (digit, power) in buffer.iter_mut().zip((0..20).rev()) {
            let unit = power_of_ten(power);
            while number >= unit {
                number -= unit;
                *digit += 1;
            }
        }
        Self { buffer }
    }

    /// The digits without zeros before them; one for zero.
    pub(super) fn digits(&self) -> &[u8] {
        let zeros = self
            .buffer
            .iter()
            .take(19)
            .take_while(|&&digit| digit == b'0');
        self.buffer.get(zeros.count()..).unwrap_or_default()
    }
}

/// `10^power`, for up to 19.
fn power_of_ten(power: usize) -> u64 {
    (0..power).fold(1, |product, _| product * 10)
}

/// Bytes of a [`Wide`].
const BYTES: usize = 20;

/// A number to more than 150 bits: `bytes × 2^exponent × 10^tens`, and perhaps a bit more.
///
/// Bytes, so that no product or quotient takes more than a Cortex-M0 has an instruction for.
pub(super) struct Wide {
    /// Most significant first.
    bytes: [u8; BYTES],
    exponent: i32,
    pub(super) tens: i32,
    /// Whether the number is greater, by less than one.
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

    /// Appends digits with single `_` between them, and says how many there were.
    pub(super) fn read(&mut self, text: &mut Cursor<'_>, radix: u8) -> i32 {
        let mut count = 0;
        while let Some(digit) = digit(text, radix, count > 0) {
            count += 1;
            if let [0, ..] = self.bytes {
                self.step(radix.into(), digit);
            } else {
                // There is no room for it.
                self.more |= digit != 0;
                self.tens += 1;
            }
        }
        count
    }

    /// The number, if it is whole and fits.
    pub(super) fn to_u64(&self) -> Option<u64> {
        let (high, low) = self.bytes.split_last_chunk()?;
        high.iter()
            .all(|&byte| byte == 0)
            .then_some(u64::from_be_bytes(*low))
    }

    /// Multiplies by up to 256, adds, and gives what has no room.
    fn step(&mut self, factor: u16, plus: u8) -> u8 {
        let mut carry = u16::from(plus);
        for byte in self.bytes.iter_mut().rev() {
            let product = u16::from(*byte) * factor + carry;
            *byte = product as u8;
            carry = product >> 8;
        }
        carry as u8
    }

    /// Divides by 5 or 8. `inverse` is 2^18 by the divisor, rounded up: a division is a library call.
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

    /// Moves the number, which is above zero, up until its highest byte is in use.
    fn fill(&mut self) {
        while let [0, ..] = self.bytes {
            self.step(256, 0);
            self.exponent -= 8;
        }
    }

    /// Makes the power of ten part of the number, which is above zero.
    fn scale(&mut self) {
        while self.tens != 0 {
            self.fill();
            if self.tens > 0 {
                // By 5/8 and 16.
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

    /// The whole part of a number from 1 to below 2^64, and whether there is a fraction.
    fn whole(mut self) -> (u64, bool) {
        let mut whole = 0;
        for _ in 0..self.exponent + 8 * BYTES as i32 {
            whole = whole << 1 | u64::from(self.step(2, 0));
        }
        let more = self.more || !self.is_zero();
        (whole, more)
    }
}

/// Reads a digit, and a `_` before it if it is `inner`.
#[cfg_attr(target_os = "none", inline(never))]
pub(super) fn digit(text: &mut Cursor<'_>, radix: u8, inner: bool) -> Option<u8> {
    let mark = usize::from(inner && text.peek() == b'_');
    let digit = match text.ahead(mark) {
        byte @ b'0'..=b'9' => byte - b'0',
        // Letters follow; what is none is too much.
        byte => (byte | 0x20).wrapping_sub(b'a').saturating_add(10),
    };
    if digit >= radix {
        return None;
    }
    text.at += mark + 1;
    Some(digit)
}
