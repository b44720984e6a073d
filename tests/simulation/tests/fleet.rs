//! Fleets by seeds, and the mutants that they must catch.

use std::collections::BTreeMap;

use ztl_simulation::broken;
use ztl_simulation::fleet_mutants::FLEET;
use ztl_simulation::mutants::MUTANTS;
use ztl_simulation::real::fleet::{Figures, play};

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn two_thousand_fleets_keep_their_promises() {
    let mut total = Figures::default();
    for seed in 1..=2000 {
        match play(seed, false) {
            Ok(figures) => total += figures,
            Err((complaint, _)) => {
                let told = play(seed, true).err().map(|(_, trace)| trace.join("\n"));
                panic!("{}\nseed {seed}: {complaint}", told.unwrap_or_default());
            }
        }
    }
    println!("2000 seeds: {total:?}");
    // The seeds must let robots act and break things.
    assert!(total.starts > 10_000 && total.told > 10_000, "{total:?}");
    assert!(total.refused > 5000 && total.silent > 10_000, "{total:?}");
    assert!(total.restarts > 5000, "{total:?}");
}

#[test]
fn a_seed_is_deterministic() {
    for seed in [3, 4711] {
        let figures = |()| play(seed, false).map(|figures| format!("{figures:?}"));
        assert_eq!(figures(()), figures(()));
    }
}

#[test]
#[cfg_attr(not(optimised), ignore = "too long; cargo xtask test --only model")]
fn every_mutant_of_a_fleet_is_caught() {
    let mut escaped = Vec::new();
    for (number, mutant) in FLEET.iter().enumerate() {
        broken::switch(Some(MUTANTS.len() + number));
        let seeds = 1..=1000 * u64::from(mutant.caught_in.1);
        let mut others = BTreeMap::new();
        let mut failed = |seed| {
            let (complaint, _) = broken::fleet::play(seed, false).err()?;
            if complaint.starts_with(mutant.complaint) {
                return Some((seed, complaint));
            }
            // Its kind, without what was told.
            let kind = complaint.split(':').next().unwrap_or_default();
            *others.entry(kind.to_owned()).or_insert(0) += 1;
            None
        };
        match seeds.into_iter().find_map(&mut failed) {
            Some((seed, complaint)) => println!("{}: {complaint} (seed {seed})", mutant.name),
            None => escaped.push(format!("{}: {others:?}", mutant.name)),
        }
        broken::switch(None);
    }
    assert!(escaped.is_empty(), "{escaped:#?}");
}
