//! The exploration of `cargo xtask model` with few faults, and the mutants that the model must catch.

use ztl_simulation::explore::explore;
use ztl_simulation::mutants::{MUTANTS, Mutant};
use ztl_simulation::{broken, real};

/// More states than any scenario has.
const STATES: usize = 2_000_000;

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn the_guarantees_hold_with_one_fault() {
    for scenario in real::model::SCENARIOS {
        let scenario = scenario.with_times(1);
        let first = real::model::LinkModel::new(scenario);
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
fn every_mutant_is_found_in_the_source() {
    let lost = broken::lost();
    assert!(
        lost.is_empty(),
        "src/mutants.rs changes code that occurs not once: {lost:#?}"
    );
}

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn every_mutant_is_caught() {
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
    let first = broken::model::LinkModel::new(scenario.with_times(times));
    let broken = explore(&first, STATES).broken?;
    Some(format!("{} ({} steps)", broken.promise, broken.path.len()))
}
