//! Runs the tests, then reruns failed ones alone.
//!
//! Many tests wait for programs, boards in QEMU and other peers, with limits of seconds. A machine that stalls
//! breaks such a limit now and then, a defect breaks it each time. Reruns failed tests, with the same random input,
//! only if a stall was measured within a minute before each failure; otherwise the run fails. Lists those that pass
//! then.

use std::collections::BTreeSet;
use std::env;
use std::io::{BufRead as _, BufReader};
use std::num::NonZero;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, ensure};
use xshell::Cmd;

use crate::stalls::Stalls;

/// Most reruns of a failed test.
const RERUNS: u32 = 2;

/// If more tests fail, the machine is hardly the reason.
const AT_MOST: usize = 20;

/// Runs `cargo test` with all test binaries. `build` makes its command up to `--`, and `arguments` are those of the
/// test binaries.
pub(crate) fn cargo_test<'a>(
    build: impl Fn() -> Result<Cmd<'a>>,
    arguments: &[&str],
) -> Result<()> {
    let seed = match env::var("ZTL_SEED") {
        Ok(seed) => seed,
        Err(_) => SystemTime::now()
            .duration_since(UNIX_EPOCH)?
            .as_millis()
            .to_string(),
    };
    let stalls = Stalls::measure();
    let run = |arguments: &[&str]| -> Result<Ran> {
        let cargo = build()?.arg("--no-fail-fast").arg("--").args(arguments);
        show_and_read(cargo.env("ZTL_SEED", &seed), &stalls)
    };
    let ran = run(arguments)?;
    let first = ran.failed()?;
    let list = |names: &BTreeSet<String>| -> String {
        names.iter().map(|name| format!("\n    {name}")).collect()
    };
    let not_stalled = first.difference(&ran.stalled).cloned().collect();
    ensure!(
        first.is_subset(&ran.stalled),
        "these tests failed without a stall in the minute before (ZTL_SEED={seed}):{}",
        list(&not_stalled)
    );
    let mut failed = first.clone();
    for time in 1..=RERUNS {
        if failed.is_empty() {
            break;
        }
        let names: Vec<&str> = failed.iter().map(String::as_str).collect();
        let listed = list(&failed);
        ensure!(
            names.len() <= AT_MOST,
            "{} tests failed:{listed}",
            names.len()
        );
        println!("\n=== rerun, one test at a time ({time} of at most {RERUNS}):{listed}");
        let ran = run(&[&["--test-threads=1", "--exact"], &names[..]].concat())?;
        let failed_again = ran.failed()?;
        let passed = passed(&ran.output);
        ensure!(
            passed + failed_again.len() >= names.len(),
            "only {passed} were rerun of:{listed}"
        );
        failed = failed_again;
    }
    ensure!(
        failed.is_empty(),
        "these tests failed each time (ZTL_SEED={seed}):{}",
        list(&failed)
    );
    if !first.is_empty() {
        println!("\nPASSED ONLY WHEN RERUN, after {stalls}:{}", list(&first));
    }
    Ok(())
}

struct Ran {
    success: bool,
    output: String,
    /// The tests that failed within a minute after a stall.
    stalled: BTreeSet<String>,
}

impl Ran {
    /// The tests that failed; an error if something else did.
    fn failed(&self) -> Result<BTreeSet<String>> {
        if self.success {
            return Ok(BTreeSet::new());
        }
        failed_tests(&self.output).context("`cargo test` failed, and not by tests alone")
    }
}

