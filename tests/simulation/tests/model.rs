//! What `cargo xtask model` explores, with few faults; and that the model catches mistakes.

use ztl_simulation::explore::explore;
use ztl_simulation::mutants::{MUTANTS, Mutant};
use ztl_simulation::{broken, real};

/// More than any of them has.
const STATES: usize = 2_000_000;

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn the_promises_hold_whatever_goes_wrong_once() {
    for scenario in real::model::SCENARIOS {
        let scenario = scenario.with_times(1);
        let first = real::model::Lab::new(scenario);
        let explored = explore(&first, STATES);
        if let Some(broken) = &explored.broken {
            let trace = first.trace(&broken.path).join("\n");
            panic!("{}:\n{trace}\n{}", scenario.name, broken.promise);
        }
        assert!(explored.complete, "{}", scenario.name);
        println!("{:<10} {explored}", scenario.name);
    }
}

#[test]
fn every_mistake_has_its_place() {
    let lost = broken::lost();
    assert!(
        lost.is_empty(),
        "what these change in src/mutants.rs stands nowhere, or twice: {lost:#?}"
    );
}

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn every_mistake_is_caught() {
    let mut escaped = Vec::new();
    for (number, mutant) in MUTANTS.iter().enumerate() {
        broken::switch(Some(number));
        match complaint(mutant) {
            Some(complaint) if complaint.starts_with(mutant.complaint) => {
                println!("{}: {complaint}", mutant.name);
            }
            other => escaped.push(format!("{}: {other:?}", mutant.name)),
        }
        broken::switch(None);
    }
    assert!(escaped.is_empty(), "{escaped:#?}");
}

fn complaint(mutant: &Mutant) -> Option<String> {
    let (name, times) = mutant.caught_in;
    let mut scenarios = broken::model::SCENARIOS.iter();
    let scenario = scenarios.find(|scenario| scenario.name == name)?;
    let first = broken::model::Lab::new(scenario.with_times(times));
    let broken = explore(&first, STATES).broken?;
    Some(format!("{} ({} steps)", broken.promise, broken.path.len()))
}
