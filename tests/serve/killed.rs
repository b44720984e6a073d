//! The server is killed: its watchdog stops the programs.

use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::State::{Aborted, Completed};
use ztl_std::{RemoteTask, RequestError, TaskId, TriggerError};
use ztl_tests::lab::{PATIENCE, Process, Scratch, python, reserve_port, signal, until, ztl};

use crate::rig::{Rig, dies, end, kill, lives, progress, start, told, trigger};

#[test]
fn every_program_gets_sigterm_and_is_killed_after_its_grace() {
    let mut rig = Rig::new(
        r#"
        careful: {run: [sh, -c, 'trap "sleep 0.3; echo parked > parked; exit" INT; echo $$ > careful; while :; do sleep 0.02; done'], abort: {signal: INT, grace: 20 s}}
        stubborn: {run: [sh, -c, 'trap "" TERM; (sleep 60) & echo $! > child; echo $$ > stubborn; while :; do sleep 0.02; done'], abort: {grace: 500 ms}}
        driver: {run: [sh, -c, 'echo $$ > driver; until [ -e halt ]; do sleep 0.02; done; rm driver'], abort: {run: [sh, -c, 'echo "$0 $ZTL_GOAL" > halt; sleep 0.1; echo > stopped', '{id}'], grace: 10 s}}
        stopped: {run: [sh, -c, 'echo $$ > halted; kill -STOP $$'], abort: {grace: 100 ms}}
        waits: {run: [sh, -c, 'echo begun >> begun; sleep 60'], busy: queue 1}
        ended: {run: [sh, -c, 'sleep 60 & echo $! > left; echo done'], left-behind: leave}
        "#,
    );
    let mut remote = rig.remote();
    assert_eq!(rig.run("ended", ""), (Completed, "done".to_owned()));
    for component in ["careful", "stubborn", "stopped"] {
        trigger(&mut remote, component, "");
    }
    let driver = trigger(&mut remote, "driver", "fast");
    trigger(&mut remote, "waits", "");
    trigger(&mut remote, "waits", "");
    let names = ["careful", "stubborn", "child", "halted"];
    let processes = names.map(|name| rig.process(name));
    rig.process("driver");
    rig.written("begun");
    let begun = Instant::now();
    rig.server.process.kill();
    assert_eq!(rig.written("parked"), "parked");
    assert_eq!(rig.written("halt"), format!("{driver} fast"));
    // That program got its grace although the other one ended earlier.
    rig.written("stopped");
    for process in processes {
        dies(process);
    }
    assert!(begun.elapsed() >= Duration::from_millis(500));
    rig.server
        .process
        .wait_for("The server has ended and left programs behind. Stopping them.");
    rig.server.process.wait_for("have ended.");
    assert!(!rig.scratch.path("driver").exists());
    // The waiting task never started, and the process that may stay still runs.
    assert_eq!(rig.written("begun").lines().count(), 1);
    assert!(lives(rig.process("left")));
    kill(rig.process("left"));
}

#[test]
fn the_watchdog_finds_a_program_that_is_just_starting() {
    for delay in 0..12 {
        let mut rig = Rig::new("go: {run: [sh, -c, 'echo > begun; sleep 60; true']}");
        let mut remote = rig.remote();
        // It never gets a reply, and the test does not wait for it.
        std::thread::spawn(move || drop(remote.trigger("p", "go", "")));
        // Kills at a different moment of its start each time.
        std::thread::sleep(Duration::from_micros(delay * 400));
        rig.server.process.kill();
        rig.server.process.wait_for_end_of_output();
        let begun = rig.scratch.path("begun").exists();
        println!("after {delay} times 400 µs: begun: {begun}");
        rig.wait_deserted(format_args!("after {delay} times 400 µs"));
    }
}

#[test]
fn a_repeatedly_killed_watchdog_is_replaced_while_the_server_idles() {
    let mut rig = Rig::new("go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}");
    for _ in 0..5 {
        let before = rig.watchdog();
        kill(before);
        until("another watchdog", PATIENCE, || {
            (rig.watchdog() != before).then_some(())
        });
    }
    trigger(&mut rig.remote(), "go", "");
    let process = rig.process("pid");
    rig.server.process.kill();
    dies(process);
}

