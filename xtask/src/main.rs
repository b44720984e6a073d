//! The project's development tasks, run as `cargo xtask <command>`.
//!
//! Depends only on a few small crates, which read firmware images and JSON, so that it compiles quickly on a
//! new machine.

mod bare;
mod bench;
mod capi;
mod clients;
mod cmd;
mod cross;
mod curve;
mod cycles;
mod dist;
mod firmware;
mod foreign;
mod fuzz;
mod image;
mod package;
mod peers;
mod places;
mod proof;
mod python;
mod simulate;
mod size;
mod soak;
mod test;
mod tools;
mod zig;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::{env, iter};

use cmd::Outcome;

/// A development task. Its function gets the words after the name.
struct Chore {
    name: &'static str,
    about: &'static str,
    run: fn(&Dirs, &[String]) -> Outcome,
}

const CHORES: &[Chore] = &[
    Chore {
        name: "build",
        about: "build the optimised `ztl` command (--curve: with encryption)",
        run: curve::run,
    },
    Chore {
        name: "c",
        about: "build the C libraries ([TARGET]...; --check: also run)",
        run: capi::run,
    },
    Chore {
        name: "test",
        about: "check and test everything, installing what is missing (--list, --only STEP)",
        run: test::run,
    },
    Chore {
        name: "fuzz",
        about: "search for inputs that break a promise ([TARGET], --seconds N for each)",
        run: fuzz::run,
    },
    Chore {
        name: "model",
        about: "explore all faults on the link ([SCENARIO], --depth FAULTS)",
        run: simulate::model,
    },
    Chore {
        name: "simulate",
        about: "simulate whole laboratories with faults (--seeds N, --first SEED, --show SEED)",
        run: simulate::simulate,
    },
    Chore {
        name: "size",
        about: "compare the size of firmware images with the record (--accept)",
        run: size::run,
    },
    Chore {
        name: "firmware",
        about: "build the images of examples/firmware ([BOARD])",
        run: firmware::run,
    },
    Chore {
        name: "qemu",
        about: "run a board's image and print how to reach it (BOARD [PORT])",
        run: firmware::run_in_qemu,
    },
    Chore {
        name: "dist",
        about: "build static `ztl` programs for each processor ([TARGET…]; --check: also run)",
        run: dist::run,
    },
    Chore {
        name: "soak",
        about: "run many tasks and resets with real processes (--tasks N, --resets N, --many N)",
        run: soak::run,
    },
    Chore {
        name: "bench",
        about: "compare performance with the original ([PART]...; firmware: cycles of a Cortex-M0)",
        run: bench::run,
    },
];

fn main() -> ExitCode {
    let words: Vec<String> = env::args().skip(1).collect();
    match dispatch(&words) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("\nxtask: {message}");
            ExitCode::FAILURE
        }
    }
}

fn dispatch(words: &[String]) -> Outcome {
    let Some((name, rest)) = words.split_first() else {
        println!("{}", help());
        return Ok(());
    };
    if matches!(name.as_str(), "help" | "--help" | "-h") {
        println!("{}", help());
        return Ok(());
    }
    match CHORES.iter().find(|chore| chore.name == name) {
        Some(chore) => (chore.run)(&Dirs::enter()?, rest),
        None => Err(format!("unknown command `{name}`\n\n{}", help())),
    }
}

fn help() -> String {
    let lines = CHORES
        .iter()
        .map(|chore| (chore.name, chore.about))
        .chain(iter::once(("help", "print this list")))
        .map(|(name, about)| format!("  {name:<8} {about}"));
    let lines: Vec<String> = lines.collect();
    format!(
        "usage: cargo xtask <command>\n\ncommands:\n{}",
        lines.join("\n")
    )
}

/// The project's directories. The working directory is the root of the repository.
struct Dirs {
    /// The root of the repository, absolute.
    root: PathBuf,
    /// Cargo's target directory, relative if possible, to keep printed commands short.
    target: PathBuf,
}

impl Dirs {
    /// Finds the directories and changes to the root.
    fn enter() -> Outcome<Self> {
        // Read at run time: a compiled-in path would become wrong when the tree is moved.
        let root = env::var_os("CARGO_MANIFEST_DIR")
            .and_then(|xtask| Path::new(&xtask).parent().map(Path::to_path_buf))
            .ok_or("run this program as `cargo xtask`, which tells it where the project is")?;
        env::set_current_dir(&root)
            .map_err(|error| format!("cannot enter {}: {error}", root.display()))?;

        // This program is in <target>/debug, whatever CARGO_TARGET_DIR or the configuration says.
        let program = env::current_exe()
            .map_err(|error| format!("cannot find the path of this program: {error}"))?;
        let target = program
            .ancestors()
            .nth(2)
            .ok_or("run this program as `cargo xtask`, which puts it into the target directory")?;
        let target = target.strip_prefix(&root).unwrap_or(target).to_path_buf();
        Ok(Self { root, target })
    }

    /// An absolute path in the target directory, for programs that run in another directory.
    fn absolute(&self, below_target: &str) -> PathBuf {
        self.root.join(&self.target).join(below_target)
    }
}
