//! Runs tests, and those that fail once more, alone.
//!
//! Many tests wait for programs, boards in QEMU and other peers, with limits of seconds. A machine that stalls breaks
//! such a limit, a defect does so again. So what failed runs again, one test at a time. It must pass twice, and is
//! listed even then: what fails on an idle machine is a defect of the test.

use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use xshell::Cmd;

/// How often a test that failed has to pass.
const TIMES: u32 = 2;

/// If more tests fail, the machine is hardly the reason.
const AT_MOST: usize = 12;

/// Runs `cargo test` with all test binaries. `build` makes its command up to `--`, and `arguments` are those of the
/// test binaries.
pub(crate) fn cargo_test<'a>(
    build: impl Fn() -> Result<Cmd<'a>>,
    arguments: &[&str],
) -> Result<()> {
    let run = |arguments: &[&str]| -> Result<Ran> {
        let cargo = build()?.arg("--no-fail-fast").arg("--").args(arguments);
        show_and_read(cargo)
    };
    let ran = run(arguments)?;
    if ran.success {
        return Ok(());
    }
    let Some(failed) = failed_tests(&ran.output) else {
        anyhow::bail!("`cargo test` failed, and not by tests alone")
    };
    let names: Vec<&str> = failed.iter().map(String::as_str).collect();
    let list = names.join("\n    ");
    ensure!(
        names.len() <= AT_MOST,
        "{} tests failed:\n    {list}",
        names.len()
    );
    for time in 1..=TIMES {
        println!("\n=== again, one at a time ({time} of {TIMES}):\n    {list}");
        let alone = ["--test-threads=1", "--exact"];
        let ran = run(&[&alone[..], &names].concat())?;
        ensure!(
            ran.success,
            "these tests failed twice, or one of them did:\n    {list}"
        );
        let passed = passed(&ran.output);
        ensure!(
            passed >= names.len(),
            "only {passed} ran again of:\n    {list}"
        );
    }
    println!("\nFAILED ONCE, then passed {TIMES} times alone. Is the machine busy?\n    {list}");
    Ok(())
}

struct Ran {
    success: bool,
    output: String,
}

/// Runs a command, shows what it prints, and returns that.
fn show_and_read(cargo: Cmd<'_>) -> Result<Ran> {
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
    shell
        .env("CARGO_TERM_COLOR", "never")
        .stdout(Stdio::piped());
    let mut child = shell.spawn().context("sh")?;
    let mut lines = BufReader::new(child.stdout.take().context("its output")?);
    let mut output = String::new();
    let mut line = Vec::new();
    while lines.read_until(b'\n', &mut line)? > 0 {
        let text = String::from_utf8_lossy(&line);
        print!("{text}");
        output.push_str(&text);
        line.clear();
    }
    let success = child.wait()?.success();
    Ok(Ran { success, output })
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
        let (count, _) = line
            .strip_prefix("test result: ok. ")?
            .split_once(" passed")?;
        count.parse::<usize>().ok()
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
        assert_eq!(passed(OUTPUT), 3);
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
