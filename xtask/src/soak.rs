//! `cargo xtask soak`: long runs of the tests on a faulty line and of a server with many tasks, with real
//! processes.

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

/// Default number of tasks on a faulty line, and of resets of each side.
const TASKS: &str = "10000";
const RESETS: &str = "1000";

/// Tasks before the resets: as many results as a gateway keeps, so that it reaches its full size.
const FILL: &str = "10500";

/// Tasks through one server.
const MANY: &str = "1000000";

/// Runs everything; each test prints a short report.
pub(crate) fn run(_dirs: &Dirs, args: &[String]) -> Outcome {
    let [tasks, resets, many] = counts(args)?;
    Cmd::new("cargo build --release --workspace --bins --locked").run()?;
    Cmd::new("cargo test --release --locked --package ztl-tests --test line_faults")
        .args("-- --nocapture --test-threads 1")
        .env("ZTL_TASKS", tasks)
        .env("ZTL_RESETS", resets)
        .env("ZTL_FILL", FILL)
        .run()?;
    Cmd::new("cargo test --release --locked --package ztl-tests --test many_tasks")
        .args("-- --nocapture --test-threads 1")
        .env("ZTL_MANY_TASKS", many)
        .run()
}

/// Parses tasks, resets, and tasks through one server.
fn counts(args: &[String]) -> Outcome<[&str; 3]> {
    let mut counts = [TASKS, RESETS, MANY];
    let mut words = args.iter().map(String::as_str);
    while let Some(word) = words.next() {
        let place = match word {
            "--tasks" => &mut counts[0],
            "--resets" => &mut counts[1],
            "--many" => &mut counts[2],
            _ => {
                return Err(format!(
                    "unknown argument `{word}`: expected `--tasks N`, `--resets N` or `--many N`"
                ));
            }
        };
        *place = words
            .next()
            .filter(|number| number.parse::<u32>().is_ok_and(|number| number >= 10))
            .ok_or_else(|| format!("`{word}` needs an integer of at least 10"))?;
    }
    Ok(counts)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(line: &str) -> Outcome<[String; 3]> {
        let args: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        counts(&args).map(|counts| counts.map(str::to_owned))
    }

    #[test]
    fn counts_have_defaults_and_errors_say_what_is_expected() {
        assert_eq!(said("").unwrap(), [TASKS, RESETS, MANY]);
        assert_eq!(said("--resets 50 --tasks 20").unwrap(), ["20", "50", MANY]);
        for wrong in ["--tasks", "--tasks many", "--tasks 0", "50"] {
            let message = said(wrong).unwrap_err();
            assert!(message.contains("--tasks"), "{wrong}: {message}");
        }
    }
}
