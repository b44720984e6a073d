//! Converts between steps and a unit.

use crate::component::Report;
use crate::components::number;

/// Decimals of a goal, if its unit is not steps.
const GOAL_DECIMALS: u8 = 3;
/// Decimals of a position, if its unit is not steps.
const POSITION_DECIMALS: u8 = 2;

/// The number of steps in a unit.
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
    /// Steps per thousandth of the unit, in units of 2^-32.
    steps: u64,
    /// Thousandths of the unit per step, in units of 2^-30.
    milli: i64,
}

impl Scale {
    /// Goals and positions are whole steps.
    pub const STEPS: Self = Self {
        unit: "steps",
        ratio: None,
    };

    /// A scale where `steps` steps are `units` units: `Scale::new(3200, 360, "degrees")`. Goals are parsed in thousandths
    /// of the unit, at most ±2,147,483 units, and rounded to a step. Positions are reported in hundredths.
    #[must_use]
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

    /// Name of the unit.
    #[must_use]
    pub const fn unit(&self) -> &'static str {
        self.unit
    }

    /// Decimals of a goal.
    pub(super) const fn decimals(&self) -> u8 {
        if self.ratio.is_some() {
            GOAL_DECIMALS
        } else {
            0
        }
    }

    /// Converts whole units to the integer of a parsed goal; limited to what can be counted in steps.
    pub(super) const fn whole(&self, units: i32) -> i32 {
        let Some(ratio) = self.ratio else {
            return units;
        };
        let mut milli = units.saturating_mul(1000);
        // A product has at most as many bits as both factors together; 63 bits are 2^31 steps.
        while ratio.steps.leading_zeros() + milli.unsigned_abs().leading_zeros() < 64 + 32 - 63 {
            milli /= 2;
        }
        milli
    }

    /// Converts a parsed goal, which is limited by [`whole`](Self::whole), to steps.
    pub(super) const fn to_steps(self, goal: i32) -> i32 {
        let Some(ratio) = self.ratio else {
            return goal;
        };
        let steps = (ratio.steps * goal.unsigned_abs() as u64 + (1 << 31)) >> 32;
        let steps = steps as i32;
        if goal < 0 { -steps } else { steps }
    }

    /// Writes a position.
    pub(super) fn report(&self, report: &mut Report<'_>, steps: i32) {
        let Some(ratio) = self.ratio else {
            return number::report(report, steps, 0);
        };
        // In 64 bits, because goals in thousandths take 32.
        let milli = i64::from(steps)
            .wrapping_mul(ratio.milli)
            .wrapping_add(1 << 29)
            >> 30;
        let milli = milli.clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        number::report(
            report,
            number::rounded(milli, GOAL_DECIMALS - POSITION_DECIMALS),
            POSITION_DECIMALS,
        );
    }
}
