//! Decimal numbers to binary ones and back, correctly rounded, in whole-number arithmetic only.
//!
//! The standard library's reader and writer take 20 KB of a Cortex-M0's flash, and a multiplication
//! of floats there is a library call as well.

use core::num::NonZeroU32;

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

const TEN: NonZeroU32 = NonZeroU32::MIN.saturating_add(9);
const TEN_THOUSAND: NonZeroU32 = NonZeroU32::MIN.saturating_add(9999);

impl Format {
    /// The bits of infinity: an exponent field of ones.
    pub(super) const fn infinity(&self) -> u64 {
        ((2 - 2 * self.least) as u64 + 1) << self.fraction
    }

    /// The bits of the number nearest to `mantissa × 10^exponent`, of two equally near ones the
    /// even; `None` beyond the greatest. `more` says that the mantissa was cut: the number is
    /// greater, by less than one mantissa unit.
    ///
    /// Exact unless `more`: no product of 64 bits and a power of ten in the range of `f64` comes
    /// closer to the middle of two neighbours than some 2^-128 of itself (Mushtak and Lemire, "Fast
    /// number parsing without fallback"), unless it is the middle; [`Wide`] errs by less than
    /// 2^-180, and knows when not at all.
    pub(super) fn nearest(&self, mantissa: u64, exponent: i32, more: bool) -> Option<u64> {
        // Far beyond either end, which bounds the work.
        if mantissa == 0 || exponent < -400 {
            return Some(0);
        }
        if exponent > 400 {
            return None;
        }
        let mut wide = Wide::new(mantissa, 0, more);
        wide.scale(exponent);
        let (top, binary, more) = wide.top();
        // `top × 2^binary` with bit 63 set is `1.… × 2^power`.
        let power = binary + 63;
        let below = (self.least - power).max(0);
        let dropped = 63 - self.fraction + below.unsigned_abs();
        if dropped > 64 {
            return Some(0);
        }
        let kept = top.checked_shr(dropped).unwrap_or(0);
        let half = 1 << (dropped - 1);
        let rest = top & (half - 1);
        let up = top & half != 0 && (rest != 0 || more || kept & 1 != 0);
        // The leading one adds itself to the exponent field; so does a carry.
        let field = u64::from((power - self.least).max(0).unsigned_abs());
        let bits = (field << self.fraction) + kept + u64::from(up);
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
        let mut wide = Wide::new(mantissa, binary, false);
        wide.scale(Digits::COUNT as i32 - 1 - power);
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
            let reads_back = |&digits: &u64| self.nearest(digits, unit, false) == Some(bits);
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

/// Limbs of a [`Wide`]: a division may empty the first, and leave the next with two bits.
const LIMBS: usize = 14;

/// A number above zero to more than 190 bits: `limbs × 2^exponent`, and perhaps a bit more.
///
/// Limbs of 16 bits, so that a Cortex-M0 can multiply and divide them.
struct Wide {
    /// Least significant first.
    limbs: [u16; LIMBS],
    exponent: i32,
    /// Whether bits other than 0 were cut off below.
    more: bool,
}

impl Wide {
    fn new(mantissa: u64, exponent: i32, more: bool) -> Self {
        let mut limbs = [0; LIMBS];
        for (place, limb) in (0..4).zip(&mut limbs) {
            *limb = (mantissa >> (16 * place)) as u16;
        }
        Self {
            limbs,
            exponent,
            more,
        }
    }

    /// Multiplies by a power of ten.
    fn scale(&mut self, power: i32) {
        for _ in 0..power.unsigned_abs() / 4 {
            self.scale_once(power, TEN_THOUSAND);
        }
        for _ in 0..power.unsigned_abs() % 4 {
            self.scale_once(power, TEN);
        }
    }

    fn scale_once(&mut self, power: i32, by: NonZeroU32) {
        if power > 0 {
            self.multiply(by.get());
        } else {
            self.divide(by);
        }
    }

    fn multiply(&mut self, factor: u32) {
        let mut carry = 0;
        for limb in &mut self.limbs {
            let product = u32::from(*limb) * factor + carry;
            *limb = product as u16;
            carry = product >> 16;
        }
        if carry > 0 {
            let lowest = self.shift(carry as u16, true);
            self.more |= lowest != 0;
            self.exponent += 16;
        }
    }

    fn divide(&mut self, divisor: NonZeroU32) {
        self.fill();
        let mut rest = 0;
        for limb in self.limbs.iter_mut().rev() {
            let part = rest << 16 | u32::from(*limb);
            *limb = (part / divisor) as u16;
            rest = part % divisor;
        }
        self.more |= rest != 0;
    }

    /// Moves the number up until its highest limb is in use.
    fn fill(&mut self) {
        for _ in 0..LIMBS {
            let [.., highest] = self.limbs;
            if highest != 0 {
                break;
            }
            self.shift(0, false);
            self.exponent -= 16;
        }
    }

    /// Moves all limbs by one place, takes the new one and gives the one that has no place left.
    /// Limb by limb, since `rotate_left` takes 2 KB of flash.
    fn shift(&mut self, new: u16, down: bool) -> u16 {
        let mut moved = new;
        let mut each = |limb: &mut u16| core::mem::swap(limb, &mut moved);
        if down {
            self.limbs.iter_mut().rev().for_each(&mut each);
        } else {
            self.limbs.iter_mut().for_each(&mut each);
        }
        moved
    }

    /// As `top × 2^exponent` with bit 63 of `top` set, and whether that is less than the number.
    fn top(mut self) -> (u64, i32, bool) {
        self.fill();
        let [rest @ .., fifth, fourth, third, second, first] = self.limbs;
        let shift = first.leading_zeros();
        let high = [first, second, third, fourth];
        let high = high
            .iter()
            .fold(0, |high, &limb| high << 16 | u64::from(limb));
        let low = u32::from(fifth) << shift;
        let top = high << shift | u64::from(low >> 16);
        let more = self.more || low as u16 != 0 || rest.iter().any(|&limb| limb != 0);
        let below = 16 * (LIMBS as i32 - 4) - shift as i32;
        (top, self.exponent + below, more)
    }

    /// The whole part of a number from 1 to below 2^64, and whether there is a fraction.
    fn whole(self) -> (u64, bool) {
        let (top, exponent, more) = self.top();
        let shift = exponent.min(0).unsigned_abs().min(63);
        let whole = top >> shift;
        (whole, more || whole << shift != top)
    }
}
