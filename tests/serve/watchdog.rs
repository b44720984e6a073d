//! Only programs wait for the watchdog's confirmation. Here `sh` stands in for the watchdog.

use std::process::Command;

use ztl_serve::{Config, ProcessRegistry};
use ztl_std::{RunningServer, State, TaskServer};
use ztl_tests::lab::{PATIENCE, Scratch, connect, until};

use crate::rig::{end, rejected, try_trigger};

const FILE: &str = "
scopes:
  /test:
    p:
      echo: echo
      go: {run: [sh, -c, 'echo begun >> begun; until [ -e go ]; do sleep 0.01; done'], busy: queue 1}
";

/// A server whose watchdog is this shell command. Its stdin is the server.
fn serve(watchdog: &str) -> (Scratch, RunningServer, String) {
    let scratch = Scratch::new();
    let file = scratch.path("robot.yaml");
    std::fs::write(&file, FILE).expect("to write");
    let mut command = Command::new("sh");
    command.args(["-c", watchdog]).current_dir(scratch.path(""));
    let processes = ProcessRegistry::watched(command).expect("threads");
    let config = Config::load(&file).expect("a file");
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    for (scope, handler) in config.handlers(&processes).expect("threads") {
        server.register_handler(&scope, handler);
    }
    let endpoint = server.endpoint().to_owned();
    (scratch, server.spawn().expect("a thread"), endpoint)
}

#[test]
fn without_the_watchdogs_confirmation_only_programs_are_rejected() {
    for watchdog in [
        // It never becomes ready, does not answer, ends at once, or sends an unreadable line.
        "exec sleep 600",
        "echo 0 >&0; exec sleep 600",
        "exit",
        "echo ready >&0; exec sleep 600",
    ] {
        let (scratch, server, endpoint) = serve(watchdog);
        let [mut remote, mut other] = [(); 2].map(|()| connect(&endpoint));
        let rejection = std::thread::spawn(move || {
            until("a rejection in time", PATIENCE, || {
                rejected(&mut remote, ["p", "go", ""])
            })
        });
        let ran = other.run("p", "echo", "heard", Some(PATIENCE));
        assert_eq!(ran.expect("its end").state, State::Completed);
        let reason = rejection.join().expect("a reason");
        assert_eq!(
            reason, "not started: the watchdog has not confirmed within 1200 ms; try again",
            "{watchdog}"
        );
        drop(server);
        assert!(!scratch.path("begun").exists(), "{watchdog}");
    }
}

#[test]
fn an_abort_before_the_watchdogs_confirmation_starts_nothing() {
    until("the first program is confirmed in time", PATIENCE, || {
        // It confirms only the first program.
        let (scratch, _server, endpoint) = serve(
            "echo 0 >&0; read line; echo 1 >&0
            while read line; do case $line in *Begins*) echo > held; exec sleep 600;; esac; done",
        );
        let mut remote = connect(&endpoint);
        let first = try_trigger(&mut remote, ["p", "go", ""])?;
        let second = try_trigger(&mut remote, ["p", "go", ""]).expect("it waits");
        std::fs::write(scratch.path("go"), "").expect("to write");
        until("the watchdog hears of the second", PATIENCE, || {
            scratch.path("held").exists().then_some(())
        });
        remote.abort(second).expect("an answer");
        assert_eq!(end(&mut remote, first).0, State::Completed);
        // On a busy machine the confirmation may have timed out first.
        let (state, text) = end(&mut remote, second);
        if state != State::Failed {
            let aborted = (State::Aborted, "aborted before it began");
            assert_eq!((state, text.as_str()), aborted);
        }
        let begun = std::fs::read_to_string(scratch.path("begun")).expect("the first began");
        assert_eq!(begun, "begun\n");
        Some(())
    });
}
