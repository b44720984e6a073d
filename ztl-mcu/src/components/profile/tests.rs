//! Invariants of every motion, for any limits, targets and target changes.

use super::*;
use proptest::prelude::*;
use std::format;
use std::vec::Vec;

const PARTS: u32 = 1 << 24;

/// One motion, watched tick by tick.
struct Watched {
    profile: Profile,
    limits: Limits,
    /// The movement of the last tick.
    speed: i64,
}

impl Watched {
    fn new(limits: Limits) -> Self {
        Self {
            profile: Profile::new(0),
            limits,
            speed: 0,
        }
    }

    #[track_caller]
    fn tick(&mut self) -> i64 {
        let before = self.profile.position();
        let moved = self.profile.advance(self.limits);
        assert_eq!(self.profile.position(), before + moved);
        let most = i64::from(self.limits.speed_per_tick());
        assert!(moved.abs() <= most, "{moved} is above the speed {most}");
        let change = (moved - self.speed).abs();
        let most = i64::from(self.limits.acceleration_per_tick());
        assert!(
            change <= most,
            "{} to {moved} is above the acceleration {most}",
            self.speed
        );
        self.speed = moved;
        moved
    }

    /// Ticks until it rests; it may turn only where it may.
    #[track_caller]
    fn run_to(&mut self, target: i64, may_turn: bool) -> u64 {
        self.profile.move_to(target);
        let way = target - self.profile.position();
        let mut ticks = 0;
        while !self.profile.is_at_rest() {
            let moved = self.tick();
            assert!(
                may_turn || moved.signum() * way.signum() >= 0,
                "a tick of {moved} on a way of {way}"
            );
            ticks += 1;
            assert!(ticks < 2_000_000, "it never arrives");
        }
        assert_eq!(self.profile.position(), target);
        ticks
    }
}

/// Speeds and accelerations from sluggish to absurd, in units a second (squared).
fn limits() -> impl Strategy<Value = Limits> {
    let speed = prop_oneof![1u32..100, 100u32..50_000, Just(u32::MAX)];
    let acceleration = prop_oneof![20u32..1000, 1000u32..1_000_000, Just(u32::MAX)];
    (speed, acceleration).prop_map(|(speed, acceleration)| Limits::new(speed, acceleration, PARTS))
}

/// Ways of up to some thousand units, in parts; with ends between the rungs.
fn place() -> impl Strategy<Value = i64> {
    let unit = i64::from(PARTS);
    prop_oneof![
        -300 * unit..300 * unit,
        -unit / 100..unit / 100,
        (-300i64..300).prop_map(move |units| units * unit),
    ]
}

