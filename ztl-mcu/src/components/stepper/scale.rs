//! Steps and the unit that people use.

use crate::component::Report;
use crate::components::number;

/// Decimals of a goal in another unit than steps, and of a position in it.
const READ: u8 = 3;
const WRITTEN: u8 = 2;

/// How many steps there are to a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Scale {
    unit: &'static str,
    /// `None` for steps.
    ratio: Option<Ratio>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Ratio {
    /// Steps to a thousandth of the unit, in 2^-32.
    steps: u64,
    /// Thousandths of the unit to a step, in 2^-30.
    milli: i64,
}

impl Scale {
    /// Goals and positions are whole steps.
    pub const STEPS: Self = Self {
        unit: "steps",
        ratio: None,
    };

    /// So many steps make so many units: `Scale::new(3200, 360, "degrees")`. Goals are read, and rounded
    /// to a step, in thousandths of the unit, so ±2,147,483 units is the most. Positions are told in
    /// hundredths.
    #[must_use]
    #[inline(always)] // With constants there is no division at run time.
    pub const fn new(steps: u32, units: u16, unit: &'static str) -> Self {
        let steps = if steps == 0 { 1 } else { steps } as u64;
        let milli = if units == 0 { 1 } else { units as u64 } * 1000;
        Self {
            unit,
            ratio: Some(Ratio {
                steps: ((steps << 32) + milli / 2) / milli,
                milli: (((milli << 30) + steps / 2) / steps) as i64,
            }),
        }
    }

    /// What it is called.
    #[must_use]
    pub const fn unit(&self) -> &'static str {
        self.unit
    }

    /// The decimals of a goal.
    pub(super) const fn decimals(&self) -> u8 {
        if self.ratio.is_some() { READ } else { 0 }
    }

    /// A whole number of units, as goals are read; nearer to 0 when it is beyond what can be counted.
    pub(super) const fn whole(&self, units: i32) -> i32 {
        let Some(ratio) = self.ratio else {
            return units;
        };
        let mut milli = units.saturating_mul(1000);
        // Of two numbers, the product has at most as many bits as both together: 63 are 2^31 steps.
        while ratio.steps.leading_zeros() + milli.unsigned_abs().leading_zeros() < 64 + 32 - 63 {
            milli /= 2;
        }
        milli
    }

    /// A goal as it was read, of at most what [`whole`](Self::whole) says.
    pub(super) const fn to_steps(self, goal: i32) -> i32 {
        let Some(ratio) = self.ratio else {
            return goal;
        };
        let steps = (ratio.steps * goal.unsigned_abs() as u64 + (1 << 31)) >> 32;
        let steps = steps as i32;
        if goal < 0 { -steps } else { steps }
    }

    /// Adds a position.
    pub(super) fn report(&self, report: &mut Report<'_>, steps: i32) {
        let Some(ratio) = self.ratio else {
            return number::report(report, steps, 0);
        };
        // In 64 bits, as goals are in thousandths of 32.
        let milli = i64::from(steps)
            .wrapping_mul(ratio.milli)
            .wrapping_add(1 << 29)
            >> 30;
        let milli = milli.clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        number::report(report, number::rounded(milli, READ - WRITTEN), WRITTEN);
    }
}