/// Runs a command, shows what it prints, and returns that.
fn show_and_read(cargo: Cmd<'_>, stalls: &Stalls) -> Result<Ran> {
    println!("$ {cargo}");
    let cargo = Command::from(cargo);
    // The shell joins both outputs, so that their order is kept.
    let mut shell = Command::new("sh");
    shell.args(["-c", "exec \"$@\" 2>&1", "sh"]);
    shell.arg(cargo.get_program()).args(cargo.get_args());
    shell.envs(
        cargo
            .get_envs()
            .filter_map(|(name, value)| Some((name, value?))),
    );
    if env::var_os("RUST_TEST_THREADS").is_none() {
        shell.env("RUST_TEST_THREADS", test_threads().to_string());
    }
    shell
        .env("CARGO_TERM_COLOR", "never")
        .stdout(Stdio::piped());
    let mut child = shell.spawn().context("sh")?;
    let mut lines = BufReader::new(child.stdout.take().context("its output")?);
    let mut output = String::new();
    let mut stalled = BTreeSet::new();
    let mut line = Vec::new();
    while lines.read_until(b'\n', &mut line)? > 0 {
        let text = String::from_utf8_lossy(&line);
        print!("{text}");
        if let Some(name) = failed_now(&text)
            && stalls.were_recent()
        {
            stalled.insert(name.to_owned());
        }
        output.push_str(&text);
        line.clear();
    }
    let success = child.wait()?.success();
    Ok(Ran {
        success,
        output,
        stalled,
    })
}

/// Two for each processor: tests mostly wait for programs, boards and timeouts, so that the integration tests take
/// half the time.
fn test_threads() -> usize {
    2 * thread::available_parallelism().map_or(1, NonZero::get)
}

/// The test that has just failed, by a line of the output.
fn failed_now(line: &str) -> Option<&str> {
    let name = line.trim_end().strip_suffix(" ... FAILED")?;
    name.strip_prefix("test ")
}

/// The tests that failed, unless something else failed too: a test binary that died, or a build.
fn failed_tests(output: &str) -> Option<BTreeSet<String>> {
    let mut names = BTreeSet::new();
    let mut lists = 0;
    let mut lines = output.lines().peekable();
    while let Some(line) = lines.next() {
        // The first such line of a binary comes before its tests' output, the second before their names.
        if line != "failures:" {
            continue;
        }
        let list = std::iter::from_fn(|| lines.next_if(|line| line.starts_with("    ")));
        let before = names.len();
        names.extend(list.map(|name| name.trim().to_owned()));
        lists += usize::from(names.len() > before);
    }
    let binaries = output.lines().filter(|line| {
        line.starts_with("error: test failed") || line.starts_with("error: doctest failed")
    });
    (lists > 0 && lists == binaries.count()).then_some(names)
}

fn passed(output: &str) -> usize {
    let counts = output.lines().filter_map(|line| {
        let (_, counts) = line.strip_prefix("test result: ")?.split_once(". ")?;
        counts.split_once(" passed")?.0.parse::<usize>().ok()
    });
    counts.sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const OUTPUT: &str = "\
running 2 tests
test lines::one ... ok
test lines::two ... FAILED

failures:

---- lines::two stdout ----
failures:

failures:
    lines::two

test result: FAILED. 1 passed; 1 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s

error: test failed, to rerun pass `-p ztl-tests --test gateway`
     Running serve/main.rs (target/debug/deps/serve-1)
test result: ok. 3 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s
";

    #[test]
    fn failed_tests_are_found_in_the_output() {
        let names = failed_tests(OUTPUT).expect("only tests failed");
        assert_eq!(names.into_iter().collect::<Vec<_>>(), ["lines::two"]);
        assert_eq!(passed(OUTPUT), 4);
        let now = OUTPUT.lines().filter_map(failed_now).collect::<Vec<_>>();
        assert_eq!(now, ["lines::two"]);
    }

    #[test]
    fn a_crashed_binary_or_failed_build_is_not_a_failed_test() {
        let died =
            "error: test failed, to rerun pass `-p ztl-std --lib`\n\nCaused by:\n  signal: 6\n";
        assert_eq!(failed_tests(&format!("{OUTPUT}{died}")), None);
        assert_eq!(failed_tests(died), None);
        assert_eq!(failed_tests("error: could not compile `ztl-std`\n"), None);
    }
}
