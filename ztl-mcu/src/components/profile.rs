//! A motion at limited speed and acceleration, in integers: exact, and without a division.
//!
//! Time is divided into ticks of 1024 µs. The speed changes only between ticks, by one *rung*: the speed that the
//! acceleration adds in a tick. The stopping distance is then a sum that one addition updates, so the rule "never faster
//! than can be stopped before the target" takes a few instructions per tick on a Cortex-M0.

use ztl_core::Instant;

/// Logarithm of a tick's length in µs.
const TICK_SHIFT: u32 = 10;

/// Length of a tick in µs.
pub(super) const TICK_US: u32 = 1 << TICK_SHIFT;

/// Whole ticks from `earlier` to `now`; 0 if `now` is earlier.
pub(super) fn ticks_between(earlier: Instant, now: Instant) -> u64 {
    now.as_micros().saturating_sub(earlier.as_micros()) >> TICK_SHIFT
}

/// The instant this many ticks later.
pub(super) fn after_ticks(moment: Instant, ticks: u64) -> Instant {
    moment.after(ticks << TICK_SHIFT)
}

/// Maximum speed and acceleration of a profile.
///
/// Positions are counted in *parts* of a unit, so that slow motions are exact too. The caller chooses their number, at
/// most 2^24.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Limits {
    /// The change of speed from tick to tick, in parts per tick. Not 0.
    rung: u32,
    /// Number of rungs up to the maximum speed. Not 0.
    top: u32,
}

impl Limits {
    /// The limits for a speed in units a second and an acceleration in units a second squared, with
    /// this many parts to a unit.
    ///
    /// Both are reached to within a rung, and never exceeded. Unusable values are limited: to at least 1, and a speed
    /// below 2^32 parts per tick.
    pub(super) const fn new(speed: u32, acceleration: u32, parts: u32) -> Self {
        let speed = per_tick(speed, parts);
        // Times 2^20 / 10^12, with factors that keep the product within 64 bits.
        let rung = (acceleration as u64).saturating_mul(counted(parts) * 256) / 244_140_625;
        let rung = within(1, rung, speed as u64);
        // A slightly smaller rung, so that the speed is a whole number of rungs.
        let top = divided(speed - 1, rung) + 1;
        Self {
            rung: divided(speed, top),
            top,
        }
    }

    /// The same acceleration with another maximum speed, which is not raised.
    pub(super) const fn slower(self, speed: u32, parts: u32) -> Self {
        let rungs = divided(per_tick(speed, parts), self.rung);
        Self {
            rung: self.rung,
            top: within(1, rungs as u64, self.top as u64),
        }
    }

    /// Maximum change of speed from tick to tick, in parts per tick.
    #[cfg(test)]
    const fn acceleration_per_tick(self) -> u32 {
        self.rung
    }

    /// Maximum speed in parts per tick.
    #[cfg(test)]
    const fn speed_per_tick(self) -> u32 {
        self.rung * self.top
    }
}

/// A position that moves to its target by a trapezoid: it accelerates, keeps the maximum speed, decelerates.
///
/// The target may change at any time, also to one that was passed already: the motion then decelerates, turns and comes
/// back. In every tick the speed is within the limits and changes by at most the acceleration. The motion ends exactly on
/// the target, and never turns while the target stays ahead.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Profile {
    position: i64,
    target: i64,
    /// Speed in the last tick, in rungs.
    rungs: u32,
    /// Stopping distance from this speed in parts, without the last tick.
    stop: u64,
    forward: bool,
    /// The last tick moved by less than a rung. The next one rests, because a turn would be too sharp.
    crept: bool,
}

impl Profile {
    /// At rest at this position, in parts.
    pub(super) const fn new(position: i64) -> Self {
        Self {
            position,
            target: position,
            rungs: 0,
            stop: 0,
            forward: true,
            crept: false,
        }
    }

