//! `cargo xtask model` and `cargo xtask simulate`, and simulations of a fleet.

#![expect(
    clippy::disallowed_types,
    reason = "seeds have 64 bits, and this program never runs on a robot"
)]

use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Instant;

use ztl_simulation::explore::{System, explore};
use ztl_simulation::lab::Summary;
use ztl_simulation::plan::Plan;
use ztl_simulation::real::fleet;
use ztl_simulation::real::model::{BUS_SCENARIOS, BusModel, LinkModel, SCENARIOS};
use ztl_simulation::shrink::{attempt, report, shrink};

/// About 10 GiB of memory suffice for these.
const STATES: usize = 60_000_000;

/// Number of failing seeds that are shrunk and reported before the run stops.
const TOLD: u64 = 3;

/// Default number of seeds.
const SEEDS: u64 = 2000;

const USAGE: &str = "usage: ztl-simulation model [SCENARIO] [--depth FAULTS]\n       \
                     ztl-simulation simulate [--bus] [--seeds NUMBER] [--first SEED] | --show SEED\n       \
                     ztl-simulation fleet [--seeds NUMBER] [--first SEED]";

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let done = match words.split_first() {
        Some((&"model", rest)) => model(rest),
        Some((&"simulate", rest)) => simulate(rest),
        Some((&"fleet", rest)) => fleet(rest),
        _ => Err(USAGE.to_owned()),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::from(2)
        }
    }
}

fn cores() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

/// Whether every worker succeeded.
fn on_all_cores(work: impl Fn() -> bool + Sync) -> bool {
    thread::scope(|scope| {
        let workers: Vec<_> = (0..cores()).map(|_| scope.spawn(&work)).collect();
        let done: Vec<_> = workers.into_iter().map(|worker| worker.join()).collect();
        done.into_iter().all(|done| done.is_ok_and(|well| well))
    })
}

fn number(option: &str, word: Option<&&str>) -> Result<u64, String> {
    let word = word.copied().unwrap_or_default();
    word.parse()
        .map_err(|_| format!("`{option}` needs a whole number, not `{word}`\n{USAGE}"))
}

fn model(words: &[&str]) -> Result<bool, String> {
    let mut times = 1;
    let mut wanted = None;
    let mut words = words.iter();
    while let Some(word) = words.next() {
        match *word {
            "--depth" => {
                let faults = number(word, words.next())?;
                times = u8::try_from(faults).map_err(|_| "more than 255 faults".to_owned())?;
            }
            name if names().any(|known| known == name) => wanted = Some(name),
            name => {
                let names: Vec<&str> = names().collect();
                let names = names.join(", ");
                return Err(format!("no scenario `{name}`; there are: {names}\n{USAGE}"));
            }
        }
    }
    let chosen: Vec<&str> = names()
        .filter(|name| wanted.is_none_or(|wanted| wanted == *name))
        .collect();
    let open = Mutex::new(chosen.into_iter());
    Ok(on_all_cores(|| {
        let mut well = true;
        let next = || open.lock().ok()?.next();
        while let Some(name) = next() {
            if let Some(scenario) = SCENARIOS.iter().find(|known| known.name == name) {
                let scenario = scenario.with_times(times);
                well &= explored(name, times, &LinkModel::new(scenario));
            }
            if let Some(scenario) = BUS_SCENARIOS.iter().find(|known| known.name == name) {
                let scenario = scenario.with_times(times);
                well &= explored(name, times, &BusModel::new(scenario));
            }
        }
        well
    }))
}

/// Names of all scenarios.
fn names() -> impl Iterator<Item = &'static str> {
    let alone = SCENARIOS.iter().map(|scenario| scenario.name);
    alone.chain(BUS_SCENARIOS.iter().map(|scenario| scenario.name))
}

