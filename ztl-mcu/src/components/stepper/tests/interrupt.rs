//! A motor that an interrupt drives, which may come late.

use super::*;

/// Calls the interrupt until the task is over.
#[track_caller]
fn run(bench: &mut Bench, calls: &Calls) -> (Run, String) {
    for turn in 0..3_000_000 {
        let wake = bench.interrupt();
        let (run, text) = bench.poll();
        if run != Run::Running {
            return (run, text);
        }
        match calls {
            Calls::OnTime => bench.pass(wake.saturating_sub(bench.now_us())),
            calls => bench.wait(calls, turn),
        }
    }
    panic!("the task does not end");
}

#[test]
fn a_motor_behind_a_mutex_is_driven_by_its_interrupt_alone() {
    let mut bench = Bench::with_interrupt(CONFIG);
    bench.start("3").unwrap();
    for _ in 0..1000 {
        assert_eq!(bench.poll(), (Run::Running, "0".into()));
        bench.pass(1000);
    }
    assert_eq!(bench.position(), 0, "the interrupt was not called");
    for _ in 0..100_000 {
        bench.interrupt();
        bench.pass(25);
    }
    assert_eq!(bench.poll(), completed("3"));
    assert_eq!(bench.position(), 3);
}

#[test]
fn an_interrupt_each_25_us_makes_19_500_steps_a_second() {
    let fast = StepperConfig {
        speed: 20_000,
        acceleration: 500_000,
        ..CONFIG
    };
    let mut bench = Bench::with_interrupt(fast);
    bench.start("5000").unwrap();
    assert_eq!(run(&mut bench, &Calls::Each(25)), completed("5000"));
    let steps = bench.steps();
    let time = steps[4000] - steps[1000];
    assert!(time * 19_500 < 3000 * 1_000_000, "{time}");
}

#[test]
fn a_motion_by_interrupts_on_time_takes_as_long_as_one_by_polls() {
    let steps = |mut bench: Bench, run: fn(&mut Bench, &Calls) -> (Run, String)| {
        bench.start("-300").unwrap();
        assert_eq!(run(&mut bench, &Calls::OnTime), completed("-300"));
        bench.steps()
    };
    let polled = steps(Bench::new(CONFIG, Axis::free()), Bench::run);
    assert_eq!(steps(Bench::with_interrupt(CONFIG), run), polled);
}

#[test]
fn a_late_interrupt_catches_up_one_tick_of_the_ramp_a_call() {
    // The first step is due after more than 30 ticks.
    let slow = StepperConfig {
        acceleration: 2000,
        ..CONFIG
    };
    let first_step = |late_us: u64| {
        let mut bench = Bench::with_interrupt(slow);
        bench.start("3").unwrap();
        bench.pass(late_us);
        let mut at_once = 0;
        while bench.steps().is_empty() {
            let wake = bench.interrupt();
            at_once += usize::from(wake <= bench.now_us());
            bench.pass(wake.saturating_sub(bench.now_us()));
        }
        (at_once, bench.steps()[0])
    };
    let (_, on_time) = first_step(0);
    let (calls, late) = first_step(25_000);
    assert_eq!(late, on_time);
    assert!((20..30).contains(&calls), "{calls}");
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 64, ..ProptestConfig::default() })]

    /// The bench sees to it that no pulse, pause, set-up time or interval is too short.
    #[test]
    fn any_timing_of_an_interrupt_reaches_the_goal_and_respects_the_drivers_timing(
        goals in proptest::collection::vec((-900i32..900, calls()), 1..4),
        speed in 100u32..30_000,
        acceleration in prop_oneof![500u32..2_000_000, 2_000_000u32..200_000_000],
        times in (1u8.., 0u8.., 0u16..5000), reverse: bool,
    ) {
        let (pulse_us, direction_us, enable_us) = times;
        let config = StepperConfig {
            speed, acceleration, reverse, pulse_us, direction_us, enable_us, ..CONFIG
        };
        let mut bench = Bench::with_interrupt(config);
        for (goal, calls) in goals {
            let text = format!("{goal}");
            bench.start(&text).unwrap();
            prop_assert_eq!(run(&mut bench, &calls), completed(&text));
            prop_assert_eq!(bench.position(), goal);
        }
    }
}
