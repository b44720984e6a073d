//! `cargo xtask test`: every check the project has, in the order that fails soonest.

use std::time::{Duration, Instant};

use crate::cmd::{Cmd, Outcome};
use crate::{
    Dirs, bare, capi, clients, curve, dist, firmware, foreign, fuzz, image, package, peers, proof,
    python, simulate, size, tools,
};

/// The crates that have to do without `std` and without an allocator.
pub(crate) const BARE_CRATES: &[&str] = &["ztl-core", "ztl-mcu"];

/// The sets of features such a crate is checked with. One package at a time: in a build of the
/// whole workspace, a feature that another crate turns on would hide what is missing here.
pub(crate) const FEATURES: &[&str] = &[
    "",
    "--no-default-features",
    "--no-default-features --features defmt",
    "--all-features",
];

/// Ample for the demo, which takes seconds; short enough not to stall a run that hangs.
const DEMO_LIMIT: Duration = Duration::from_secs(60);

/// Runs a command that heeds signals, also where this one ignores them: under `nohup`, or in the background of a
/// script. The tests start programs that are to be stopped by signals.
const HEEDING: &str = "env --default-signal=HUP,INT,QUIT";

struct Step {
    name: &'static str,
    about: &'static str,
    run: fn(&Dirs) -> Outcome,
}

const STEPS: &[Step] = &[
    Step {
        name: "tools",
        about: "compilers, libzmq for C, Python 3 with venv, Node with npm, systemd-analyze, QEMU, Chromium, rustfmt and clippy are there",
        run: |_| tools::check(),
    },
    Step {
        name: "fmt",
        about: "all code is formatted",
        run: |_| {
            Cmd::new("cargo fmt --all --check").run()?;
            for apart in [
                image::MANIFEST,
                fuzz::MANIFEST,
                firmware::MANIFEST,
                "tests/log-device/Cargo.toml",
                capi::NODE,
            ] {
                Cmd::new("cargo fmt --all --check --manifest-path")
                    .arg(apart)
                    .run()?;
            }
            Ok(())
        },
    },
    Step {
        name: "clippy",
        about: "no lint fires, in the workspace and in each no_std crate alone",
        run: clippy,
    },
    Step {
        name: "doc",
        about: "the documentation builds without a warning",
        run: |_| {
            Cmd::new("cargo doc --workspace --no-deps --locked")
                .env("RUSTDOCFLAGS", "-D warnings")
                .run()
        },
    },
    Step {
        name: "package",
        about: "the crates could be published: what is packed is described, and enough to compile",
        run: package::check,
    },
    Step {
        name: "foreign",
        about: "the library and the command type-check for Windows and macOS, where rustup gives these targets",
        run: foreign::check,
    },
    Step {
        name: "python",
        about: "the original ZTL package is installed in a virtual environment",
        run: |dirs| python::ensure(dirs).map(drop),
    },
    Step {
        name: "clients",
        about: "the npm package of the client in JavaScript is installed",
        run: |dirs| clients::ensure(dirs).map(drop),
    },
    Step {
        name: "peers",
        about: "old and other peers are installed: libzmq 4.1.6, Python 2.7 where there is one, JeroMQ",
        run: |dirs| peers::ensure(dirs).map(drop),
    },
    Step {
        name: "bare",
        about: "the no_std crates build for three microcontrollers with nothing but `core`",
        run: bare::build,
    },
    Step {
        name: "proof",
        about: "bytes from outside reach no panic: shown by linking",
        run: proof::prove,
    },
    Step {
        name: "size",
        about: "the standard image and the boards' are as small as the records say",
        run: size::check,
    },
    Step {
        name: "firmware",
        about: "the images of examples/firmware build, and a Cortex-M0 is as quick as it is said to be",
        run: firmware::check,
    },
    Step {
        name: "test",
        about: "all tests: units, documentation examples, and against the original package",
        run: tests,
    },
    Step {
        name: "curve",
        about: "with libzmq built for encryption: who has no allowed key gets nothing",
        run: curve::test,
    },
    Step {
        name: "c",
        about: "the C interface: examples and misuse, with the original's client, under sanitizers and valgrind",
        run: capi::test,
    },
    Step {
        name: "dist",
        about: "the static `ztl` for x86-64 and i686, and C for i686, do their work in an empty root, and on old kernels",
        run: dist::test,
    },
    Step {
        name: "model",
        about: "the link keeps its promises whatever goes wrong, and mistakes would be noticed",
        run: simulate::check,
    },
    Step {
        name: "fuzz",
        about: "no fuzz target breaks a promise on its corpus, and on what libFuzzer makes of that with one seed",
        run: fuzz::smoke,
    },
    Step {
        name: "demo",
        about: "`ztl demo --once` runs to its end",
        run: demo,
    },
];

