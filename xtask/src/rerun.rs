//! Runs tests, and again, one at a time, those that failed.
//!
//! Many tests wait for programs, boards in QEMU and other peers, with limits of seconds. A machine that stalls breaks
//! such a limit now and then, a defect breaks it each time. A test that passes only when it runs again is listed: on an
//! idle machine it is a defect, too.

use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, ensure};
use xshell::Cmd;

/// How often a test that failed runs again at most.
const AGAIN: u32 = 2;

/// If more tests fail, the machine is hardly the reason.
const AT_MOST: usize = 20;

/// Runs `cargo test` with all test binaries. `build` makes its command up to `--`, and `arguments` are those of the
/// test binaries.
pub(crate) fn cargo_test<'a>(
    build: impl Fn() -> Result<Cmd<'a>>,
    arguments: &[&str],
) -> Result<()> {
    let run = |arguments: &[&str]| -> Result<Ran> {
        show_and_read(build()?.arg("--no-fail-fast").arg("--").args(arguments))
    };
    let first = run(arguments)?.failed()?;
    let mut failed = first.clone();
    for time in 1..=AGAIN {
        if failed.is_empty() {
            break;
        }
        let names: Vec<&str> = failed.iter().map(String::as_str).collect();
        let list = names.join("\n    ");
        ensure!(
            names.len() <= AT_MOST,
            "{} tests failed:\n    {list}",
            names.len()
        );
        println!("\n=== again, one at a time ({time} of {AGAIN} at most):\n    {list}");
        let ran = run(&[&["--test-threads=1", "--exact"], &names[..]].concat())?;
        let failed_again = ran.failed()?;
        let passed = passed(&ran.output);
        ensure!(
            passed + failed_again.len() >= names.len(),
            "only {passed} ran again of:\n    {list}"
        );
        failed = failed_again;
    }
    let list = |names: &BTreeSet<String>| {
        names
            .iter()
            .map(|name| format!("\n    {name}"))
            .collect::<String>()
    };
    ensure!(
        failed.is_empty(),
        "these tests failed each time:{}",
        list(&failed)
    );
    if !first.is_empty() {
        println!("\nPASSED ONLY AGAIN; is the machine busy?{}", list(&first));
    }
    Ok(())
}

struct Ran {
    success: bool,
    output: String,
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
