//! Decimal numbers to binary ones and back, correctly rounded, in whole-number arithmetic only.
//!
//! The standard library's reader and writer take 20 KB of a Cortex-M0's flash, and a multiplication
//! of floats there is a library call as well.

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

/// Decimal digits that [`Digits`] has.
const DIGITS: u32 = 18;

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
    /// 2^-150, and knows when not at all.
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

    /// The first 18 decimal digits of the number with these bits, finite and above zero.
    fn digits(&self, bits: u64) -> Digits {
        let field = bits >> self.fraction;
        let mut mantissa = bits & ((1 << self.fraction) - 1);
        if field > 0 {
            mantissa |= 1 << self.fraction;
        }
        let binary = self.least - self.fraction as i32 + (field.saturating_sub(1)) as i32;
        // The logarithm of the highest bit, rounded down: 78913 / 2^18 is that of 2.
        let highest = binary + 63 - mantissa.leading_zeros() as i32;
        let mut power = (highest * 78913) >> 18;
        let mut wide = Wide::new(mantissa, binary, false);
        wide.scale(DIGITS as i32 - 1 - power);
        let (mut digits, mut more) = wide.whole();
        if digits >= power_of_ten(DIGITS) {
            more |= !digits.is_multiple_of(10);
            digits /= 10;
            power += 1;
        }
        Digits {
            digits,
            power,
            more,
        }
    }

    /// The shortest decimal number that reads back as these bits, finite and above zero; of several
    /// the nearest. As `digits` and the power of ten of the first of them.
    pub(super) fn shortest(&self, bits: u64) -> (u64, i32) {
        let all = self.digits(bits);
        for count in 1..DIGITS - 1 {
            let (down, up_is_nearer) = all.cut(count);
            let unit = all.power + 1 - count as i32;
            let reads_back = |digits: u64| self.nearest(digits, unit, false) == Some(bits);
            let (near, far) = match up_is_nearer {
                true => (down + 1, down),
                false => (down, down + 1),
            };
            for digits in [near, far] {
                if reads_back(digits) {
                    return all.carried(digits, count);
                }
            }
        }
        // Seventeen digits always do.
        let (down, up) = all.cut(DIGITS - 1);
        all.carried(down + u64::from(up), DIGITS - 1)
    }

    /// The number with these bits, finite and above zero, rounded to so many digits after the
    /// point; of two equally near ones the even. `None` is zero.
    pub(super) fn fixed(&self, bits: u64, decimals: i32) -> Option<(u64, i32)> {
        let all = self.digits(bits);
        let count = all.power + 1 + decimals;
        if count < 0 {
            return None;
        }
        let count = count.unsigned_abs().min(DIGITS);
        let (down, up) = all.cut(count);
        let digits = down + u64::from(up);
        (digits > 0).then(|| all.carried(digits, count))
    }
}

/// A number's first 18 digits.
#[derive(Debug)]
struct Digits {
    digits: u64,
    /// The power of ten of the first.
    power: i32,
    /// Whether other digits than 0 follow.
    more: bool,
}

impl Digits {
    /// The first `count` digits, at most 18, and whether the number is nearer to one more; half way
    /// it is when that is even.
    fn cut(&self, count: u32) -> (u64, bool) {
        let unit = power_of_ten(DIGITS - count);
        let down = self.digits / unit;
        let rest = self.digits % unit;
        let up = match rest.cmp(&(unit / 2)) {
            _ if unit == 1 => false,
            core::cmp::Ordering::Less => false,
            core::cmp::Ordering::Equal => self.more || down & 1 != 0,
            core::cmp::Ordering::Greater => true,
        };
        (down, up)
    }

    /// The first `count` digits after rounding, and the power of ten of the first of them: 99 may
    /// have become 100.
    fn carried(&self, digits: u64, count: u32) -> (u64, i32) {
        if digits == power_of_ten(count) {
            (1, self.power + 1)
        } else {
            (digits, self.power)
        }
    }
}

/// `10^power`, for up to 18.
fn power_of_ten(power: u32) -> u64 {
    (0..power).fold(1, |product, _| product * 10)
}

/// Limbs of a [`Wide`]: the first may be a single bit, and a division may take as much as the next;
/// five are left.
const LIMBS: usize = 7;

/// A number above zero to at least 160 bits: `limbs × 2^exponent`, and perhaps a bit more.
struct Wide {
    /// Least significant first.
    limbs: [u32; LIMBS],
    exponent: i32,
    /// Whether bits other than 0 were cut off below.
    more: bool,
}

impl Wide {
    fn new(mantissa: u64, exponent: i32, more: bool) -> Self {
        let [low, high] = [mantissa as u32, (mantissa >> 32) as u32];
        Self {
            limbs: [low, high, 0, 0, 0, 0, 0],
            exponent,
            more,
        }
    }

    /// Multiplies by a power of ten.
    fn scale(&mut self, power: i32) {
        let mut left = power.unsigned_abs();
        while left > 0 {
            // The greatest that one limb holds.
            let step = left.min(9);
            let factor = power_of_ten(step);
            if power > 0 {
                self.multiply(factor);
            } else {
                self.divide(factor);
            }
            left -= step;
        }
    }

    fn multiply(&mut self, factor: u64) {
        let mut carry = 0;
        for limb in &mut self.limbs {
            let product = u64::from(*limb) * factor + carry;
            *limb = product as u32;
            carry = product >> 32;
        }
        if carry > 0 {
            self.limbs.rotate_left(1);
            let [.., last] = &mut self.limbs;
            self.more |= *last != 0;
            *last = carry as u32;
            self.exponent += 32;
        }
    }

    fn divide(&mut self, divisor: u64) {
        self.fill();
        let mut rest = 0;
        for limb in self.limbs.iter_mut().rev() {
            let part = rest << 32 | u64::from(*limb);
            *limb = (part / divisor) as u32;
            rest = part % divisor;
        }
        self.more |= rest != 0;
    }

    /// Moves the number up until its highest limb is in use.
    fn fill(&mut self) {
        for _ in 0..LIMBS {
            let [.., last] = self.limbs;
            if last != 0 {
                break;
            }
            self.limbs.rotate_right(1);
            self.exponent -= 32;
        }
    }

    /// As `top × 2^exponent` with bit 63 of `top` set, and whether that is less than the number.
    fn top(mut self) -> (u64, i32, bool) {
        self.fill();
        let [rest @ .., third, second, first] = self.limbs;
        let shift = first.leading_zeros();
        let high = u64::from(first) << 32 | u64::from(second);
        let low = u64::from(third) << shift;
        let top = high << shift | low >> 32;
        let more = self.more || low as u32 != 0 || rest.iter().any(|&limb| limb != 0);
        let below = 32 * (LIMBS as i32 - 2) - shift as i32;
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