    /// Sets the target, in parts; at most 2^60 from 0.
    pub(super) const fn move_to(&mut self, target: i64) {
        self.target = target;
    }

    /// Where it would stop if it decelerated from now on, in parts.
    pub(super) const fn stopping_point(&self) -> i64 {
        if self.forward {
            self.position + self.stop as i64
        } else {
            self.position - self.stop as i64
        }
    }

    /// Stops at this position at once, regardless of the limits.
    pub(super) const fn put(&mut self, position: i64) {
        *self = Self::new(position);
    }

    /// Advances by a tick. Returns the distance in parts, negative if backwards.
    pub(super) const fn advance(&mut self, limits: Limits) -> i64 {
        let way = self.target - self.position;
        if self.rungs == 0 {
            self.forward = way >= 0;
        }
        let ahead = if self.forward { way } else { -way };
        let speed = self.next_speed(ahead, limits);
        let moved = if self.forward { speed } else { -speed };
        self.position += moved;
        moved
    }

    /// The highest speed for the next tick that can be stopped within the distance `ahead`.
    const fn next_speed(&mut self, ahead: i64, limits: Limits) -> i64 {
        if self.crept {
            self.crept = false;
            return 0;
        }
        let rung = limits.rung as i64;
        let speed = self.speed(limits) as i64;
        let stop = self.stop as i64;
        if self.rungs < limits.top && stop + speed + speed + rung <= ahead {
            self.rungs += 1;
            self.stop += speed as u64;
            return speed + rung;
        }
        if self.rungs > 0 && self.rungs <= limits.top && stop + speed <= ahead {
            return speed;
        }
        if self.rungs > 1 {
            self.rungs -= 1;
            self.stop -= (speed - rung) as u64;
            return speed - rung;
        }
        // The remaining distance is less than a rung, or behind.
        self.rungs = 0;
        if ahead <= 0 {
            return 0;
        }
        self.crept = true;
        ahead
    }

    /// Continues from this position, in parts, at a speed that is halved this often: the motion was delayed.
    pub(super) const fn held_up(&mut self, position: i64, halvings: u32, limits: Limits) {
        self.position = position;
        self.rungs = match self.rungs.checked_shr(halvings) {
            Some(rungs) => rungs,
            None => 0,
        };
        let below = self.rungs.saturating_sub(1) as u64;
        self.stop = self.rungs as u64 * below / 2 * limits.rung as u64;
        self.crept = false;
    }

    /// The position after the last tick, in parts.
    pub(super) const fn position(&self) -> i64 {
        self.position
    }

    /// Whether it rests on its target.
    pub(super) const fn is_at_rest(&self) -> bool {
        self.rungs == 0 && self.position == self.target
    }

    /// Whether it moves, or last moved, towards larger positions.
    pub(super) const fn is_forward(&self) -> bool {
        self.forward
    }

    /// The speed in parts per tick, without its direction.
    pub(super) const fn speed(&self, limits: Limits) -> u32 {
        self.rungs * limits.rung
    }
}

/// Converts units per second to parts per tick: times 1024 / 10^6.
const fn per_tick(speed: u32, parts: u32) -> u32 {
    let speed = (speed as u64).saturating_mul(counted(parts) * 16) / 15_625;
    within(1, speed, u32::MAX as u64)
}

/// The number of parts in a unit, within its limits.
const fn counted(parts: u32) -> u64 {
    within(1, parts as u64, 1 << 24) as u64
}

/// Limits the value to a range of 32-bit numbers.
const fn within(least: u64, value: u64, most: u64) -> u32 {
    if value < least {
        least as u32
    } else if value > most {
        most as u32
    } else {
        value as u32
    }
}

/// A division whose divisor is not 0, which the compiler may not see.
const fn divided(value: u32, by: u32) -> u32 {
    match value.checked_div(by) {
        Some(quotient) => quotient,
        None => value,
    }
}

#[cfg(test)]
mod tests;