/// Explores a scenario and prints what was found. Returns whether every promise holds.
fn explored<S: System>(name: &str, times: u8, first: &S) -> bool {
    let begin = Instant::now();
    let explored = explore(first, STATES);
    let seconds = begin.elapsed().as_secs_f32();
    let mut text = format!("{name}, {times} faults: {explored}; {seconds:.1} s\n");
    if let Some(broken) = &explored.broken {
        for line in first.trace(&broken.path) {
            text.push_str(&line);
            text.push('\n');
        }
        text.push_str(&broken.promise);
        text.push('\n');
    }
    print!("{text}");
    explored.broken.is_none() && explored.complete
}

fn simulate(words: &[&str]) -> Result<bool, String> {
    let (mut seeds, mut first) = (SEEDS, 1);
    let mut plan_of: fn(u64) -> Plan = Plan::new;
    let mut words = words.iter();
    while let Some(word) = words.next() {
        match *word {
            "--seeds" => seeds = number(word, words.next())?,
            "--first" => first = number(word, words.next())?,
            "--bus" => plan_of = Plan::shared,
            "--show" => {
                print!("{}", report(&plan_of(number(word, words.next())?)));
                return Ok(true);
            }
            _ => return Err(format!("what is `{word}`?\n{USAGE}")),
        }
    }
    if seeds == 0 || first.checked_add(seeds).is_none_or(|end| end == u64::MAX) {
        return Err(format!(
            "there are no {seeds} seeds from {first} on\n{USAGE}"
        ));
    }
    // Panics are caught and reported below.
    std::panic::set_hook(Box::new(|_| {}));
    let begin = Instant::now();
    let next = AtomicU64::new(first);
    let failed = AtomicU64::new(0);
    let total = Mutex::new(Summary::default());
    let well = on_all_cores(|| {
        let mut mine = Summary::default();
        let mut well = true;
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= first.saturating_add(seeds) || failed.load(Ordering::Relaxed) >= TOLD {
                break;
            }
            let plan = plan_of(seed);
            match attempt(&plan, false) {
                Ok((summary, _)) => mine += summary,
                Err(_) => {
                    well = false;
                    failed.fetch_add(1, Ordering::Relaxed);
                    print!("{}", report(&shrink(&plan)));
                }
            }
        }
        if let Ok(mut total) = total.lock() {
            *total += mine;
        }
        well
    });
    let total = total.into_inner().unwrap_or_default();
    let seconds = begin.elapsed().as_secs_f32();
    let last = next.load(Ordering::Relaxed).min(first + seeds) - 1;
    println!("seeds {first} to {last}: {total}; {seconds:.1} s");
    Ok(well)
}

fn fleet(words: &[&str]) -> Result<bool, String> {
    let (mut seeds, mut first) = (SEEDS, 1);
    let mut words = words.iter();
    while let Some(word) = words.next() {
        match *word {
            "--seeds" => seeds = number(word, words.next())?,
            "--first" => first = number(word, words.next())?,
            _ => return Err(format!("what is `{word}`?\n{USAGE}")),
        }
    }
    let begin = Instant::now();
    let next = AtomicU64::new(first);
    let failed = AtomicU64::new(0);
    let total = Mutex::new(fleet::Figures::default());
    let well = on_all_cores(|| {
        let mut mine = fleet::Figures::default();
        let mut well = true;
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed >= first.saturating_add(seeds) || failed.load(Ordering::Relaxed) >= TOLD {
                break;
            }
            match fleet::play(seed, false) {
                Ok(figures) => mine += figures,
                Err((complaint, _)) => {
                    well = false;
                    failed.fetch_add(1, Ordering::Relaxed);
                    let trace = fleet::play(seed, true).err().map(|(_, trace)| trace);
                    let trace = trace.unwrap_or_default().join("\n");
                    println!("{trace}\nseed {seed}: {complaint}");
                }
            }
        }
        if let Ok(mut total) = total.lock() {
            *total += mine;
        }
        well
    });
    let total = total.into_inner().unwrap_or_default();
    let seconds = begin.elapsed().as_secs_f32();
    println!("{seeds} seeds from {first} on: {total:?}; {seconds:.1} s");
    Ok(well)
}
