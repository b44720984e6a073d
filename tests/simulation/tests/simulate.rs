//! The simulation of `cargo xtask simulate` with few seeds, and the shrinking of failing plans.

use ztl_simulation::lab::Summary;
use ztl_simulation::plan::Plan;
use ztl_simulation::shrink::{attempt, report, shrink, shrink_by};

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn two_thousand_simulations_keep_the_guarantees() {
    let mut total = Summary::default();
    for seed in 1..=2000 {
        let plan = Plan::new(seed);
        match attempt(&plan, false) {
            Ok((summary, _)) => total += summary,
            Err(_) => panic!("{}", report(&shrink(&plan))),
        }
    }
    println!("2000 seeds: {total}");
    // The seeds must move motors and cause faults.
    assert!(total.begun > 8000, "{total}");
    assert!(total.ended > 800 && total.unknown > 500, "{total}");
}

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn sixteen_nodes_on_a_shared_line_keep_the_guarantees_and_have_their_turns() {
    let mut total = Summary::default();
    for seed in 1..=40 {
        let plan = Plan::shared(seed);
        match attempt(&plan, false) {
            Ok((summary, _)) => total += summary,
            Err(_) => panic!("{}", report(&shrink(&plan))),
        }
    }
    println!("40 seeds: {total}");
    assert!(total.healthy.turn.as_millis() < 50, "{total}");
    // The seeds must move motors and let nodes send at once, and each trouble must come up.
    assert!(total.begun > 1200 && total.collided > 10_000, "{total}");
    assert!(
        total.troubled.iter().all(|turns| !turns.turn.is_zero()),
        "{total}"
    );
}

/// A stall releases a command while the gateway hears nothing. The link is up again for a second, so a button starts a task.
#[test]
fn a_command_that_a_stall_delays_is_a_new_command() {
    let plan = Plan::new(20_000_155);
    assert!(attempt(&plan, false).is_ok(), "{}", report(&plan));
}

#[test]
fn a_seed_is_deterministic() {
    for seed in [3, 4711] {
        let plan = Plan::new(seed);
        let first = attempt(&plan, true).expect("it keeps its promises");
        assert!(first.1.len() > 20, "there is a trace");
        assert_eq!(attempt(&plan, true), Ok(first));
    }
}

#[test]
fn a_failing_plan_is_shrunk_to_its_cause() {
    // Pretends that two of these break a promise.
    let plan = Plan::new(12);
    let kinds = |plan: &Plan| {
        let asks = plan.happenings.iter();
        asks.filter(|h| format!("{h:?}").contains("Ask")).count()
    };
    assert!(kinds(&plan) > 2 && plan.happenings.len() > 5);
    let short = shrink_by(&plan, |plan| kinds(plan) >= 2);
    assert_eq!((kinds(&short), short.happenings.len()), (2, 2));
}
