//! When the steps are due.

use ztl_core::Instant;

use crate::components::profile::{Limits, Profile, TICK_US, after_ticks};

/// Logarithm of the parts of a step that the profile counts.
const SHIFT: u32 = 24;
/// Parts of a step.
pub(super) const PARTS: u32 = 1 << SHIFT;

/// Ticks without a step that a late call makes good at most.
const MOST_TICKS: u32 = 32;

const NEVER: Instant = Instant::from_micros(u64::MAX);

/// The driver's demands, in µs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Timing {
    /// Least width of a pulse, and of the pause after it.
    pub(super) pulse_us: u32,
    /// From a change of direction to the next step.
    pub(super) direction_us: u32,
    /// From step to step at full speed.
    pub(super) interval_us: u32,
}

/// What the pins are to do now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Due {
    Direction { forward: bool },
    Step { forward: bool },
    PulseEnd,
}

/// Steps on virtual time: from the profile's ticks to edges of pins.
///
/// The profile says how far a tick goes; the steps within it are evenly spaced, so their distance is
/// never less than at the greatest speed. Time that a call is late is added to the tick: the motion
/// is delayed, and no step comes sooner to make up for it. If it was late by more than a step takes,
/// the motor has been standing still meanwhile, so it also goes on at a lower speed.
#[derive(Debug, Clone, Hash)]
pub(super) struct Generator {
    timing: Timing,
    limits: Limits,
    profile: Profile,
    /// When the present tick began.
    tick: Instant,
    /// Where it began, in parts.
    base: i64,
    /// How far it goes, in parts.
    travel: u32,
    /// Steps made.
    steps: i32,
    /// When the next step of this tick is due, if it has one; `None` as long as that is not computed,
    /// which takes a division.
    next: Option<Option<Instant>>,
    /// No step before this.
    ready: Instant,
    /// What the direction pin says.
    direction: Option<bool>,
    /// Whether the step pin is high.
    high: bool,
    moving: bool,
    /// Nothing is due before.
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
            wake: NEVER,
        }
    }

    /// Moves to this step, not before `begin`, or from the motion that is under way.
    pub(super) fn move_to(&mut self, begin: Instant, steps: i32, limits: Limits) {
        self.limits = limits;
        self.profile.move_to(parts(steps.into()));
        if !self.moving {
            self.moving = true;
            self.tick = begin;
            self.wake = begin;
        }
    }

    /// Slows down and rests on a whole step.
    pub(super) const fn stop(&mut self) {
        let point = self.profile.stopping_point();
        let steps = if self.profile.is_forward() {
            -(-point >> SHIFT)
        } else {
            point >> SHIFT
        };
        self.profile.move_to(parts(steps));
    }

    /// No step from now on.
    pub(super) const fn halt(&mut self) {
        self.put(self.steps);
    }

    /// At rest at this step at once.
    pub(super) const fn put(&mut self, steps: i32) {
        self.steps = steps;
        self.base = parts(steps as i64);
        self.profile.put(self.base);
        self.travel = 0;
        self.next = None;
        self.moving = false;
        if !self.high {
            self.wake = NEVER;
        }
    }

    /// What is due; the same again until it is [`done`](Self::done). Work of some microseconds.
    pub(super) fn due(&mut self, now: Instant) -> Option<Due> {
        if now < self.wake {
            return None;
        }
        if self.high {
            return Some(Due::PulseEnd);
        }
        if !self.moving {
            self.wake = NEVER;
            return None;
        }
        for _ in 0..MOST_TICKS {
            let forward = self.profile.is_forward();
            if self.travel > 0 && self.direction != Some(forward) {
                return Some(Due::Direction { forward });
            }
            if let Some(nominal) = self.next_step() {
                let due = nominal.max(self.ready);
                if now >= due {
                    return Some(Due::Step { forward });
                }
                self.wake = due;
                return None;
            }
            let end = after_ticks(self.tick, 1);
            if now < end {
                self.wake = end;
                return None;
            }
            if self.profile.is_at_rest() {
                self.halt();
                return None;
            }
            self.begin_tick(end);
        }
        // Nobody has called for long; the rest of that time is not made good.
        self.tick = now;
        None
    }

    /// The pins have done what was due.
    pub(super) fn done(&mut self, now: Instant, due: Due) {
        match due {
            Due::Direction { forward } => {
                self.direction = Some(forward);
                self.ready = self.ready.max(after(now, self.timing.direction_us));
            }
            Due::PulseEnd => {
                self.high = false;
                self.ready = self.ready.max(after(now, self.timing.pulse_us));
                self.wake = if self.moving { now } else { NEVER };
            }
            Due::Step { forward } => {
                let nominal = self.next_step().unwrap_or(now);
                self.next = None;
                self.steps = self.steps.wrapping_add(if forward { 1 } else { -1 });
                self.high = true;
                self.ready = after(now, self.timing.interval_us);
                self.wake = after(now, self.timing.pulse_us);
                let late = now.as_micros().saturating_sub(nominal.as_micros());
                self.tick = Instant::from_micros(self.tick.as_micros().saturating_add(late));
                if self.is_held_up(late) {
                    while self.is_held_up(late) {
                        let position = parts(self.steps.into());
                        self.profile.held_up(position, self.limits);
                    }
                    self.begin_tick(now);
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

    /// When something may be due.
    pub(super) const fn wake(&self) -> Instant {
        self.wake
    }

    fn begin_tick(&mut self, begin: Instant) {
        self.tick = begin;
        self.next = None;
        self.base = self.profile.position();
        // The speed is below 2^32.
        self.travel = self.profile.advance(self.limits).unsigned_abs() as u32;
    }

    /// When the next step of this tick is due; `None` when it has no more.
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
        // Rounded up, in 32 bits: exactly, or for fast motions to a microsecond.
        let micros = if travel < 1 << 22 {
            (way << 10).div_ceil(travel.max(1))
        } else {
            (way / (travel >> 10).max(1) + 1).min(TICK_US)
        };
        Some(after(self.tick, micros))
    }

    /// Whether a step that was late by so much took more than twice its time.
    fn is_held_up(&self, late_us: u64) -> bool {
        let speed = u64::from(self.profile.speed(self.limits));
        let late = late_us.min(u32::MAX.into());
        late * speed > u64::from(PARTS) * u64::from(TICK_US)
    }
}

const fn parts(steps: i64) -> i64 {
    steps << SHIFT
}

pub(super) const fn after(moment: Instant, micros: u32) -> Instant {
    Instant::from_micros(moment.as_micros().saturating_add(micros as u64))
}