/// The shortest time for the way under exact limits, in ticks.
fn shortest(way: f64, limits: Limits) -> f64 {
    let rung = f64::from(limits.acceleration_per_tick());
    let top = f64::from(limits.speed_per_tick());
    if way <= top * top / rung {
        2.0 * (way / rung).sqrt()
    } else {
        way / top + top / rung
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_motion_reaches_its_target_without_reversing_in_almost_minimal_time(
        limits in limits(), target in place(),
    ) {
        let mut watched = Watched::new(limits);
        let ticks = watched.run_to(target, false);
        let least = shortest(target.abs() as f64, limits);
        prop_assert!(ticks as f64 <= least + 4.0, "{ticks} ticks in place of {least}");
    }

    #[test]
    fn a_target_changed_in_mid_motion_is_reached_within_the_limits(
        limits in limits(), targets in proptest::collection::vec((place(), 0u32..2000), 1..6),
    ) {
        let mut watched = Watched::new(limits);
        let mut last = 0;
        for (target, ticks) in targets {
            watched.profile.move_to(target);
            for _ in 0..ticks {
                watched.tick();
            }
            last = target;
        }
        watched.run_to(last, true);
    }

    #[test]
    fn consecutive_motions_stay_within_the_limits(
        limits in limits(), targets in proptest::collection::vec(place(), 2..6),
    ) {
        let mut watched = Watched::new(limits);
        for target in targets {
            watched.run_to(target, false);
        }
    }

    #[test]
    fn a_stop_in_mid_motion_ends_at_the_stopping_point_without_reversing(
        limits in limits(), target in place(), after in 0u32..3000,
    ) {
        let mut watched = Watched::new(limits);
        watched.profile.move_to(target);
        for _ in 0..after {
            watched.tick();
        }
        let stop = watched.profile.stopping_point();
        let speed = watched.speed.abs();
        let ticks = watched.run_to(stop, false);
        let least = speed / i64::from(limits.acceleration_per_tick());
        prop_assert!(ticks as i64 <= least + 1, "{ticks} ticks in place of {least}");
        prop_assert!(stop.abs() <= target.abs());
    }

    #[test]
    fn a_speed_lowered_in_mid_motion_is_reached_by_the_ramp(
        limits in limits(), speed in 1u32..1000, after in 0u32..3000,
    ) {
        let mut watched = Watched::new(limits);
        watched.profile.move_to(1 << 50);
        for _ in 0..after {
            watched.tick();
        }
        let slower = limits.slower(speed, PARTS);
        prop_assert!(slower.speed_per_tick() <= limits.speed_per_tick());
        while watched.speed > i64::from(slower.speed_per_tick()) {
            let before = watched.speed;
            let moved = watched.profile.advance(slower);
            prop_assert_eq!(before - moved, i64::from(limits.acceleration_per_tick()));
            watched.speed = moved;
        }
        watched.limits = slower;
        watched.tick();
    }

    #[test]
    fn a_delayed_motion_ends_on_the_target(
        limits in limits(), target in place(), after in 0u32..3000,
    ) {
        let mut watched = Watched::new(limits);
        watched.profile.move_to(target);
        for _ in 0..after {
            watched.tick();
        }
        // Half way through a tick.
        let position = watched.profile.position() - watched.speed / 2;
        watched.profile.held_up(position, 1, limits);
        prop_assert!(i64::from(watched.profile.speed(limits)) * 2 <= watched.speed.abs());
        watched.speed = i64::from(watched.profile.speed(limits)) * if watched.profile.is_forward() { 1 } else { -1 };
        watched.run_to(target, false);
    }

    #[test]
    fn limits_are_at_or_just_below_the_requested_values(
        speed in 1u32..200_000, acceleration in 1u32..1_000_000,
    ) {
        let limits = Limits::new(speed, acceleration, PARTS);
        let exact = f64::from(speed) * f64::from(PARTS) * 1.024e-3;
        let rung = f64::from(acceleration) * f64::from(PARTS) * 1.024e-3 * 1.024e-3;
        let got = f64::from(limits.speed_per_tick());
        prop_assert!(got <= exact && got >= exact * 0.94, "speed {got} of {exact}");
        let got = f64::from(limits.acceleration_per_tick());
        let rungs = (exact / rung).max(1.0);
        let least = rung.min(exact) * (rungs / (rungs + 1.0)) - 1.0;
        prop_assert!(got <= rung && got >= least - 1.0, "acceleration {got} of {rung}");
    }
}

#[test]
fn speed_rises_holds_and_falls_in_whole_steps() {
    let limits = Limits::new(1000, 250_000, PARTS);
    let rung = i64::from(limits.acceleration_per_tick());
    let mut watched = Watched::new(limits);
    watched.profile.move_to(rung * 22 + 5);
    let mut speeds = Vec::new();
    while !watched.profile.is_at_rest() {
        let moved = watched.tick();
        speeds.push((moved / rung, moved % rung));
    }
    let text = format!("{speeds:?}");
    assert_eq!(
        text,
        "[(1, 0), (2, 0), (3, 0), (4, 0), (4, 0), (3, 0), (2, 0), (2, 0), (1, 0), (0, 5)]"
    );
}
