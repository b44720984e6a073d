//! A motor that counts its steps and minds what its driver demands, on virtual time.

mod axis;
mod interrupt;

use super::*;
use axis::{Axis, Bench};
use proptest::prelude::*;
use std::format;
use std::string::String;

const CONFIG: StepperConfig = StepperConfig {
    speed: 4000,
    acceleration: 20_000,
    home_speed: 500,
    range: (-5000, 5000),
    ..StepperConfig::DEFAULT
};

/// When the main loop comes by.
#[derive(Debug, Clone)]
enum Calls {
    /// As asked for.
    OnTime,
    /// Each so many µs, as asked for or not.
    Each(u64),
    /// After these, over and over.
    After(std::vec::Vec<u64>),
}

fn calls() -> impl Strategy<Value = Calls> {
    let gap = prop_oneof![8 => 1u64..300, 3 => 300u64..2000, 1 => 2000u64..60_000];
    prop_oneof![
        Just(Calls::OnTime),
        (20u64..500).prop_map(Calls::Each),
        proptest::collection::vec(gap, 1..60).prop_map(Calls::After),
    ]
}

impl Bench {
    /// Turns until the task is over: how, and what was said.
    #[track_caller]
    fn run(&mut self, calls: &Calls) -> (Run, String) {
        for turn in 0..3_000_000 {
            let (run, text) = self.poll();
            if run != Run::Running {
                return (run, text);
            }
            self.wait(calls, turn);
        }
        panic!("the task does not end");
    }

    fn wait(&mut self, calls: &Calls, turn: usize) {
        let gap = match calls {
            Calls::OnTime => self.until_wake(),
            Calls::Each(gap) => *gap,
            Calls::After(gaps) => gaps[turn % gaps.len()],
        };
        self.pass(gap);
    }

    #[track_caller]
    fn go(&mut self, goal: &str, calls: &Calls) -> (Run, String) {
        self.start(goal).unwrap();
        self.run(calls)
    }
}

fn completed(text: &str) -> (Run, String) {
    (Run::Completed, text.into())
}

#[test]
fn a_motion_makes_its_steps_with_a_ramp_to_full_speed() {
    let mut bench = Bench::new(CONFIG, Axis::free());
    assert_eq!(bench.go("4000", &Calls::OnTime), completed("4000"));
    assert_eq!(bench.position(), 4000);
    // A fifth of a second for each ramp, in which 400 steps are made, and 3200 steps between.
    let time = bench.now_us() - bench.steps()[0];
    let ideal = 200_000 + 800_000 + 200_000;
    assert!((ideal - 20_000..ideal + 15_000).contains(&time), "{time}");
    assert_eq!(bench.shortest_interval(), 250);

    assert_eq!(bench.go("-12", &Calls::OnTime), completed("-12"));
    assert_eq!(bench.position(), -12);
    assert_eq!(bench.go("-12", &Calls::OnTime), completed("-12"));
}

#[test]
fn speed_changes_no_faster_than_the_acceleration() {
    let mut bench = Bench::new(CONFIG, Axis::free());
    bench.go("3000", &Calls::OnTime);
    let steps = bench.steps();
    for three in steps.windows(3) {
        let (first, second) = (three[1] - three[0], three[2] - three[1]);
        let change = 1e6 / second as f64 - 1e6 / first as f64;
        // Speed goes by ticks, so a tick's worth and rounding to a µs are allowed for.
        let time = (first + second) as f64 / 2e6 + 1.5e-3;
        let rounding = 1e6 / (second * second) as f64;
        let most = 20_000.0 * time + rounding;
        assert!(change.abs() <= most, "{three:?}: {change} above {most}");
    }
}

#[test]
fn calls_each_100_us_make_at_most_5000_steps_a_second() {
    let fast = StepperConfig {
        speed: 20_000,
        acceleration: 500_000,
        ..CONFIG
    };
    let mut bench = Bench::new(fast, Axis::free());
    assert_eq!(bench.go("2000", &Calls::Each(100)), completed("2000"));
    assert_eq!(bench.shortest_interval(), 200);
}

