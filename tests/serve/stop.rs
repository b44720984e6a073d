//! The server is asked to stop.

use std::os::unix::net::SocketAddr;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::State::{Aborted, Completed};
use ztl_tests::lab::{PATIENCE, Scratch, ServiceManager, built, until, ztl};

use crate::rig::{Rig, dies, end, lives, trigger};

const CAREFUL: &str = r#"
    careful: {run: [sh, -c, 'trap "sleep 0.5; echo parked > parked; exit" TERM; echo $$ > careful; while :; do sleep 0.02; done'], abort: {grace: 5 s}}
    stubborn: {run: [sh, -c, 'trap "" TERM; echo $$ > stubborn; while :; do sleep 0.02; done'], abort: {grace: 2500 ms}}
    waits: {run: [sleep, '60'], busy: queue 1, abort: {grace: 20 s}}
    sleep: sleep
    "#;

#[test]
fn under_nohup_the_server_survives_a_hangup() {
    let mut nohup = Command::new("sh");
    nohup
        .args(["-c", r#"trap '' HUP; exec "$@""#, "sh"])
        .arg(built("ztl"));
    let rig = Rig::of_command(nohup, CAREFUL);
    rig.server.process.signal("HUP");
    // Long enough for the signal to arrive.
    assert_eq!(rig.run("sleep", "0.3").0, Completed);
    rig.server.process.signal("TERM");
    assert_eq!(rig.server.process.end(PATIENCE).code, Some(143));
}

#[test]
fn a_signal_stops_every_task_within_its_grace_and_reports_it() {
    let rig = Rig::new(CAREFUL);
    let mut remote = rig.remote();
    let careful = trigger(&mut remote, "careful", "");
    let stubborn = trigger(&mut remote, "stubborn", "");
    let waits = trigger(&mut remote, "waits", "");
    let queued = trigger(&mut remote, "waits", "");
    let sleep = trigger(&mut remote, "sleep", "60");
    let processes = [rig.process("careful"), rig.process("stubborn")];
    let start = Instant::now();
    rig.server.process.signal("TERM");
    let stopped = "the server was stopped";
    for (id, text) in [
        (queued, "the server was stopped before it began"),
        (waits, stopped),
        (sleep, "aborted"),
        (careful, stopped),
        (
            stubborn,
            "the server was stopped (killed: not ended within 2500 ms of SIGTERM)",
        ),
    ] {
        assert_eq!(end(&mut remote, id), (Aborted, text.to_owned()));
    }
    assert!(start.elapsed() >= Duration::from_millis(2500));
    assert_eq!(rig.written("parked"), "parked");
    let Rig { server, scratch } = rig;
    let ended = server.process.end(PATIENCE);
    assert_eq!(ended.code, Some(143), "{ended:?}");
    assert!(ended.stdout.ends_with("Stopped.\n"), "{ended:?}");
    assert_eq!(
        ended.stderr.matches("has ended as ABORTED").count(),
        5,
        "{ended:?}"
    );
    for process in processes {
        assert!(!lives(process));
    }
    drop(scratch);
}

#[test]
fn a_second_signal_kills_all_programs_and_exits_at_once() {
    let rig = Rig::new(CAREFUL);
    let mut remote = rig.remote();
    trigger(&mut remote, "stubborn", "");
    let process = rig.process("stubborn");
    rig.server.process.signal("INT");
    rig.server.process.wait_for("Stopping;");
    let Rig { server, scratch } = rig;
    let ended = server.process.signal_until_end("INT", PATIENCE);
    assert_eq!(ended.code, Some(130), "{ended:?}");
    dies(process);
    drop(scratch);
}

#[test]
fn a_stopping_server_starts_no_new_task() {
    let rig = Rig::new(CAREFUL);
    let mut remote = rig.remote();
    trigger(&mut remote, "stubborn", "");
    let process = rig.process("stubborn");
    rig.server.process.signal("TERM");
    rig.server.process.wait_for("Stopping;");
    let mut other = rig.remote();
    let rejected = until("it is rejected", PATIENCE, || {
        other.trigger("p", "sleep", "60").err()
    });
    assert_eq!(rejected.to_string(), "rejected: the server is stopping");
    let Rig { server, scratch } = rig;
    assert_eq!(server.process.end(PATIENCE).code, Some(143));
    assert!(!lives(process));
    drop(scratch);
}

#[test]
fn systemd_is_notified_of_components_liveness_and_stopping() {
    let scratch = Scratch::new();
    let path = scratch.path("notify");
    let mut manager = ServiceManager::at(&SocketAddr::from_pathname(&path).expect("an address"));
    let mut command = ztl();
    command
        .env("NOTIFY_SOCKET", &path)
        .env("WATCHDOG_USEC", "200000");
    let rig = Rig::of_command(command, "echo: echo");
    let ready = manager.wait_for("READY=1", 1);
    assert!(ready.contains("\nSTATUS=1 component at /test"), "{ready}");
    manager.wait_for("WATCHDOG=1", 2);
    rig.server.process.signal("TERM");
    manager.wait_for("STOPPING=1", 1);
    assert_eq!(rig.server.process.end(PATIENCE).code, Some(143));
}
