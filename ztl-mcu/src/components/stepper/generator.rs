//! Decides when steps are due.

use ztl_core::Instant;

use crate::components::profile::{Limits, Profile, TICK_US, after_ticks};

/// Logarithm of the number of parts in a step.
const SHIFT: u32 = 24;
/// Parts of a step.
pub(super) const PARTS: u32 = 1 << SHIFT;

/// Ticks without a step that a late call catches up at most.
const MOST_TICKS: u32 = 32;

/// Timing of the driver chip, in µs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Timing {
    /// Minimum width of a pulse, and of the pause after it.
    pub(super) pulse_us: u32,
    /// From a change of direction to the next step.
    pub(super) direction_us: u32,
    /// From step to step at full speed.
    pub(super) interval_us: u32,
}

/// The next change of a pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Due {
    Direction { forward: bool },
    Step { forward: bool },
    PulseEnd,
}

/// Steps on virtual time: from the profile's ticks to edges of pins.
///
/// The profile gives the distance of a tick. The steps within a tick are evenly spaced, so their interval is never
/// shorter than at the maximum speed. A late call delays the motion; no later step comes sooner to compensate. If a call
/// is late by more than the duration of a step, the motor has stood still, so it continues at a lower speed.
#[derive(Debug, Clone, Hash)]
pub(super) struct Generator {
    timing: Timing,
    limits: Limits,
    profile: Profile,
    /// Start of the current tick.
    tick: Instant,
    /// Position at its start, in parts.
    base: i64,
    /// Its distance in parts.
    travel: u32,
    /// Position in steps.
    steps: i32,
    /// When the next step of this tick is due, if there is one. The outer `None` means not computed yet, because that
    /// takes a division.
    next: Option<Option<Instant>>,
    /// Earliest time of the next step.
    ready: Instant,
    /// Level of the direction pin.
    direction: Option<bool>,
    /// Whether the step pin is high.
    high: bool,
    moving: bool,
    /// Earliest time at which something is due.
    wake: Instant,
}

impl Generator {
    pub(super) const fn new(timing: Timing, limits: Limits) -> Self {
        Self {
            timing,
            limits,
            profile: Profile::new(0),
            tick: Instant::ZERO,
            base: 0,
            travel: 0,
            steps: 0,
            next: None,
            ready: Instant::ZERO,
            direction: None,
            high: false,
            moving: false,
            wake: Instant::NEVER,
        }
    }

    /// Moves to this step, starting at `begin`, or continues the current motion to it.
    pub(super) fn move_to(&mut self, begin: Instant, steps: i32, limits: Limits) {
        self.limits = limits;
        self.profile.move_to(parts(steps.into()));
        if !self.moving {
            self.moving = true;
            self.tick = begin;
            self.wake = begin;
        }
    }

    /// Decelerates and stops on a whole step.
    pub(super) const fn stop(&mut self) {
        let point = self.profile.stopping_point();
        let steps = if self.profile.is_forward() {
            -(-point >> SHIFT)
        } else {
            point >> SHIFT
        };
        self.profile.move_to(parts(steps));
    }

    /// Stops at once.
    pub(super) const fn halt(&mut self) {
        self.put(self.steps);
    }

    /// Stops at once, and declares the position to be this step.
    pub(super) const fn put(&mut self, steps: i32) {
        self.steps = steps;
        self.base = parts(steps as i64);
        self.profile.put(self.base);
        self.travel = 0;
        self.next = None;
        self.moving = false;
        if !self.high {
            self.wake = Instant::NEVER;
        }
    }

    /// The change that is due, until it is [`done`](Self::done). Takes some microseconds: a call makes a step or
    /// begins one tick, because it may be within a critical section. After a late one, the next call is due at once.
    pub(super) fn due(&mut self, now: Instant) -> Option<Due> {
        if now < self.wake {
            return None;
        }
        if self.high {
            return Some(Due::PulseEnd);
        }
        if !self.moving {
            self.wake = Instant::NEVER;
            return None;
        }
        let forward = self.profile.is_forward();
        if self.turns() {
            return Some(Due::Direction { forward });
        }
        if let Some(nominal) = self.next_step() {
            self.wake = nominal.max(self.ready);
            return (now >= self.wake).then_some(Due::Step { forward });
        }
        self.wake = after_ticks(self.tick, 1);
        if now < self.wake {
            return None;
        }
        if self.profile.is_at_rest() {
            self.halt();
            return None;
        }
        self.begin_tick(self.wake);
        let next = self.next_step();
        if !self.turns() {
            self.wake = next.map_or(after_ticks(self.tick, 1), |nominal| nominal.max(self.ready));
        }
        None
    }

