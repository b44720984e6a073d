//! A servo whose pulses are measured, on virtual time.

use super::*;
use crate::components::testing::{self, Pin, Wire};
use proptest::prelude::*;
use std::boxed::Box;
use std::format;
use std::string::String;
use std::vec::Vec;

struct Bench {
    wire: &'static Wire,
    servo: Servo<Pin<'static>>,
    now: Instant,
}

impl Bench {
    fn new(config: ServoConfig) -> Self {
        let wire: &'static Wire = Box::leak(Box::default());
        Self {
            servo: Servo::new("pan", Pin(wire), config),
            wire,
            now: Instant::from_millis(7),
        }
    }

    fn pass(&mut self, micros: u64) {
        self.now = Instant::from_micros(self.now.as_micros() + micros);
    }

    fn pulse_us(&self) -> f32 {
        // 20 ms in 65,000 counts.
        f32::from(self.wire.value.get()) / 3.25
    }

    fn start(&mut self, goal: &str) -> Result<(), String> {
        testing::start(&mut self.servo, self.now, goal)
    }

    fn poll(&mut self) -> (Run, String) {
        testing::poll(&mut self.servo, self.now)
    }

    #[track_caller]
    fn run(&mut self, step_us: u64) -> (Run, String) {
        for _ in 0..100_000 {
            let (run, text) = self.poll();
            if run != Run::Running {
                return (run, text);
            }
            self.pass(step_us);
        }
        panic!("the task does not end");
    }
}

fn completed(text: &str) -> (Run, String) {
    (Run::Completed, text.into())
}

#[test]
fn the_pulse_matches_the_angle() {
    let wide = ServoConfig {
        range: (-90, 90),
        pulse_us: (500, 2500),
        ..ServoConfig::DEFAULT
    };
    let backwards = ServoConfig {
        pulse_us: (2000, 1000),
        ..ServoConfig::DEFAULT
    };
    for (config, goal, told, pulse) in [
        (ServoConfig::DEFAULT, "0", "0.0", 1000.0),
        (ServoConfig::DEFAULT, "90", "90.0", 1500.0),
        (ServoConfig::DEFAULT, "180", "180.0", 2000.0),
        (ServoConfig::DEFAULT, "45.5", "45.5", 1252.8),
        (wide, "-90", "-90.0", 500.0),
        (wide, "-0.04", "0.0", 1499.6),
        (wide, "9e1", "90.0", 2500.0),
        (backwards, "0", "0.0", 2000.0),
        (backwards, "180", "180.0", 1000.0),
    ] {
        let mut bench = Bench::new(config);
        bench.start(goal).unwrap();
        assert_eq!(bench.run(10_000), completed(told));
        let found = bench.pulse_us();
        assert!(
            (found - pulse).abs() < 0.4,
            "{goal}: {found} in place of {pulse} µs"
        );
    }
}

#[test]
fn a_motion_takes_the_expected_time_and_reports_its_position() {
    let mut bench = Bench::new(ServoConfig::DEFAULT);
    let begin = bench.now;
    bench.start("180").unwrap();
    let mut told = Vec::new();
    while bench.poll().0 == Run::Running {
        told.push(bench.poll().1);
        bench.pass(250_000);
    }
    // 60 degrees a second within a quarter; late calls are not made good beyond 50 ms.
    assert_eq!(told[..4], ["90.0", "90.3", "91.3", "92.8"]);

    let mut bench = Bench::new(ServoConfig::DEFAULT);
    bench.start("180").unwrap();
    assert_eq!(bench.run(10_000), completed("180.0"));
    let took = bench.now.since(begin).as_millis();
    // 90 degrees at 60 a second, and a ramp's quarter of a second.
    assert!((1740..1800).contains(&took), "{took} ms");
}

#[test]
fn no_pulse_is_sent_before_the_first_task_or_twice() {
    let mut bench = Bench::new(ServoConfig::DEFAULT);
    bench.servo.make_safe(bench.now);
    assert_eq!(bench.wire.writes.get(), 0);
    bench.start("90").unwrap();
    assert_eq!(
        bench.poll(),
        completed("90.0"),
        "it is there, as it believes"
    );
    assert_eq!(bench.wire.writes.get(), 1);
    bench.start("90").unwrap();
    bench.poll();
    assert_eq!(bench.wire.writes.get(), 1);
}

#[test]
fn an_abort_decelerates_and_reports_the_stop_position() {
    let mut bench = Bench::new(ServoConfig::DEFAULT);
    bench.start("180").unwrap();
    bench.poll();
    for _ in 0..100 {
        bench.pass(10_000);
        bench.poll();
    }
    let (_, before) = bench.poll();
    bench.servo.abort(bench.now);
    let (run, text) = bench.run(10_000);
    assert_eq!(run, Run::Aborted);
    let way = text.parse::<f32>().unwrap() - before.parse::<f32>().unwrap();
    assert!(
        (way - 7.5).abs() < 0.4,
        "half of 60²/240 degrees, not {way}"
    );
    bench.start("0").unwrap();
    assert_eq!(bench.run(10_000), completed("0.0"));
}