/// Runs the steps the arguments ask for; without arguments, all of them.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let Some(steps) = chosen(args)? else {
        for step in STEPS {
            println!("{:<8} {}", step.name, step.about);
        }
        return Ok(());
    };

    let begin = Instant::now();
    for (index, step) in steps.iter().enumerate() {
        println!(
            "\n=== {}/{} {}: {}",
            index + 1,
            steps.len(),
            step.name,
            step.about
        );
        let step_begin = Instant::now();
        (step.run)(dirs).map_err(|error| {
            format!(
                "step `{name}` FAILED after {}: {error}\n\
                 To run only this step again: cargo xtask test --only {name}",
                seconds(step_begin.elapsed()),
                name = step.name,
            )
        })?;
        println!("--- {}: ok, {}", step.name, seconds(step_begin.elapsed()));
    }

    let names: Vec<&str> = steps.iter().map(|step| step.name).collect();
    println!(
        "\nAll passed in {}: {}",
        seconds(begin.elapsed()),
        names.join(", ")
    );
    Ok(())
}

/// The steps to run, in their usual order; `None` when they shall only be listed.
fn chosen(args: &[String]) -> Outcome<Option<Vec<&'static Step>>> {
    let mut only: Vec<&str> = Vec::new();
    let mut words = args.iter().map(String::as_str);
    while let Some(word) = words.next() {
        match word {
            "--list" => return Ok(None),
            "--only" => {
                let name = words.next().unwrap_or_default();
                if !STEPS.iter().any(|step| step.name == name) {
                    let names: Vec<&str> = STEPS.iter().map(|step| step.name).collect();
                    return Err(format!(
                        "`--only` needs the name of a step, one of {}; not `{name}`",
                        names.join(", ")
                    ));
                }
                only.push(name);
            }
            _ => {
                return Err(format!(
                    "`cargo xtask test` does not know `{word}`; it takes `--list`, or \
                     `--only STEP` once or more often"
                ));
            }
        }
    }
    let wanted = |step: &&Step| only.is_empty() || only.contains(&step.name);
    Ok(Some(STEPS.iter().filter(wanted).collect()))
}

fn seconds(time: Duration) -> String {
    format!("{:.1} s", time.as_secs_f64())
}

fn clippy(dirs: &Dirs) -> Outcome {
    Cmd::new("cargo clippy --workspace --all-targets --locked -- -D warnings").run()?;
    Cmd::new("cargo clippy --locked --target-dir")
        .arg(dirs.target.join("node"))
        .arg("--manifest-path")
        .arg(capi::NODE)
        .args("-- -D warnings")
        .run()?;
    for package in BARE_CRATES {
        for features in FEATURES {
            Cmd::new("cargo clippy --locked --package")
                .arg(package)
                .args(features)
                .args("-- -D warnings")
                .run()?;
        }
    }
    Ok(())
}

/// The programs that the integration tests and the demo start.
fn build_programs() -> Outcome {
    Cmd::new("cargo build --workspace --bins --examples --locked").run()
}

fn tests(dirs: &Dirs) -> Outcome {
    let python = python::ensure(dirs)?;
    let clients = clients::ensure(dirs)?;
    let peers = peers::ensure(dirs)?;
    build_programs()?;
    firmware::build_for_qemu(dirs)?;
    Cmd::new(HEEDING)
        .args("cargo test --workspace --locked --no-fail-fast --exclude")
        .arg(simulate::PACKAGE)
        // Its tests need the libraries, which the step `c` makes.
        .args("--exclude ztl-c")
        .env("ZTL_PYTHON", python)
        .env("ZTL_CLIENTS", clients)
        .env("ZTL_PEERS", peers)
        .run()?;
    // What the programs do not ask for: components, an async loop, what interrupts share, defmt.
    Cmd::new("cargo test --package ztl-mcu --all-features --locked").run()
}

fn demo(dirs: &Dirs) -> Outcome {
    build_programs()?;
    Cmd::program(dirs.target.join("debug/ztl"))
        .args("demo --once --port 0")
        .run_within(DEMO_LIMIT)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(args: &[&str]) -> Outcome<Option<Vec<&'static str>>> {
        let args: Vec<String> = args.iter().map(|&arg| arg.to_owned()).collect();
        let steps = chosen(&args)?;
        Ok(steps.map(|steps| steps.iter().map(|step| step.name).collect()))
    }

    #[test]
    fn without_arguments_every_step_runs() {
        assert_eq!(names(&[]).unwrap().unwrap().len(), STEPS.len());
    }

    #[test]
    fn chosen_steps_run_in_their_usual_order() {
        let steps = names(&["--only", "test", "--only", "fmt"]).unwrap();
        assert_eq!(steps.unwrap(), ["fmt", "test"]);
    }

    #[test]
    fn a_list_runs_nothing() {
        assert_eq!(names(&["--list"]).unwrap(), None);
    }

    #[test]
    fn a_mistake_names_what_would_be_right() {
        assert!(names(&["--only", "fmd"]).unwrap_err().contains("clippy"));
        assert!(names(&["--only"]).unwrap_err().contains("clippy"));
        assert!(names(&["fmt"]).unwrap_err().contains("--only STEP"));
    }
}