#[test]
fn an_interrupt_each_25_us_makes_20_000_steps_a_second() {
    let fast = StepperConfig {
        speed: 20_000,
        acceleration: 500_000,
        ..CONFIG
    };
    let mut bench = Bench::new(fast, Axis::free());
    assert_eq!(bench.go("5000", &Calls::Each(25)), completed("5000"));
    let steps = bench.steps();
    let time = steps[4000] - steps[1000];
    assert!(time < 3000 * 55, "{time}");
}

#[test]
fn after_a_long_main_loop_delay_the_motor_restarts_slowly_and_accelerates() {
    let mut bench = Bench::new(CONFIG, Axis::free());
    bench.start("5000").unwrap();
    while bench.steps().len() < 2000 {
        bench.poll();
        bench.wait(&Calls::OnTime, 0);
    }
    bench.pass(30_000);
    assert_eq!(bench.run(&Calls::OnTime), completed("5000"));
    let steps = bench.steps();
    let late = (1..steps.len())
        .find(|&at| steps[at] - steps[at - 1] > 25_000)
        .unwrap();
    // Not at 250 µs, as before.
    assert!(
        steps[late + 1] - steps[late] > 5000,
        "{:?}",
        &steps[late..late + 5]
    );
    assert_eq!(steps[4000] - steps[3999], 250);
}

#[test]
fn time_lost_to_a_late_call_is_not_recovered() {
    // No call arrives for this long after this step.
    let intervals = |silent_after: usize, silence: u64| {
        let mut bench = Bench::new(CONFIG, Axis::free());
        bench.start("300").unwrap();
        let mut silent = false;
        while bench.poll().0 == Run::Running {
            if bench.steps().len() == silent_after && !silent {
                silent = true;
                bench.pass(silence);
            } else {
                bench.wait(&Calls::OnTime, 0);
            }
        }
        let steps = bench.steps();
        let intervals = steps.windows(2).map(|two| two[1] - two[0]);
        intervals.collect::<std::vec::Vec<_>>()
    };
    let on_time = intervals(usize::MAX, 0);
    for step in [3, 10, 50, 280, 295] {
        // Longer than the pulse that it misses the end of, shorter than would count as a stop.
        let late = intervals(step, on_time[step - 1] * 8 / 5);
        assert!(late[step - 1] > on_time[step - 1] * 3 / 2);
        for (step, (late, on_time)) in late.iter().zip(&on_time).enumerate() {
            assert!(late + 2 >= *on_time, "step {step}: {late} for {on_time} µs");
        }
    }
}

#[test]
fn an_abort_decelerates_to_a_stop_and_reports_the_position() {
    let mut bench = Bench::new(CONFIG, Axis::free());
    bench.start("5000").unwrap();
    while bench.steps().len() < 1000 {
        bench.poll();
        bench.wait(&Calls::OnTime, 0);
    }
    bench.abort();
    let (run, text) = bench.run(&Calls::OnTime);
    assert_eq!(run, Run::Aborted);
    assert_eq!(text, format!("{}", bench.position()));
    assert!((1395..1405).contains(&bench.position()), "{text}");
    let steps = bench.steps();
    let [.., before, last] = steps.as_slice() else {
        panic!()
    };
    assert!(last - before > 2000, "the last step comes softly");
    assert_eq!(bench.go("0", &Calls::OnTime), completed("0"));
    assert_eq!(bench.position(), 0);
}

#[test]
fn an_abort_before_the_first_step_makes_no_step() {
    let mut bench = Bench::new(CONFIG, Axis::free());
    bench.start("5000").unwrap();
    bench.abort();
    assert_eq!(bench.run(&Calls::OnTime), (Run::Aborted, "0".into()));
    assert_eq!(bench.position(), 0);
}

#[test]
fn homing_sets_zero_at_the_switch() {
    let mut bench = Bench::new(CONFIG, Axis::between(-700, 4000));
    assert_eq!(bench.go("100", &Calls::OnTime), completed("100"));
    assert_eq!(bench.go("home", &Calls::OnTime), completed("0"));
    assert_eq!(bench.position(), -700);
    let steps = bench.steps();
    let [.., before, last] = steps.as_slice() else {
        panic!()
    };
    assert!(last - before >= 2000, "at the homing speed");
    // Once more, from there: no step is made.
    let count = steps.len();
    assert_eq!(bench.go("home", &Calls::OnTime), completed("0"));
    assert_eq!(bench.steps().len(), count);
    assert_eq!(bench.go("30", &Calls::OnTime), completed("30"));
    assert_eq!(bench.position(), -670);
}

