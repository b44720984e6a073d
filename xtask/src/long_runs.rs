//! Commands that run for minutes or hours: simulations, soak tests and benchmarks.

use anyhow::Result;
use xshell::cmd;

use crate::project::Project;
use crate::{firmware, install};

/// The package of the model checker and the simulation.
pub(crate) const SIMULATION: &str = "ztl-simulation";

/// Optimised, with the checks of a debug build.
const PROFILE: [&str; 3] = ["--profile", "simulation", "--locked"];

/// `cargo xtask model` and `cargo xtask simulate`: check the link's promises on the real state machines.
pub(crate) fn simulation(project: &Project, what: &str, args: &[String]) -> Result<()> {
    let sh = &project.sh;
    cmd!(
        sh,
        "cargo run --quiet {PROFILE...} --package {SIMULATION} -- {what} {args...}"
    )
    .run()?;
    Ok(())
}

/// The part that `cargo xtask test` runs: everything with one fault, that mutants are detected, and 2,000
/// laboratories.
pub(crate) fn check_simulation(project: &Project) -> Result<()> {
    let sh = &project.sh;
    cmd!(
        sh,
        "cargo test {PROFILE...} --package {SIMULATION} -- --show-output"
    )
    .run()?;
    Ok(())
}

/// How long `cargo xtask soak` runs.
#[derive(clap::Args)]
pub(crate) struct Soak {
    /// Tasks on a faulty line.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(10..))]
    tasks: u32,
    /// Resets of each side.
    #[arg(long, default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(10..))]
    resets: u32,
    /// Tasks through one server.
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u32).range(10..))]
    many: u32,
}

/// Tasks before the resets: as many results as a gateway keeps, so that it reaches its full size.
const FILL: &str = "10500";

impl Soak {
    /// Runs everything; each test prints a short report.
    pub(crate) fn run(&self, project: &Project) -> Result<()> {
        let sh = &project.sh;
        let [tasks, resets, many] = [self.tasks, self.resets, self.many].map(|n| n.to_string());
        let test = ["test", "--release", "--locked", "--package", "ztl-tests"];
        let end = ["--", "--nocapture", "--test-threads", "1"];
        cmd!(sh, "cargo build --release --workspace --bins --locked").run()?;
        let vars = format!("ZTL_TASKS={tasks} ZTL_RESETS={resets} ZTL_FILL={FILL}");
        let vars = vars.split(' ');
        cmd!(
            sh,
            "env {vars...} cargo {test...} --test devices {end...} line_faults::"
        )
        .run()?;
        cmd!(
            sh,
            "env ZTL_MANY_TASKS={many} cargo {test...} --test serve {end...} many_tasks::"
        )
        .run()?;
        Ok(())
    }
}

/// Parts of the benchmark that can be run alone: the cycles of a microcontroller, and parts of the server comparison.
pub(crate) const PARTS: [&str; 8] = [
    "firmware", "rates", "most", "cpu", "core", "goal", "end", "idle",
];

/// `cargo xtask bench`: compares figures within one run; never passes or fails by time.
pub(crate) fn bench(project: &Project, parts: &[String]) -> Result<()> {
    let (firmware, server): (Vec<_>, Vec<_>) = parts.iter().partition(|part| *part == "firmware");
    let all = parts.is_empty();
    if all || !server.is_empty() {
        let sh = &project.sh;
        install::python(project)?;
        // The programs to measure.
        cmd!(sh, "cargo build --release --workspace --bins --locked").run()?;
        let choice = if all {
            None
        } else {
            Some(["--bench", "server", "--"])
        };
        let choice = choice.into_iter().flatten();
        cmd!(
            sh,
            "cargo bench --locked --package ztl-tests {choice...} {server...}"
        )
        .run()?;
    }
    if all || !firmware.is_empty() {
        firmware::bench(project)?;
    }
    Ok(())
}
