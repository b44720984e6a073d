//! The examples, linked for another processor and run by its emulator.

use std::path::Path;
use std::process::Command;

use ztl_tests::lab::{COMPLETED, OriginalClient, Process};

use crate::build::PATIENCE;
use crate::serve::{port_of, warm_up};

/// A program that `cargo xtask c TARGET --check` has linked.
#[track_caller]
fn program(name: &str) -> Command {
    let told = |variable| std::env::var(variable).expect("run `cargo xtask c TARGET --check`");
    let emulator = told("ZTL_C_EMULATOR");
    let mut words = emulator.split(' ');
    let mut command = Command::new(words.next().expect("an emulator"));
    command.args(words);
    command.arg(Path::new(&told("ZTL_C_PROGRAMS")).join(name));
    command
}

/// Runs the client in C to its end: its exit status, and what it has printed.
#[track_caller]
fn ask(port: u16, component: &str, goal: &str, limit_ms: &str) -> (Option<i32>, String) {
    let mut client = program("client");
    client.arg(format!("tcp://127.0.0.1:{port}"));
    client.args(["/robot", "robot", component, goal, limit_ms]);
    let ended = Process::start(&mut client).end(PATIENCE);
    (ended.code, ended.stdout + &ended.stderr)
}

#[test]
#[ignore = "needs programs of another processor: `cargo xtask c TARGET --check`"]
fn programs_for_another_processor_run_as_server_and_client() {
    let mut worker = Process::start(program("worker").arg("tcp://127.0.0.1:*"));
    let port = port_of(&worker);
    let mut client = OriginalClient::connect(port, "/robot");
    warm_up(&mut client, "no such component; there is: base");
    let id = client.start("robot", "base", "forward");
    assert_eq!(client.wait(id, 20.0), (COMPLETED, "arrived"));
    let (status, printed) = ask(port, "base", "forward", "20000");
    assert!(
        status == Some(0) && printed.ends_with("COMPLETED: arrived\n"),
        "{printed}"
    );
    let (status, printed) = ask(port, "base", "back", "500");
    assert!(
        status == Some(1) && printed.contains("\nABORTED: "),
        "{printed}"
    );
    worker.write_line("");
    assert_eq!(worker.end(PATIENCE).code, Some(0));

    let handler = Process::start(program("handler").arg("tcp://127.0.0.1:*"));
    let port = port_of(&handler);
    let (status, printed) = ask(port, "head", "20", "20000");
    assert!(
        status == Some(0) && printed.ends_with("COMPLETED: 20 degrees\n"),
        "{printed}"
    );
    drop(handler);
}