#[test]
fn a_killed_or_unresponsive_watchdog_is_replaced() {
    let mut rig = Rig::new(
        r#"
        go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}
        many: {run: [sh, -c, ': "$ZTL_GOAL"'], abort: {run: ['true']}}
        "#,
    );
    let mut remote = rig.remote();
    trigger(&mut remote, "go", "");
    let process = rig.process("pid");
    let first = rig.watchdog();
    // It is the same program as its server, and runs under the same filter when an old kernel is simulated.
    let of = |process: u32| {
        let status = std::fs::read_to_string(format!("/proc/{process}/status"));
        let status = status.expect("its status");
        let filter = status.lines().find(|line| line.starts_with("Seccomp:"));
        let program = std::fs::read_link(format!("/proc/{process}/exe"));
        (program.expect("its program"), filter.map(str::to_owned))
    };
    assert_eq!(of(first), of(rig.server.process.id()));
    kill(first);
    until("another watchdog", PATIENCE, || {
        assert_eq!(rig.run("many", ""), (Completed, String::new()));
        rig.children().into_iter().find(|child| {
            let line = std::fs::read_to_string(format!("/proc/{child}/cmdline"));
            *child != first && line.is_ok_and(|line| line.contains("serve-watchdog"))
        })
    });
    rig.server
        .process
        .wait_for("The watchdog has been restarted.");

    // A suspended watchdog is noticed once its pipe is full, and delays no client.
    let second = rig.watchdog();
    signal(second, "STOP");
    let long = "x".repeat(50_000);
    until("another watchdog", PATIENCE, || {
        assert_eq!(rig.run("many", &long), (Completed, String::new()));
        (!lives(second)).then_some(())
    });
    until("another watchdog", PATIENCE, || {
        rig.run("many", "");
        (rig.watchdog() != second).then_some(())
    });
    assert!(lives(process));
    rig.server.process.kill();
    dies(process);
}

#[test]
fn no_program_starts_while_the_watchdog_is_being_replaced() {
    for _ in 0..3 {
        let mut rig = Rig::new("go: {run: [sh, -c, 'exec sleep 60']}");
        let mut remote = rig.remote();
        // The more watchdogs end in a row, the longer the pause before the next.
        let mut last = rig.watchdog();
        for _ in 0..5 {
            kill(last);
            last = until("another watchdog", PATIENCE, || {
                Some(rig.watchdog()).filter(|now| *now != last)
            });
        }
        kill(last);
        until("the program is started", PATIENCE, || {
            match remote.trigger("p", "go", "") {
                Err(TriggerError::Rejected { reason, .. }) => {
                    assert!(reason.contains("watchdog"), "{reason}");
                    None
                }
                taken => Some(taken.expect("an answer")),
            }
        });
        // The watchdog that confirmed the program knows of it.
        rig.server.process.kill();
        rig.wait_deserted("after the kill");
    }
}

#[test]
fn a_watchdog_ignores_every_signal_it_can() {
    let mut rig = Rig::new(
        r#"
        go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}
        other: {run: ['true']}
        "#,
    );
    trigger(&mut rig.remote(), "go", "");
    let process = rig.process("pid");
    let replaced = || {
        let log = rig.server.process.stderr();
        let lines = log
            .lines()
            .filter(|line| line.contains("Replacing the watchdog"));
        lines.map(str::to_owned).collect::<Vec<_>>()
    };
    until("a watchdog that answers in time", PATIENCE, || {
        let before = replaced().len();
        let first = rig.watchdog();
        for name in [
            "HUP", "INT", "TERM", "QUIT", "USR1", "USR2", "ALRM", "PIPE", "TSTP", "TTIN", "TTOU",
        ] {
            signal(first, name);
        }
        // A signal takes effect before the watchdog confirms anything else.
        assert_eq!(rig.run("other", ""), (Completed, String::new()));
        if rig.watchdog() == first {
            return Some(());
        }
        // On a busy machine it may be silent for longer than the server waits.
        let line = until("the log says why it was replaced", PATIENCE, || {
            replaced().get(before).cloned()
        });
        assert!(line.ends_with("no answer in time"), "{line}");
        None
    });
    rig.server.process.kill();
    dies(process);
}