    /// Like [`due`](Self::due), but a late call catches up several ticks.
    pub(super) fn due_caught_up(&mut self, now: Instant) -> Option<Due> {
        for _ in 0..MOST_TICKS {
            let due = self.due(now);
            if due.is_some() || now < self.wake {
                return due;
            }
        }
        // After a long pause, the remaining delay is not caught up.
        self.tick = now;
        self.next = None;
        None
    }

    /// Confirms that the pins were changed.
    pub(super) fn done(&mut self, now: Instant, due: Due) {
        match due {
            Due::Direction { forward } => {
                self.direction = Some(forward);
                self.ready = self.ready.max(now.after(self.timing.direction_us.into()));
            }
            Due::PulseEnd => {
                self.high = false;
                self.ready = self.ready.max(now.after(self.timing.pulse_us.into()));
                // Computed here, so that the call that makes the step takes less time.
                self.next_step();
                self.wake = if self.moving { now } else { Instant::NEVER };
            }
            Due::Step { forward } => {
                let nominal = self.next.flatten().unwrap_or(now);
                self.next = None;
                self.steps = self.steps.wrapping_add(if forward { 1 } else { -1 });
                self.high = true;
                self.ready = now.after(self.timing.interval_us.into());
                self.wake = now.after(self.timing.pulse_us.into());
                let late = now.as_micros().saturating_sub(nominal.as_micros());
                self.tick = self.tick.after(late);
                let halvings = self.halvings(late);
                if halvings > 0 {
                    let position = parts(self.steps.into());
                    self.profile.held_up(position, halvings, self.limits);
                    // Rests for a tick.
                    self.tick = now;
                    self.travel = 0;
                    self.next = Some(None);
                }
            }
        }
    }

    pub(super) const fn steps(&self) -> i32 {
        self.steps
    }

    pub(super) const fn is_moving(&self) -> bool {
        self.moving || self.high
    }

    /// When to call [`due`](Self::due) next.
    pub(super) const fn wake(&self) -> Instant {
        self.wake
    }

    /// Whether the direction pin has to change before the next step.
    fn turns(&self) -> bool {
        self.travel > 0 && self.direction != Some(self.profile.is_forward())
    }

    fn begin_tick(&mut self, begin: Instant) {
        self.tick = begin;
        self.next = None;
        self.base = self.profile.position();
        // The speed is below 2^32.
        self.travel = self.profile.advance(self.limits).unsigned_abs() as u32;
    }

    /// When the next step of this tick is due, if there is one.
    fn next_step(&mut self) -> Option<Instant> {
        if let Some(next) = self.next {
            return next;
        }
        let next = self.computed_step();
        self.next = Some(next);
        next
    }

    fn computed_step(&self) -> Option<Instant> {
        let way = if self.profile.is_forward() {
            parts(i64::from(self.steps) + 1) - self.base
        } else {
            self.base - parts(i64::from(self.steps) - 1)
        };
        let travel = self.travel;
        let way = u32::try_from(way).ok().filter(|&way| way <= travel)?;
        // Rounded up in 32 bits: exactly, or for fast motions to within a microsecond.
        let micros = if travel < 1 << 22 {
            (way << 10).div_ceil(travel.max(1))
        } else {
            (way / (travel >> 10).max(1) + 1).min(TICK_US)
        };
        Some(self.tick.after(micros.into()))
    }

    /// How often to halve the speed after a step that was this late: until the delay is less than the duration of a step.
    // Without a loop, which would take too long within a critical section.
    fn halvings(&self, late_us: u64) -> u32 {
        let speed = u64::from(self.profile.speed(self.limits));
        let late = late_us.min(u32::MAX.into());
        let steps = (late * speed / (u64::from(PARTS) * u64::from(TICK_US))) as u32;
        u32::BITS - steps.leading_zeros()
    }
}

const fn parts(steps: i64) -> i64 {
    steps << SHIFT
}
