//! What the server keeps in memory.

use std::path::PathBuf;
use std::process::Command;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{PATIENCE, SCOPE, built};

use crate::rig::Lab;

/// What a process has in memory, in KiB: all of it, and what is neither program nor library.
fn resident(process: u32) -> [u64; 2] {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("its status");
    ["VmRSS:", "RssAnon:"].map(|name| {
        let line = status.lines().find_map(|line| line.strip_prefix(name));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        number.unwrap_or_else(|| panic!("no {name} in {status}"))
    })
}

#[test]
fn a_thousand_remembered_tasks_fit_into_eight_mebibytes() {
    // A program that was built for tests is larger by itself; the released one counts as a whole.
    let released = std::env::var_os("ZTL_RELEASED").map(PathBuf::from);
    let program = released.clone().unwrap_or_else(|| built("ztl"));
    let lab = Lab::of_command(Command::new(program), "echo: {run: [echo, 'said {goal}']}");
    let mut remote = RemoteTask::connect(&lab.server.endpoint(), SCOPE).expect("an address");
    for number in 0..1000 {
        let ran = remote.run("p", "echo", &number.to_string(), Some(PATIENCE));
        assert_eq!(
            ran.expect("taken").expect("its end").state,
            State::Completed
        );
    }
    let [all, own] = resident(lab.server.process.id());
    let guards = lab.children().into_iter().map(resident);
    let [guard, guards_own] = guards.fold([0, 0], |[all, own], [more, more_own]| {
        [all + more, own + more_own]
    });
    println!(
        "resident: {all} KiB, of its own {own} KiB; the guard {guard} KiB, of its own {guards_own} KiB"
    );
    assert!(own <= 3 * 1024, "{own} KiB");
    assert!(guards_own <= 2 * 1024, "{guards_own} KiB");
    if released.is_some() {
        assert!(all <= 8 * 1024, "{all} KiB");
    }
}
