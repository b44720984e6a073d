//! `cargo xtask model` and `cargo xtask simulate`: the promises of the link, over the real state
//! machines. What they check, and how, is in `tests/simulation`.

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// The package of both. Its tests are run apart, optimised.
pub(crate) const PACKAGE: &str = "ztl-simulation";

/// Optimised, with the checks of a debug build.
const PROFILE: &str = "--profile simulation --locked --package";

/// Explores all that can happen with few faults.
pub(crate) fn model(_: &Dirs, args: &[String]) -> Outcome {
    run("model", args)
}

/// Plays whole laboratories, each from a seed.
pub(crate) fn simulate(_: &Dirs, args: &[String]) -> Outcome {
    run("simulate", args)
}

/// As `cargo xtask test` does it: everything with one fault, that mistakes are caught, and 2,000
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