#[test]
fn a_servo_made_safe_holds_or_releases_and_resumes_from_there() {
    for safe in [Power::Hold, Power::Release] {
        let mut bench = Bench::new(ServoConfig {
            safe,
            ..ServoConfig::DEFAULT
        });
        bench.start("0").unwrap();
        bench.poll();
        for _ in 0..50 {
            bench.pass(10_000);
            bench.poll();
        }
        let (pulse, (_, told)) = (bench.pulse_us(), bench.poll());
        bench.servo.make_safe(bench.now);
        assert_eq!(bench.poll().0, Run::Aborted);
        let (now, loss) = (bench.pulse_us(), bench.servo.offer().loss);
        match safe {
            Power::Hold => {
                assert_eq!(now, pulse);
                assert_eq!(loss, ztl_core::link::Loss::Hold);
            }
            Power::Release => {
                assert_eq!(now, 0.0);
                assert_eq!(loss, ztl_core::link::Loss::Abort);
            }
        }
        bench.pass(5_000_000);
        bench.start("180").unwrap();
        assert_eq!(bench.poll(), (Run::Running, told));
        assert_eq!(bench.pulse_us(), pulse);
        assert_eq!(bench.run(10_000), completed("180.0"));
        // At rest, too.
        let pulse = bench.pulse_us();
        bench.servo.make_safe(bench.now);
        for _ in 0..3 {
            bench.pass(10_000);
            assert_ne!(bench.poll().0, Run::Running);
            let expected = if safe == Power::Hold { pulse } else { 0.0 };
            assert_eq!(bench.pulse_us(), expected);
        }
    }
}

#[test]
fn a_failing_output_fails_the_task() {
    let mut bench = Bench::new(ServoConfig::DEFAULT);
    bench.wire.broken.set(true);
    bench.start("0").unwrap();
    let failed = (Run::Failed, "the PWM output failed".into());
    assert_eq!(bench.poll(), failed);
    bench.wire.broken.set(false);
    bench.start("0").unwrap();
    assert_eq!(bench.run(10_000), completed("0.0"));
}

#[test]
fn a_servo_that_cannot_be_released_fails_until_it_is() {
    let mut bench = Bench::new(ServoConfig {
        safe: Power::Release,
        ..ServoConfig::DEFAULT
    });
    bench.start("0").unwrap();
    bench.poll();
    bench.wire.broken.set(true);
    for _ in 0..3 {
        bench.servo.make_safe(bench.now);
        assert_eq!(bench.poll().0, Run::Failed);
    }
    bench.wire.broken.set(false);
    // `poll` alone does not drive it again.
    assert_eq!(bench.poll().0, Run::Failed);
    bench.servo.make_safe(bench.now);
    assert_eq!(bench.poll().0, Run::Aborted);
    assert_eq!(bench.wire.value.get(), 0);
    bench.start("0").unwrap();
    assert_eq!(bench.run(10_000), completed("0.0"));
}

#[test]
fn a_goal_out_of_range_is_rejected_with_the_valid_range() {
    let tilt = ServoConfig {
        range: (-30, 60),
        ..ServoConfig::DEFAULT
    };
    let mut bench = Bench::new(tilt);
    for goal in ["60.001", "-31", "up", "", "nan", "1e99"] {
        let refused = Err("pan takes -30 to 60 degrees".into());
        assert_eq!(bench.start(goal), refused, "{goal}");
    }
    assert_eq!(bench.servo.offer().goal.range, Some((-30.0, 60.0)));
    assert_eq!(bench.start("60"), Ok(()));
}

#[test]
fn an_invalid_configuration_causes_no_panic() {
    for config in [
        ServoConfig {
            range: (90, -90),
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            range: (5, 5),
            start: Some(90),
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            period_us: 0,
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            period_us: 1500,
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            speed: 0,
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            acceleration: 0,
            ..ServoConfig::DEFAULT
        },
        ServoConfig {
            range: (i16::MIN, i16::MAX),
            speed: u16::MAX,
            acceleration: u16::MAX,
            ..ServoConfig::DEFAULT
        },
    ] {
        let mut bench = Bench::new(config);
        bench.start("5").unwrap();
        for _ in 0..1000 {
            bench.poll();
            bench.pass(20_000);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn motion_between_any_two_calls_respects_the_speed_limit_and_direction(
        goals in proptest::collection::vec(0i32..=180_000, 1..4),
        gaps in proptest::collection::vec(1u64..80_000, 1..50),
        speed in 1u16..1000, acceleration in 20u16..5000,
    ) {
        let mut bench = Bench::new(ServoConfig { speed, acceleration, ..ServoConfig::DEFAULT });
        for goal in goals {
            bench.start(&format!("{goal}e-3")).unwrap();
            for turn in 0.. {
                let before = bench.servo.commanded_millidegrees();
                let gap = gaps[turn % gaps.len()];
                let (run, text) = bench.poll();
                let moved = bench.servo.commanded_millidegrees() - before;
                prop_assert!(moved.signum() * (goal - before).signum() >= 0);
                prop_assert!(turn < 400_000);
                if run != Run::Running {
                    prop_assert_eq!(run, Run::Completed);
                    prop_assert_eq!(text, format!("{:.1}", f64::from(number::rounded(goal, 2)) / 10.0));
                    break;
                }
                // The movement that the gap before the call allows, plus a tick for rounding.
                let last = gaps[(turn + gaps.len() - 1) % gaps.len()];
                let time = if turn == 0 { 0.0 } else { last as f64 + 1024.0 };
                let most = time * 1e-3 * f64::from(speed) + 1.0;
                prop_assert!(f64::from(moved).abs() <= most, "{moved} above {most}");
                bench.pass(gap);
            }
        }
    }
}