/// The first process of a terminal, as in a container: it adopts orphans, and the terminal stops background
/// programs that write to it. Starts a server and a task there, kills the server, and waits for the program.
const CONTAINER: &str = r"
import ctypes, os, pty, subprocess, sys, termios, time
file, port, pid_file, *ztl = sys.argv[1:]
child, terminal = pty.fork()
if child:
    while True:
        try:
            sys.stdout.buffer.write(os.read(terminal, 4096))
        except OSError:
            sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
modes = termios.tcgetattr(0)
modes[3] |= termios.TOSTOP
termios.tcsetattr(0, termios.TCSANOW, modes)
server = subprocess.Popen([*ztl, 'serve', file])
client = [*ztl, 'task-client', '-p', port, '-s', '/robot', 'p:go:']
clients = []
limit = time.monotonic() + 30
while not os.path.exists(pid_file) and time.monotonic() < limit:
    clients.append(subprocess.Popen(client, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
    time.sleep(1)
program = int(open(pid_file).read())
server.kill()
gone = 1
while gone and time.monotonic() < limit:
    time.sleep(0.05)
    try:
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        pass
    try:
        os.kill(program, 0)
    except ProcessLookupError:
        gone = 0
if gone:
    os.kill(program, 9)
for client in clients:
    client.kill()
os._exit(gone)
";

#[test]
fn a_terminal_that_suspends_background_programs_spares_the_watchdog() {
    let scratch = Scratch::new();
    let (file, pid) = (scratch.path("robot.yaml"), scratch.path("pid"));
    let port = reserve_port();
    let command = format!(
        "echo $$ > {0}.new; mv {0}.new {0}; exec sleep 300",
        pid.display()
    );
    let text = format!(
        "port: {port}\nscopes:\n  /robot:\n    p:\n      go: {{run: [sh, -c, '{command}'], abort: {{grace: 500 ms}}}}\n"
    );
    std::fs::write(&file, text).expect("to write");
    let mut container = Command::new(python());
    container
        .args(["-c", CONTAINER])
        .arg(&file)
        .arg(port.to_string())
        .arg(&pid)
        .arg(ztl().get_program())
        .args(ztl().get_args());
    let ended = Process::start(&mut container).end(PATIENCE * 2);
    assert_eq!(ended.code, Some(0), "{} {}", ended.stdout, ended.stderr);
}

#[test]
fn a_suspended_watchdog_stops_programs_after_the_server_dies() {
    let mut rig = Rig::new("go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}");
    trigger(&mut rig.remote(), "go", "");
    let process = rig.process("pid");
    signal(rig.watchdog(), "STOP");
    rig.server.process.kill();
    dies(process);
}

#[test]
fn a_suspended_watchdog_is_replaced_before_another_program_starts() {
    let mut rig = Rig::new("go: {run: [sh, -c, 'exec sleep 60'], at-once: 9}");
    let mut remote = rig.remote();
    trigger(&mut remote, "go", "");
    let first = rig.watchdog();
    signal(first, "STOP");
    trigger(&mut remote, "go", "");
    assert!(!lives(first));
    rig.server.process.kill();
    rig.wait_deserted("after the kill");
}

/// A `ztl` whose stderr is this file.
fn logging_to(file: &Path) -> Command {
    let (ztl, mut command) = (ztl(), Command::new("sh"));
    command
        .args(["-c", r#"exec "$@" 2>>"$0""#])
        .arg(file)
        .arg(ztl.get_program())
        .args(ztl.get_args());
    command
}

#[test]
fn an_unwritable_log_does_not_prevent_stopping_programs() {
    let scratch = Scratch::new();
    let fifo = scratch.path("log");
    let made = Command::new("mkfifo").arg(&fifo).status();
    assert!(made.expect("`mkfifo`").success());
    // Held open and never read.
    let log = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(0o4000)
        .open(&fifo);
    let mut log = log.expect("to open it");
    for file in [Path::new("/dev/full"), &fifo] {
        let mut rig = Rig::of_command(
            logging_to(file),
            r#"
            go: {run: [sh, -c, 'trap "" TERM; echo $$ > pid; while :; do sleep 0.02; done'], abort: {grace: 100 ms}}
            "#,
        );
        trigger(&mut rig.remote(), "go", "");
        let process = rig.process("pid");
        if file == fifo {
            // Now it is full.
            for size in [512, 1] {
                while log.write(&vec![b'x'; size]).is_ok() {}
            }
        }
        rig.server.process.kill();
        dies(process);
    }
}

#[test]
fn after_a_restart_a_tasks_outcome_is_unknown() {
    let mut rig = Rig::new("go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}\necho: echo");
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "go", "");
    let process = rig.process("pid");
    rig.server.process.kill();
    dies(process);
    rig.server = start(&rig.scratch.path("robot.yaml"), &[]);
    let mut remote = rig.remote();
    let unknown = remote
        .wait(id, Some(PATIENCE))
        .expect_err("it is not known");
    assert!(
        matches!(unknown.last, Err(RequestError::UnknownTask { .. })),
        "{unknown:?}"
    );
    assert_eq!(rig.run("echo", "again"), (Completed, "again".to_owned()));
}

/// A connected client that does not wait long.
fn impatient(rig: &Rig, task: TaskId) -> RemoteTask {
    let mut remote = rig.remote().with_timeout(Duration::from_secs(1));
    until("an answer in time", PATIENCE, || remote.status(task).ok());
    remote
}

#[test]
fn a_resumed_server_learns_what_its_programs_did() {
    let rig = Rig::new(
        r#"
        go: {run: [sh, -c, 'echo "@ on"; until [ -e go ]; do sleep 0.01; done; echo done > done; echo done'], progress: '@ ', at-once: 2}
        limited: {run: [sh, -c, 'echo "@ on"; exec sleep 60'], progress: '@ ', limit: 5 s, abort: {grace: 20 s}}
        "#,
    );
    let mut remote = rig.remote();
    let mut started = |component: &str| -> TaskId {
        let id = trigger(&mut remote, component, "");
        progress(&mut remote, id, "on");
        id
    };
    let ends = started("go");
    let limited = started("limited");
    let begun = Instant::now();
    let mut impatient = impatient(&rig, ends);
    rig.server.process.signal("STOP");
    let silent = impatient.status(ends).expect_err("nobody answers");
    assert!(
        matches!(silent, RequestError::NoAnswer { .. }),
        "{silent:?}"
    );
    // Both end, or should end, while the server is suspended.
    std::fs::write(rig.scratch.path("go"), "").expect("to write");
    rig.written("done");
    std::thread::sleep(Duration::from_secs(5).saturating_sub(begun.elapsed()));
    rig.server.process.signal("CONT");
    assert_eq!(end(&mut remote, ends), (Completed, "done".to_owned()));
    let (_, text) = end(&mut remote, limited);
    assert_eq!(text, "not done within 5 s");
}

#[test]
fn a_suspended_server_executes_an_abort_once_resumed() {
    let rig = Rig::new("go: {run: [sh, -c, 'echo $$ > pid; exec sleep 60']}");
    let mut remote = rig.remote();
    let id = trigger(&mut remote, "go", "");
    let process = rig.process("pid");
    let mut impatient = impatient(&rig, id);
    rig.server.process.signal("STOP");
    impatient.abort(id).expect_err("nobody answers");
    assert!(lives(process));
    rig.server.process.signal("CONT");
    assert_eq!(end(&mut remote, id), (Aborted, "aborted".to_owned()));
    assert!(!lives(process));
    assert_eq!(
        told(remote.abort(id).expect("an answer")).0,
        Aborted,
        "an end stays"
    );
}