#[test]
fn home_fails_when_the_switch_is_out_of_reach_or_the_task_is_aborted() {
    let mut bench = Bench::new(CONFIG, Axis::between(-50_000, 4000));
    let failed = (Run::Failed, "the home switch was not reached".into());
    assert_eq!(bench.go("home", &Calls::OnTime), failed);
    assert_eq!(bench.position(), -11_250);
    bench.start("home").unwrap();
    bench.pass(200_000);
    bench.poll();
    bench.abort();
    assert_eq!(bench.run(&Calls::OnTime).0, Run::Aborted);
}

#[test]
fn a_limit_switch_stops_at_once_and_allows_moving_away() {
    let mut bench = Bench::new(CONFIG, Axis::between(-700, 400));
    let failed = (Run::Failed, "limit switch at 400 steps".into());
    assert_eq!(bench.go("2000", &Calls::OnTime), failed);
    assert_eq!(bench.position(), 400);
    // It is still pressed: no step towards it.
    assert_eq!(bench.go("401", &Calls::OnTime), failed);
    assert_eq!(bench.position(), 400);
    assert_eq!(bench.go("350", &Calls::OnTime), completed("350"));
    let failed = (Run::Failed, "limit switch at -700 steps".into());
    assert_eq!(bench.go("-2000", &Calls::OnTime), failed);
    assert_eq!(bench.go("350", &Calls::OnTime), completed("350"));
    assert_eq!(bench.position(), 350);
}

#[test]
fn an_axis_that_requires_homing_homes_first() {
    let first = StepperConfig {
        home_first: true,
        ..CONFIG
    };
    let mut bench = Bench::new(first, Axis::between(-20, 4000));
    let refused = Err("its position is not known yet; home first".into());
    assert_eq!(bench.start("100"), refused);
    bench.go("home", &Calls::OnTime);
    assert_eq!(bench.go("100", &Calls::OnTime), completed("100"));
    // Unfinished homing does not count.
    bench.start("home").unwrap();
    bench.abort();
    bench.run(&Calls::OnTime);
    assert_eq!(bench.start("100"), refused);
}

#[test]
fn a_motor_made_safe_stops_stepping_and_keeps_its_position() {
    for (safe, powered) in [(Power::Hold, true), (Power::Release, false)] {
        let mut bench = Bench::new(StepperConfig { safe, ..CONFIG }, Axis::free());
        bench.start("5000").unwrap();
        bench.poll();
        while bench.position() < 500 {
            bench.wait(&Calls::OnTime, 0);
            bench.poll();
        }
        assert!(bench.is_pulsing());
        bench.make_safe();
        assert_eq!(bench.is_powered(), powered);
        // The pulse keeps its width, and ends without another task.
        let pulse = (Run::Running, "500".into());
        assert_eq!(bench.poll(), pulse);
        bench.pass(CONFIG.pulse_us.into());
        let stopped = (Run::Aborted, "500".into());
        assert_eq!(bench.poll(), stopped);
        assert!(!bench.is_pulsing());
        // It may be polled again, and stays as it is.
        bench.pass(20_000);
        assert_eq!(bench.poll(), stopped);
        assert_eq!(bench.is_powered(), powered);
        assert_eq!(bench.position(), 500);
        assert_eq!(bench.go("505", &Calls::OnTime), completed("505"));
        assert_eq!(bench.position(), 505);
        assert!(bench.is_powered());
    }
}

