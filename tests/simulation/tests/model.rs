//! The exploration of `cargo xtask model` with few faults, and the mutants that the model must catch.

use ztl_simulation::explore::{System, explore};
use ztl_simulation::merging::check_merging;
use ztl_simulation::mutants::{MUTANTS, Mutant, SEEDS};
use ztl_simulation::plan::Plan;
use ztl_simulation::shrink::attempt;
use ztl_simulation::{broken, real};

/// More states than any scenario has.
const STATES: usize = 2_000_000;

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn the_guarantees_hold_with_one_fault() {
    for scenario in real::model::SCENARIOS {
        let first = real::model::LinkModel::new(scenario.with_times(1));
        holds(scenario.name, &first);
    }
}

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn the_guarantees_hold_on_a_shared_line_with_one_fault() {
    for scenario in real::model::BUS_SCENARIOS {
        let first = real::model::BusModel::new(scenario.with_times(1));
        holds(scenario.name, &first);
    }
}

/// Scenarios with every fault, and few states.
const MERGED: [&str; 7] = [
    "frames", "unplug", "carry-on", "reset", "restart", "journal", "set",
];

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn states_with_the_same_fingerprint_behave_alike() {
    for name in MERGED {
        let mut scenarios = real::model::SCENARIOS.iter();
        let scenario = scenarios.find(|scenario| scenario.name == name);
        let scenario = scenario.expect("a scenario").with_times(1);
        match check_merging(&real::model::LinkModel::new(scenario)) {
            Ok(merged) => {
                println!("{name:<11} {merged}");
                assert!(merged.prints < merged.exact, "{name}: {merged}");
            }
            Err(different) => panic!("{name}: {different}"),
        }
    }
}

fn holds<S: System>(name: &str, first: &S) {
    let explored = explore(first, STATES);
    if let Some(broken) = &explored.broken {
        let trace = first.trace(&broken.path).join("\n");
        panic!("{name}:\n{trace}\n{}", broken.promise);
    }
    assert!(explored.complete, "{name}");
    println!("{name:<11} {explored}");
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
    if name == SEEDS {
        let mut seeds = 1..=u64::from(times);
        let broken = |seed| attempt(&Plan::shared(seed), false).err();
        return seeds.find_map(broken).map(|failure| failure.complaint);
    }
    let mut shared = broken::model::BUS_SCENARIOS.iter();
    if let Some(scenario) = shared.find(|scenario| scenario.name == name) {
        return complaint_about(&broken::model::BusModel::new(scenario.with_times(times)));
    }
    let mut scenarios = broken::model::SCENARIOS.iter();
    let scenario = scenarios.find(|scenario| scenario.name == name)?;
    complaint_about(&broken::model::LinkModel::new(scenario.with_times(times)))
}

fn complaint_about(first: &impl System) -> Option<String> {
    let broken = explore(first, STATES).broken?;
    Some(format!("{} ({} steps)", broken.promise, broken.path.len()))
}
