//! A motion at limited speed and acceleration, in whole numbers: exact, and without a division.
//!
//! Time goes in ticks of 1024 µs, and speed changes between ticks only, by one *rung* at a time: the
//! acceleration's worth of a tick. The way that it takes to stop from a rung is then a sum that a
//! step up or down the ladder keeps by one addition, so the rule "never faster than can be stopped
//! before the target" costs a Cortex-M0 a few instructions a tick.

use ztl_core::Instant;

/// Logarithm of a tick's length in µs.
const TICK_SHIFT: u32 = 10;

/// Length of a tick in µs.
pub(super) const TICK_US: u32 = 1 << TICK_SHIFT;

/// Whole ticks from one moment to another; none when `now` is not after it.
pub(super) fn ticks_between(earlier: Instant, now: Instant) -> u64 {
    now.as_micros().saturating_sub(earlier.as_micros()) >> TICK_SHIFT
}

/// The moment that lies this many ticks later.
pub(super) fn after_ticks(moment: Instant, ticks: u64) -> Instant {
    Instant::from_micros(moment.as_micros().saturating_add(ticks << TICK_SHIFT))
}

/// Greatest speed and acceleration, as a profile counts them.
///
/// A position is counted in *parts* of a unit, so that slow motions are exact too; how many there
/// are is the caller's choice, at most 2^24.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Limits {
    /// The change of speed from tick to tick, in parts a tick. Not 0.
    rung: u32,
    /// How many rungs the greatest speed has. Not 0.
    top: u32,
}

impl Limits {
    /// The limits for a speed in units a second and an acceleration in units a second squared, with
    /// this many parts to a unit.
    ///
    /// Both are met or stayed below by less than a rung. Values that nothing could be done with are
    /// brought within what can: at least 1, and a speed below 2^32 parts a tick.
    #[must_use]
    #[inline(always)] // With constants there is no division at run time.
    pub const fn new(speed: u32, acceleration: u32, parts: u32) -> Self {
        let speed = per_tick(speed, parts);
        // 2^20 / 10^12, in numbers that keep the product within 64 bits.
        let rung = (acceleration as u64).saturating_mul(counted(parts) * 256) / 244_140_625;
        let rung = within(1, rung, speed as u64);
        // A somewhat lower rung, so that a whole number of them makes the speed.
        let top = divided(speed - 1, rung) + 1;
        Self {
            rung: divided(speed, top),
            top,
        }
    }

    /// The same acceleration up to another speed, never above the present one.
    #[must_use]
    #[inline(always)] // As above.
    pub const fn slower(self, speed: u32, parts: u32) -> Self {
        let rungs = divided(per_tick(speed, parts), self.rung);
        Self {
            rung: self.rung,
            top: within(1, rungs as u64, self.top as u64),
        }
    }

    /// Greatest change of speed from tick to tick, in parts a tick.
    #[must_use]
    pub const fn acceleration_per_tick(self) -> u32 {
        self.rung
    }

    /// Greatest speed in parts a tick.
    #[must_use]
    pub const fn speed_per_tick(self) -> u32 {
        self.rung * self.top
    }
}

/// A position that moves to its target by a trapezoid: speeding up, at the limit, slowing down.
///
/// The target may be changed at any time, also to one that has been passed by: the motion then slows
/// down, turns and comes back. In every tick the speed is within the limits and changes by no more
/// than the acceleration; the motion ends exactly on the target; as long as the target stays ahead,
/// it never turns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Profile {
    position: i64,
    target: i64,
    /// Speed of the last tick, in rungs.
    rungs: u32,
    /// Parts that it takes to stop from this speed, the last tick not counted.
    stop: u64,
    forward: bool,
    /// The last tick went at less than a rung; the next one rests, as a turn would be too sharp.
    crept: bool,
}

impl Profile {
    /// At rest at this position, in parts.
    #[must_use]
    pub const fn new(position: i64) -> Self {
        Self {
            position,
            target: position,
            rungs: 0,
            stop: 0,
            forward: true,
            crept: false,
        }
    }

    /// Where to, in parts; at most 2^60 of them from 0.
    pub const fn move_to(&mut self, target: i64) {
        self.target = target;
    }

    /// Where it would come to rest if it slowed down from now on, in parts.
    #[must_use]
    pub const fn stopping_point(&self) -> i64 {
        if self.forward {
            self.position + self.stop as i64
        } else {
            self.position - self.stop as i64
        }
    }

    /// At rest at this position at once, whatever the limits say.
    pub const fn put(&mut self, position: i64) {
        *self = Self::new(position);
    }

    /// The next tick. Says how far it goes: the speed in parts a tick, below 0 backwards.
    #[inline(never)] // Servos and steppers share it.
    pub const fn advance(&mut self, limits: Limits) -> i64 {
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

    /// The greatest speed for the next tick from which the way `ahead` suffices to stop.
    const fn next_speed(&mut self, ahead: i64, limits: Limits) -> i64 {
        if self.crept {
            self.crept = false;
            return 0;
        }
        let rung = limits.rung as i64;
        let speed = self.rungs as i64 * rung;
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
        // The rest is less than a rung, or lies behind.
        self.rungs = 0;
        if ahead <= 0 {
            return 0;
        }
        self.crept = true;
        ahead
    }

    /// At this position, in parts, at no more than half the speed: something held the motion up.
    pub(super) const fn held_up(&mut self, position: i64, limits: Limits) {
        self.position = position;
        self.rungs /= 2;
        let below = self.rungs.saturating_sub(1) as u64;
        self.stop = self.rungs as u64 * below / 2 * limits.rung as u64;
        self.crept = false;
    }

    /// The position after the last tick, in parts.
    #[must_use]
    pub const fn position(&self) -> i64 {
        self.position
    }

    /// Whether it has come to rest on its target.
    #[must_use]
    pub const fn is_at_rest(&self) -> bool {
        self.rungs == 0 && self.position == self.target
    }

    /// Whether it moves, or last moved, to greater positions.
    #[must_use]
    pub const fn is_forward(&self) -> bool {
        self.forward
    }

    /// The speed in parts a tick, without a direction.
    pub(super) const fn speed(&self, limits: Limits) -> u32 {
        self.rungs * limits.rung
    }
}

/// A speed in units a second, in parts a tick: times 1024 / 10^6.
#[inline(always)]
const fn per_tick(speed: u32, parts: u32) -> u32 {
    let speed = (speed as u64).saturating_mul(counted(parts) * 16) / 15_625;
    within(1, speed, u32::MAX as u64)
}

/// Of a unit.
#[inline(always)]
const fn counted(parts: u32) -> u64 {
    within(1, parts as u64, 1 << 24) as u64
}

/// The value, or the end that it is beyond; of ends in 32 bits.
#[inline(always)]
const fn within(least: u64, value: u64, most: u64) -> u32 {
    if value < least {
        least as u32
    } else if value > most {
        most as u32
    } else {
        value as u32
    }
}

/// By what is not 0, which the compiler may not see.
#[inline(always)]
const fn divided(value: u32, by: u32) -> u32 {
    match value.checked_div(by) {
        Some(quotient) => quotient,
        None => value,
    }
}

#[cfg(test)]
mod tests;