#[test]
fn an_idle_motor_made_safe_releases_or_holds_as_configured() {
    for (safe, at_rest, powered) in [
        (Power::Hold, Power::Hold, true),
        (Power::Release, Power::Hold, false),
        (Power::Release, Power::Release, false),
    ] {
        let config = StepperConfig {
            safe,
            at_rest,
            ..CONFIG
        };
        let mut bench = Bench::new(config, Axis::free());
        bench.go("5", &Calls::OnTime);
        bench.make_safe();
        assert_eq!(bench.run(&Calls::OnTime).1, "5");
        assert_eq!(bench.is_powered(), powered);
    }
    // Stopped in a task, it holds though it would let go after the task.
    let config = StepperConfig {
        at_rest: Power::Release,
        ..CONFIG
    };
    let mut bench = Bench::new(config, Axis::free());
    bench.start("5000").unwrap();
    while bench.position() < 5 {
        bench.poll();
        bench.wait(&Calls::OnTime, 0);
    }
    bench.make_safe();
    assert_eq!(bench.run(&Calls::OnTime).0, Run::Aborted);
    assert!(bench.is_powered());
}

#[test]
fn an_idle_motor_is_powered_off_if_configured() {
    let release = StepperConfig {
        at_rest: Power::Release,
        ..CONFIG
    };
    let mut bench = Bench::new(release, Axis::free());
    bench.start("5").unwrap();
    bench.poll();
    assert!(bench.is_powered());
    bench.run(&Calls::OnTime);
    assert!(!bench.is_powered());
}

#[test]
fn a_failing_pin_fails_the_task_and_is_named() {
    for (pin, text) in [
        ("step", "the step pin failed"),
        ("direction", "the direction pin failed"),
        ("enable", "the enable pin failed"),
        ("low", "a limit switch's pin failed"),
    ] {
        let mut bench = Bench::new(CONFIG, Axis::between(-700, 700));
        bench.fail(pin);
        let goal = "-100";
        assert_eq!(bench.go(goal, &Calls::OnTime), (Run::Failed, text.into()));
        assert_eq!(bench.position(), 0);
        bench.fail("none");
        assert_eq!(bench.go(goal, &Calls::OnTime), completed(goal));
    }
}

#[test]
fn a_task_fails_if_its_motor_cannot_be_released_at_its_end() {
    let release = StepperConfig {
        at_rest: Power::Release,
        ..CONFIG
    };
    let failed = (Run::Failed, "the enable pin failed".into());
    for (goal, abort) in [
        ("300", false),
        ("300", true),
        // Stopped by a switch.
        ("900", false),
        ("home", false),
    ] {
        let mut bench = Bench::new(release, Axis::between(-50, 400));
        bench.start(goal).unwrap();
        bench.poll();
        bench.fail("enable");
        if abort {
            bench.abort();
        }
        assert_eq!(bench.run(&Calls::OnTime), failed, "{goal}");
        assert!(bench.is_powered());
        bench.fail("none");
        let there = if goal == "home" { -47 } else { 3 };
        assert_eq!(bench.go("3", &Calls::OnTime), completed("3"));
        assert_eq!(bench.position(), there, "the position stays known");
        assert!(!bench.is_powered());
    }
    // The first fault is the reason.
    let mut bench = Bench::new(release, Axis::free());
    bench.start("300").unwrap();
    bench.fail("direction and enable");
    let failed = (Run::Failed, "the direction pin failed".into());
    assert_eq!(bench.run(&Calls::OnTime), failed);
}

#[test]
fn power_that_could_not_be_switched_on_has_its_lead_when_it_can() {
    let slow = StepperConfig {
        enable_us: 50_000,
        ..CONFIG
    };
    let mut bench = Bench::new(slow, Axis::free());
    bench.fail("enable");
    assert_eq!(bench.go("3", &Calls::OnTime).0, Run::Failed);
    bench.fail("none");
    assert_eq!(bench.go("3", &Calls::OnTime), completed("3"));
}

#[test]
fn a_motor_that_cannot_be_made_safe_fails_until_it_is() {
    for (safe, pin) in [
        (Power::Release, "enable"),
        (Power::Release, "step"),
        (Power::Hold, "step"),
    ] {
        let mut bench = Bench::new(StepperConfig { safe, ..CONFIG }, Axis::free());
        bench.start("5000").unwrap();
        while bench.position() < 500 {
            bench.poll();
            bench.wait(&Calls::OnTime, 0);
        }
        assert!(bench.is_pulsing());
        bench.fail(pin);
        for _ in 0..3 {
            bench.make_safe();
            while bench.poll().0 == Run::Running {
                bench.wait(&Calls::OnTime, 0);
            }
            assert_eq!(bench.poll().0, Run::Failed, "{safe:?} {pin}");
            bench.pass(50_000);
        }
        bench.fail("none");
        bench.make_safe();
        assert_eq!(bench.run(&Calls::OnTime), (Run::Aborted, "500".into()));
        assert!(!bench.is_pulsing());
        assert_eq!(bench.is_powered(), safe == Power::Hold);
        assert_eq!(bench.go("505", &Calls::OnTime), completed("505"));
    }
}

