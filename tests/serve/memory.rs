//! The memory of the server, and how its threads are woken.

use std::path::PathBuf;
use std::process::Command;

use ztl_std::{RequestError, State, TaskId};
use ztl_tests::lab::{built, busy, process_status};

use crate::rig::{Rig, end, trigger};

/// The memory of a process, in KiB: in total, and without program and libraries.
fn resident(process: u32) -> [u64; 2] {
    ["VmRSS:", "RssAnon:"].map(|name| process_status(process, name))
}

/// The released program if one is given, else the test build.
fn program() -> Command {
    let released = std::env::var_os("ZTL_RELEASED").map(PathBuf::from);
    Command::new(released.unwrap_or_else(|| built("ztl")))
}

#[test]
fn threads_are_woken_by_eventfd() {
    // Without eventfd, libzmq uses two sockets, which makes a request 5 % slower.
    let rig = Rig::of_command(program(), "echo: {run: [echo, 'said {goal}']}");
    let files = format!("/proc/{}/fd", rig.server.process.id());
    let files = std::fs::read_dir(files).expect("its files");
    let files: Vec<_> = files
        .flatten()
        .filter_map(|file| std::fs::read_link(file.path()).ok())
        .collect();
    assert!(
        files
            .iter()
            .any(|file| file.ends_with("anon_inode:[eventfd]")),
        "{files:?}: libzmq was built without ZMQ_HAVE_EVENTFD, which .cargo/config.toml gives it for this target, \
         unless CXXFLAGS_<target> is set already"
    );
}

#[test]
fn a_thousand_remembered_tasks_fit_into_eight_mebibytes() {
    let _busy = busy();
    let rig = Rig::of_command(program(), "echo: {run: [echo, 'said {goal}']}");
    let [_, at_start] = resident(rig.server.process.id());
    for number in 0..1000 {
        let (state, _) = rig.run("echo", &number.to_string());
        assert_eq!(state, State::Completed);
    }
    let [all, own] = resident(rig.server.process.id());
    let watchdogs = rig.children().into_iter().map(resident);
    let [watchdog, watchdogs_own] = watchdogs.fold([0, 0], |[all, own], [more, more_own]| {
        [all + more, own + more_own]
    });
    println!(
        "resident: {all} KiB, of its own {own} KiB, {at_start} KiB at the start; the watchdog {watchdog} KiB, of its own {watchdogs_own} KiB"
    );
    // libzmq has a thread and buffers of its own.
    let most = match std::env::var_os("ZTL_TRANSPORT") {
        Some(_) => 4 * 1024,
        None => 3 * 1024,
    };
    // A test build is larger by itself, by the addresses that are relocated when it starts; the released one counts as a whole.
    match std::env::var_os("ZTL_RELEASED") {
        Some(_) => assert!(own <= most, "{own} KiB"),
        None => assert!(own - at_start <= most / 2, "{own} KiB after {at_start} KiB"),
    }
    assert!(watchdogs_own <= 2 * 1024, "{watchdogs_own} KiB");
    if std::env::var_os("ZTL_RELEASED").is_some() {
        assert!(all <= 8 * 1024, "{all} KiB");
    }
}

/// Newer results replace long ones; running tasks and the latest outcomes stay.
#[test]
fn long_results_take_no_more_memory_than_the_limit() {
    let _busy = busy();
    let rig = Rig::new(
        "long: {run: [sh, -c, 'head -c 700000 /dev/zero | tr \"\\0\" x'], output: 1000 KiB}\n        \
         runs: {run: [sleep, '3600']}",
    );
    let mut remote = rig.remote();
    let running = trigger(&mut remote, "runs", "");
    let [at_start, _] = resident(rig.server.process.id());
    let ids: Vec<_> = (0..300)
        .map(|_| {
            let id = trigger(&mut remote, "long", "");
            let (state, text) = end(&mut remote, id);
            assert_eq!((state, text.len()), (State::Completed, 700_000));
            id
        })
        .collect();
    let [now, _] = resident(rig.server.process.id());
    let grown = now.saturating_sub(at_start);
    println!("300 results of 700,000 bytes: {grown} KiB");
    // 205 MiB of results. The rest is in flight or kept by the allocator.
    assert!(grown < (64 + 32) << 10, "{grown} KiB");
    let mut state = |id: TaskId| remote.status(id).map(|status| status.state);
    assert_eq!(state(running), Ok(State::Accepted));
    assert!(matches!(
        state(ids[0]),
        Err(RequestError::UnknownTask { .. })
    ));
    for id in ids.into_iter().rev().take(50) {
        assert_eq!(state(id), Ok(State::Completed));
    }
}
