//! A stdout whose reader is too slow.

use std::io::Read as _;
use std::process::Stdio;

use ztl_tests::lab::{PATIENCE, until};

use crate::directory::ScriptDirectory;

/// A script whose lines are more than a pipe holds.
fn long_script() -> String {
    let name = "n".repeat(1000);
    let scene = |nth: usize| format!("s{nth} {name}: {{a {name}: {{robot: {{x: 1}}}}}}\n");
    (0..60).map(scene).collect()
}

#[test]
fn lines_that_nobody_reads_make_a_run_fail() {
    let directory = ScriptDirectory::new(&long_script());
    let words = "run-script -s show.yaml --simulate=0.01 --yes --plain";
    let mut command = directory.command(words);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut running = command.spawn().unwrap();
    let status = until("the end of the run", PATIENCE, || {
        running.try_wait().unwrap()
    });
    let (mut lines, mut told) = (String::new(), String::new());
    let stdout = running.stdout.as_mut().unwrap();
    stdout.read_to_string(&mut lines).unwrap();
    let stderr = running.stderr.as_mut().unwrap();
    stderr.read_to_string(&mut told).unwrap();
    assert_eq!(status.code(), Some(120), "{told}");
    assert!(lines.len() < 100_000, "{}", lines.len());
    assert_eq!(
        told,
        "ztl: cannot write the output: its reader is too slow\n"
    );
    // A reader in time gets all.
    let ended = directory.run(words);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(ended.stdout.len() > 120_000, "{}", ended.stdout.len());
}
