//! Commands that run for minutes or hours: simulations, soak tests and benchmarks.

use anyhow::Result;

use crate::project::Project;
use crate::{firmware, install};

/// The package of the model checker and the simulation.
pub(crate) const SIMULATION: &str = "ztl-simulation";

/// `cargo xtask model` and `cargo xtask simulate`: check the link's promises on the real state machines.
pub(crate) fn simulation(project: &Project, what: &str, args: &[String]) -> Result<()> {
    let run = project.cargo("run --quiet --profile simulation --package");
    let run = run.args([SIMULATION, "--", what]).args(args);
    Ok(run.run()?)
}

/// The part that `cargo xtask test` runs: everything with one fault, that mutants are detected, and 2,000
/// laboratories.
pub(crate) fn check_simulation(project: &Project) -> Result<()> {
    let test = project.cargo("test --profile simulation --package");
    Ok(test.args([SIMULATION, "--", "--show-output"]).run()?)
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
    /// Seconds of recording images and values; each takes 10 MB of the disk.
    #[arg(long, default_value_t = 600, value_parser = clap::value_parser!(u32).range(1..))]
    recording: u32,
    /// Tasks through a fleet whose routers, agents and connections fail.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u32).range(10..))]
    fleet: u32,
}

/// Builds the programs to measure.
const BUILD: &str = "build --release --workspace --bins";

/// Tasks before the resets: as many results as a gateway keeps, so that it reaches its full size.
const FILL: &str = "10500";

impl Soak {
    /// Runs everything; each test prints a short report.
    pub(crate) fn run(&self, project: &Project) -> Result<()> {
        project.cargo(BUILD).run()?;
        for (binary, module) in [("devices", "line_faults::"), ("serve", "many_tasks::")] {
            let run = project.cargo("test --release --package ztl-tests --test");
            run.args([binary, "--", "--nocapture", "--test-threads", "1", module])
                .env("ZTL_TASKS", self.tasks.to_string())
                .env("ZTL_RESETS", self.resets.to_string())
                .env("ZTL_FILL", FILL)
                .env("ZTL_MANY_TASKS", self.many.to_string())
                .run()?;
        }
        let fleet = project.cargo("test --release --package ztl-fleet --test processes --");
        let fleet = fleet.args(["--nocapture", "faults::"]);
        fleet.env("ZTL_FLEET_TASKS", self.fleet.to_string()).run()?;
        install::python(project)?;
        let bench = project.cargo("bench --package ztl-tests --bench server -- streams-recording");
        let seconds = self.recording.to_string();
        Ok(bench.env("ZTL_RECORD_SECONDS", seconds).run()?)
    }
}

/// How many power cuts `cargo xtask cuts` runs.
#[derive(clap::Args)]
pub(crate) struct Cuts {
    /// Minutes; the run says where the next one goes on.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    minutes: u32,
    /// Unit of changes to begin with.
    #[arg(long, default_value_t = 0)]
    unit: u32,
    /// Change of this unit to begin with.
    #[arg(long, default_value_t = 0)]
    change: u32,
}

impl Cuts {
    /// Cuts the power of a board in QEMU at each change of its flash during an update.
    pub(crate) fn run(&self, project: &Project) -> Result<()> {
        install::qemu(&project.sh)?;
        firmware::build_measured(project)?;
        project.cargo("build --package ztl").run()?;
        let test = project.cargo("test --package ztl-tests --test devices --");
        test.args(["--nocapture", "--test-threads", "1", "updates::cuts::"])
            .env("ZTL_CUTS", "0")
            .env("ZTL_CUT_MINUTES", self.minutes.to_string())
            .env("ZTL_CUT_UNIT", self.unit.to_string())
            .env("ZTL_CUT_CHANGE", self.change.to_string())
            .run()?;
        Ok(())
    }
}

/// Parts of the benchmark that can be run alone: the cycles of a microcontroller, the web console, actions of ROS 1, calls of NAOqi, fleets, and parts of the server comparison.
pub(crate) const PARTS: [&str; 15] = [
    "firmware",
    "web",
    "ros1",
    "naoqi",
    "fleet",
    "rates",
    "most",
    "cpu",
    "core",
    "goal",
    "end",
    "idle",
    // With those below it.
    "streams",
    "streams-abort",
    "streams-recording",
];

/// `cargo xtask bench`: compares figures within one run; never passes or fails by time.
pub(crate) fn bench(project: &Project, parts: &[String]) -> Result<()> {
    let all = parts.is_empty();
    let wanted = |part: &str| all || parts.iter().any(|wanted| wanted == part);
    let others =
        |part: &&String| !["firmware", "web", "ros1", "naoqi", "fleet"].contains(&part.as_str());
    let server: Vec<_> = parts.iter().filter(others).collect();
    if wanted("ros1") {
        install::actionlib(&project.sh)?;
    }
    if wanted("naoqi") {
        install::naoqi(project)?;
        project.cargo(BUILD).run()?;
    }
    if all || !server.is_empty() {
        install::python(project)?;
        project.cargo(BUILD).run()?;
        let choice = if all { "" } else { " --bench server --" };
        let bench = project.cargo(&format!("bench --package ztl-tests{choice}"));
        bench.args(server).run()?;
    }
    // They are among all benchmarks.
    for part in ["ros1", "naoqi"] {
        if !all && wanted(part) {
            let bench = format!("bench --package ztl-tests --bench {part}");
            project.cargo(&bench).run()?;
        }
    }
    if wanted("web") {
        install::javascript(project)?;
        project.cargo(BUILD).run()?;
        let figures = project.cargo("test --release --package ztl-tests --test web --");
        let choice = ["--ignored", "--nocapture", "--test-threads", "1", "figures"];
        figures.args(choice).run()?;
    }
    if wanted("fleet") {
        project.cargo(BUILD).run()?;
        project
            .cargo("bench --package ztl-fleet --bench fleet")
            .run()?;
    }
    if wanted("firmware") {
        firmware::bench(project)?;
    }
    Ok(())
}