#[test]
fn a_motor_is_safe_after_a_failed_task() {
    for at_rest in [Power::Hold, Power::Release] {
        let mut bench = Bench::new(StepperConfig { at_rest, ..CONFIG }, Axis::free());
        bench.fail("direction");
        assert_eq!(bench.go("100", &Calls::OnTime).0, Run::Failed);
        bench.make_safe();
        assert_eq!(bench.run(&Calls::OnTime).0, Run::Aborted);
    }
}

#[test]
fn an_invalid_goal_is_rejected_with_the_valid_range() {
    let mut bench = Bench::new(CONFIG, Axis::between(-700, 700));
    let refused = Err("slide takes -5000 to 5000 steps, or home".into());
    for goal in ["5001", "-5001", "left", "", "1e9"] {
        assert_eq!(bench.start(goal), refused);
    }
    let mut bench = Bench::new(CONFIG, Axis::free());
    let refused = Err("slide takes -5000 to 5000 steps".into());
    assert_eq!(bench.start("home"), refused);
}

#[test]
fn goals_and_positions_can_use_another_unit() {
    let turned = StepperConfig {
        scale: Scale::new(3200, 360, "degrees"),
        range: (-360, 360),
        ..CONFIG
    };
    let mut bench = Bench::new(turned, Axis::between(-3000, 1000));
    assert_eq!(bench.go("90", &Calls::OnTime), completed("90.00"));
    assert_eq!(bench.position(), 800);
    assert_eq!(bench.go("-0.1", &Calls::OnTime), completed("-0.11"));
    assert_eq!(bench.position(), -1);
    let failed = (Run::Failed, "limit switch at 112.50 degrees".into());
    assert_eq!(bench.go("180", &Calls::OnTime), failed);
    let refused = Err("slide takes -360 to 360 degrees, or home".into());
    assert_eq!(bench.start("360.001"), refused);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 64, ..ProptestConfig::default() })]

    /// The bench sees to it that no pulse, pause, set-up time or interval is too short.
    #[test]
    fn any_call_timing_reaches_the_goal_and_respects_the_drivers_timing(
        goals in proptest::collection::vec((-900i32..900, calls()), 1..4),
        speed in 100u32..30_000,
        acceleration in prop_oneof![500u32..2_000_000, 2_000_000u32..200_000_000],
        times in (1u8.., 0u8.., 0u16..5000), reverse: bool,
    ) {
        let (pulse_us, direction_us, enable_us) = times;
        let config = StepperConfig {
            speed, acceleration, reverse, pulse_us, direction_us, enable_us, ..CONFIG
        };
        let mut bench = Bench::new(config, Axis::free());
        for (goal, calls) in goals {
            let text = format!("{goal}");
            prop_assert_eq!(bench.go(&text, &calls), completed(&text));
            prop_assert_eq!(bench.position(), goal);
        }
    }

    #[test]
    fn an_abort_at_any_time_stops_on_a_step_before_the_goal(
        goal in -900i32..900, calls in calls(), turns in 0usize..600,
    ) {
        let mut bench = Bench::new(CONFIG, Axis::free());
        bench.start(&format!("{goal}")).unwrap();
        for turn in 0..turns {
            if bench.poll().0 != Run::Running {
                return Ok(());
            }
            bench.wait(&calls, turn);
        }
        bench.abort();
        let turns = bench.turns();
        let (_, text) = bench.run(&calls);
        prop_assert!(turns == 0 || bench.turns() == turns, "it does not turn any more");
        prop_assert_eq!(text, format!("{}", bench.position()));
        prop_assert!(bench.position().abs() <= goal.abs());
        prop_assert!(bench.position().signum() * goal.signum() >= 0);
    }
}
