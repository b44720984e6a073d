//! `cargo xtask model`, which explores with as many faults as one likes.

use std::process::ExitCode;
use std::sync::Mutex;
use std::thread;
use std::time::Instant;

use ztl_simulation::explore::{Explored, explore};
use ztl_simulation::real::model::{Action, Lab, SCENARIOS, Scenario};

/// Some 10 GiB are needed for these.
const STATES: usize = 60_000_000;

const USAGE: &str = "usage: ztl-simulation model [SCENARIO] [--depth FAULTS]";

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let done = match words.split_first() {
        Some((&"model", rest)) => model(rest),
        _ => Err(USAGE.to_owned()),
    };
    match done {
        Ok(code) => code,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::from(2)
        }
    }
}

fn model(words: &[&str]) -> Result<ExitCode, String> {
    let mut times = 1;
    let mut wanted = None;
    let mut words = words.iter();
    while let Some(word) = words.next() {
        match *word {
            "--depth" => {
                let number = words.next().ok_or(USAGE)?;
                times = number
                    .parse()
                    .map_err(|_| format!("`--depth` needs a number of faults, not `{number}`"))?;
            }
            name if SCENARIOS.iter().any(|scenario| scenario.name == name) => wanted = Some(name),
            name => {
                let names: Vec<&str> = SCENARIOS.iter().map(|scenario| scenario.name).collect();
                let names = names.join(", ");
                return Err(format!("no scenario `{name}`; there are: {names}\n{USAGE}"));
            }
        }
    }
    let chosen = |scenario: &&Scenario| wanted.is_none_or(|name| name == scenario.name);
    let scenarios: Vec<&Scenario> = SCENARIOS.iter().filter(chosen).collect();
    let open = Mutex::new(scenarios.into_iter());
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let work = || {
        let mut well = true;
        let next = || open.lock().ok()?.next();
        while let Some(scenario) = next() {
            let scenario = scenario.with_times(times);
            let begin = Instant::now();
            let first = Lab::new(scenario);
            let explored = explore(&first, STATES);
            print!("{}", report(scenario, &first, &explored, begin));
            well &= explored.broken.is_none() && explored.complete;
        }
        well
    };
    let well = thread::scope(|scope| {
        let workers: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        workers
            .into_iter()
            .all(|worker| worker.join().is_ok_and(|well| well))
    });
    Ok(if well {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn report(scenario: &Scenario, first: &Lab, explored: &Explored<Action>, begin: Instant) -> String {
    let seconds = begin.elapsed().as_secs_f32();
    let mut text = format!(
        "{}, {} faults: {explored}; {seconds:.1} s\n",
        scenario.name, scenario.times
    );
    if let Some(broken) = &explored.broken {
        for line in first.trace(&broken.path) {
            text.push_str(&line);
            text.push('\n');
        }
    }
    text
}
