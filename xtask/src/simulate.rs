//! `cargo xtask model` and `cargo xtask simulate`: check the link's promises on the real state machines.
//! `tests/simulation` says what is checked and how.

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// The package of both. Its tests run separately, optimised.
pub(crate) const PACKAGE: &str = "ztl-simulation";

/// Optimised, with the checks of a debug build.
const PROFILE: &str = "--profile simulation --locked --package";

/// Explores everything that can happen with a few faults.
pub(crate) fn model(_: &Dirs, args: &[String]) -> Outcome {
    run("model", args)
}

/// Simulates whole laboratories, each from a seed.
pub(crate) fn simulate(_: &Dirs, args: &[String]) -> Outcome {
    run("simulate", args)
}

/// The part that `cargo xtask test` runs: everything with one fault, that mutants are detected, and 2,000
/// laboratories.
pub(crate) fn check(_: &Dirs) -> Outcome {
    Cmd::new("cargo test")
        .args(PROFILE)
        .arg(PACKAGE)
        .args("-- --show-output")
        .run()
}

fn run(what: &str, args: &[String]) -> Outcome {
    let run = Cmd::new("cargo run --quiet")
        .args(PROFILE)
        .arg(PACKAGE)
        .arg("--")
        .arg(what);
    args.iter().fold(run, |run, word| run.arg(word)).run()
}
