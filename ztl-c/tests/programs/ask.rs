//! A client in C, and the original's server.

use ztl_tests::lab::{FakeServer, Process, SCOPE, Server, reserve_port, until};

use crate::build::{Build, PATIENCE, ended_well};
use crate::serve::started;

/// Runs the client to its end: its exit status, and what it has printed.
#[track_caller]
fn run(build: Build, endpoint: &str, component: &str, goal: &str, limit_ms: u32) -> (i32, String) {
    run_at(build, endpoint, SCOPE, [component, goal], limit_ms)
}

/// Repeats a run without an answer: the client waits for 2 s, and valgrind or a busy machine may need more.
#[track_caller]
fn run_at(
    build: Build,
    endpoint: &str,
    scope: &str,
    task: [&str; 2],
    limit_ms: u32,
) -> (i32, String) {
    until("a client that is answered", PATIENCE, || {
        let (status, printed) = run_once(build, endpoint, scope, task, limit_ms);
        (!is_unanswered(&printed)).then_some((status, printed))
    })
}

/// Whether a client has printed as its result that the server did not answer.
fn is_unanswered(printed: &str) -> bool {
    let errors = ["ZTL_E_NOT_CONNECTED: ", "ZTL_E_NO_ANSWER: "];
    let mut lines = printed.lines();
    lines.any(|line| errors.iter().any(|error| line.starts_with(error)))
}

#[track_caller]
fn run_once(
    build: Build,
    endpoint: &str,
    scope: &str,
    [component, goal]: [&str; 2],
    limit_ms: u32,
) -> (i32, String) {
    let mut command = build.example("client.c");
    let limit = limit_ms.to_string();
    command.args([endpoint, scope, "test", component, goal, &limit]);
    let ended = Process::start(&mut command).end(PATIENCE);
    assert_eq!(ended.stderr, "", "{}", ended.stdout);
    (ended.code.expect("an exit status"), ended.stdout)
}

#[track_caller]
pub(crate) fn reports_every_outcome(build: Build) {
    for server in [Server::original(), Server::ours()] {
        let endpoint = server.endpoint();
        let (status, printed) = run(build, &endpoint, "echo", "0.3", 20_000);
        assert!(
            status == 0 && printed.ends_with("COMPLETED: 0.3\n"),
            "{printed}"
        );

        let (status, printed) = run(build, &endpoint, "sleep", "soon", 20_000);
        assert!(status == 1 && printed.contains("\nFAILED: "), "{printed}");

        // This task cannot be stopped, and the client does not say that it was.
        let (status, printed) = run(build, &endpoint, "sleep", "30", 300);
        assert!(
            status == 2 && printed.contains("\ntoo long: it is aborted\nACCEPTED: "),
            "{printed}"
        );
    }

    let (worker, port) = started(build, "worker.c");
    let endpoint = format!("tcp://127.0.0.1:{port}");
    until("an ABORT that is in time", PATIENCE, || {
        let (status, printed) = run_at(build, &endpoint, "/robot", ["base", "back"], 300);
        // On a busy machine, the task may arrive before the ABORT, or stop after the answer to it.
        let is_late = status == 0 && printed.ends_with("\nCOMPLETED: arrived\n")
            || status == 2 && printed.contains("\ntoo long: it is aborted\nACCEPTED: ");
        assert!(
            is_late || status == 1 && printed.contains("\ntoo long: it is aborted\nABORTED: "),
            "{printed}"
        );
        (!is_late).then_some(())
    });
    let (status, printed) = run_at(build, &endpoint, "/robot", ["arm", "up"], 300);
    assert!(
        status == 1 && printed.starts_with("ZTL_E_REFUSED: no such component"),
        "{printed}"
    );
    drop(worker);

    let nowhere = format!("tcp://127.0.0.1:{}", reserve_port());
    let (status, printed) = run_once(build, &nowhere, SCOPE, ["echo", "1"], 1_000);
    assert!(
        status == 1 && printed.starts_with("ZTL_E_NOT_CONNECTED: "),
        "{printed}"
    );

    // No answer is never an end: the server says nothing any more.
    let server = Server::original();
    let mut command = build.example("client.c");
    command.args([&server.endpoint(), SCOPE, "test", "sleep", "30", "15000"]);
    let mut client = Process::start(&mut command);
    until("the client sees its task run", PATIENCE, || {
        let printed = client.stdout();
        if is_unanswered(&printed) {
            client = Process::start(&mut command);
            return None;
        }
        printed.contains("ACCEPTED ").then_some(())
    });
    server.process.signal("STOP");
    let ended = client.end(PATIENCE);
    server.process.signal("CONT");
    assert_eq!(ended.code, Some(2), "{}", ended.stdout);
    assert!(!ended.stdout.contains("FAILED"), "{}", ended.stdout);
    assert!(ended.stdout.contains("\nZTL_E_NO"), "{}", ended.stdout);
}

#[track_caller]
pub(crate) fn takes_ids_of_any_length(build: Build) {
    let id = "340282366920938463463374607431768211457";
    let server = FakeServer::answering(
        &format!("1;{id};moving"),
        &format!("5;{id};there"),
        &format!("4;{id};True"),
    );
    let mut command = build.test("long_ids.c");
    let printed = ended_well(Process::start(command.arg(server.endpoint())));
    assert_eq!(printed, format!("{id}\n"));
    let aborts = format!("{SCOPE};3;");
    let requests = server.requests();
    let aborts: Vec<_> = requests
        .iter()
        .filter(|body| body.starts_with(&aborts))
        .collect();
    assert_eq!(aborts, [&format!("{SCOPE};3;{id};abort command")]);
}
