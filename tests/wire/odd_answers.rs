//! Answers that no server of this project sends: ids of any length, undefined states, fields that are not numbers.
//! The outcome is clear at once, and an accepted task is never started again.

use std::fs;
use std::process::Command;
use std::time::Instant;

use ztl_std::{RemoteTask, RequestError, State, TriggerError};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, SCOPE, Scratch, Server, connect, original_client,
    our_client, ours_named, ztl,
};

/// The first that the protocol's own servers cannot give, two that no `i64` and no `u64` can hold,
/// and the longest that Python can print.
fn large_ids() -> [String; 4] {
    [
        "4294967296".to_owned(),
        "9223372036854775808".to_owned(),
        "340282366920938463463374607431768211457".to_owned(),
        "9".repeat(4300),
    ]
}

#[test]
fn an_id_of_any_length_is_returned_unchanged() {
    for id in large_ids() {
        let server = FakeServer::answering(
            &format!("1;{id};moving"),
            &format!("5;{id};there"),
            &format!("4;{id};True"),
        );
        let mut remote = connect(&server.endpoint());
        let task = remote.trigger("arm", "left", "up").expect("it is taken");
        assert_eq!(task.id.to_string(), id);
        let end = remote.wait(&task.id, Some(PATIENCE)).expect("its end");
        assert_eq!((end.state, end.text.as_str()), (State::Completed, "there"));
        let aborted = remote.abort(&task.id).expect("an answer");
        assert_eq!(aborted.state, State::Aborted);
        let requests = server.requests();
        assert_eq!(requests[1], format!("{SCOPE};2;{id};waiting poll"));
        assert_eq!(requests[2], format!("{SCOPE};3;{id};abort command"));
    }
}

/// As the original's client reads and sends it: Python's `int`, then `str`.
#[test]
fn an_unusually_written_id_is_sent_like_the_original() {
    let server = FakeServer::answering("1; +0_7 ;moving", "5;7;there", "4;7;True");
    let mut remote = connect(&server.endpoint());
    let task = remote.trigger("arm", "left", "up").expect("it is taken");
    remote.wait(&task.id, Some(PATIENCE)).expect("its end");
    assert_eq!(server.requests()[1], format!("{SCOPE};2;7;waiting poll"));
}

#[test]
fn an_init_with_an_unreadable_reply_has_an_unknown_outcome() {
    for answer in [
        format!("{SCOPE};1;{};moving", "9".repeat(4301)),
        format!("{SCOPE};1;x;moving"),
        format!("{SCOPE};1"),
    ] {
        let server = FakeServer::start(move |_| answer.clone().into_bytes());
        let error = connect(&server.endpoint()).trigger("arm", "left", "up");
        let Err(TriggerError::Request(error @ RequestError::Unreadable { .. })) = error else {
            panic!("{error:?}");
        };
        assert!(!error.nothing_was_sent());
        assert!(error.to_string().contains("unknown"), "{error}");
        assert_eq!(server.inits(), 1);
    }
}

/// A script for the server at this port, in lines, with everything answered by the options.
fn play(files: &Scratch, script: &str, port: u16, record: &str) -> Ended {
    fs::write(files.path("show.yaml"), script).unwrap();
    let mut command = ztl();
    command.current_dir(files.path(""));
    command.args(["run-script", "-s", "show.yaml", "--yes", "--plain"]);
    command.args(["--record", record]);
    command.args(["--task", "test", "127.0.0.1", &port.to_string(), SCOPE]);
    Process::run(&mut command)
}

#[test]
fn a_script_starts_a_task_with_a_large_id_once_and_waits_for_it() {
    let server = Server::original_with_large_ids();
    let files = Scratch::new();
    let script = "s: {a(on_failure=retry 2): {test: {print: moving}}, b: {test: {print: last}}}\n";
    let ended = play(&files, script, server.port, "run.jsonl");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        !ended.stderr.contains("COULD NOT BE TRIGGERED"),
        "{ended:?}"
    );
    server.process.wait_for("goal: last");
    let started = server.process.stdout().matches("goal: moving").count();
    assert_eq!(started, 1);
    // A number that JavaScript could not hold is a text in the record.
    let record = fs::read_to_string(files.path("run.jsonl")).unwrap();
    let id = r#""id":"170141183460469231731687303715884105729""#;
    assert!(record.contains(id), "{record}");
    let report = Process::run(
        ztl()
            .args(["report", "run.jsonl", "-o", "run.html"])
            .current_dir(files.path("")),
    );
    assert_eq!(report.code, Some(0), "{report:?}");
}

#[test]
fn a_script_never_restarts_a_task_that_may_be_accepted() {
    for answer in [
        "1;x;moving".to_owned(),
        format!("1;{};moving", "9".repeat(4301)),
    ] {
        let server = FakeServer::answering(&answer, "1;1;moving", "4;1;True");
        let files = Scratch::new();
        let script = "s: {a(on_failure=retry 2): {test: {print: moving}}, b: {test: {echo: 1}}}\n";
        let ended = play(&files, script, server.port, "run.jsonl");
        assert_eq!(server.inits(), 1, "{ended:?}");
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(ended.stderr.contains("Step 'a' waits: "), "{ended:?}");
        assert!(!ended.stderr.contains("does not answer"), "{ended:?}");
    }
}

#[test]
fn a_script_stops_at_a_reply_without_a_state() {
    for (status, words) in [
        (
            "6;7;moving",
            "the server answered state 6, which ZTL does not define",
        ),
        (
            "99;7;moving",
            "the server answered state 99, which ZTL does not define",
        ),
        (
            "-1;7;moving",
            "the server answered state -1, which ZTL does not define",
        ),
        ("x;7;moving", "the server's answer is not a ZTL message"),
        ("2;7;Invalid ID", "the server does not know task 7"),
        ("2;7;Invalid ID '7'", "the server does not know task 7"),
    ] {
        let server = FakeServer::answering("1;7;moving", status, "4;7;True");
        let files = Scratch::new();
        let script = "s: {a(on_failure=retry 2): {test: {print: moving}}, b: {test: {echo: 1}}}\n";
        let ended = play(&files, script, server.port, "run.jsonl");
        assert_eq!(ended.code, Some(1), "{status}: {ended:?}");
        assert_eq!(server.inits(), 1, "{status}: {ended:?}");
        assert!(
            ended.stderr.contains("Step 'a' waits: "),
            "{status}: {ended:?}"
        );
        assert!(
            !ended.stderr.contains("does not answer"),
            "{status}: {ended:?}"
        );
        let record = fs::read_to_string(files.path("run.jsonl")).unwrap();
        assert!(record.contains(words), "{status}: {record}");
        assert!(!record.contains("silent"), "{status}: {record}");
    }
}

#[test]
fn a_wait_reports_an_invalid_reply_at_once() {
    for (status, words) in [
        (
            "6;7;dancing",
            "the server answered state 6, which ZTL does not define: dancing",
        ),
        (
            "123456789012345678901234567890;7;x",
            "the server answered state 123456789012345678901234567890, which ZTL does not define: x",
        ),
        ("x;7;dancing", "the server's answer is not a ZTL message"),
        ("2;7;Invalid ID", "the server does not know task 7"),
        ("2;7;Invalid ID '7'", "the server does not know task 7"),
        (
            "3;7;Controller threw exception: no link",
            "the server did not report the task's state: Controller threw exception: no link",
        ),
        (
            "2;7;No controller for scope: /test",
            "the server did not report the task's state: No controller for scope: /test",
        ),
    ] {
        let server = FakeServer::answering("1;7;moving", status, status);
        let mut remote = connect(&server.endpoint());
        let id = remote.trigger("arm", "left", "up").expect("it is taken").id;
        let error = remote.wait(&id, None).expect_err("no end is told");
        let error = error.last.expect_err("no state is told").to_string();
        assert!(error.contains(words), "{error}");
        let error = remote.abort(&id).expect_err("no state is told").to_string();
        assert!(error.contains(words), "{error}");
    }
    // A handler's own reason is an end.
    let server = FakeServer::answering("1;7;moving", "2;7;Invalid ID 'box 3'", "");
    let mut remote = connect(&server.endpoint());
    let id = remote.trigger("arm", "left", "up").expect("it is taken").id;
    let end = remote.wait(&id, None).expect("its end");
    assert_eq!(end.state, State::Rejected);
}

fn run_client(mut client: Command, server: &FakeServer, timeout: &str) -> Ended {
    let port = server.port.to_string();
    client.args(["-r", "127.0.0.1", "-p", &port, "-s", SCOPE, "-t", timeout]);
    Process::run(client.arg("arm:left:up"))
}

#[test]
fn under_the_originals_name_the_output_is_the_originals() {
    let files = Scratch::new();
    let long = "9".repeat(40);
    for (timeout, init, status, abort) in [
        ("-1", "1;7;moving", "6;7;dancing", "4;7;True"),
        ("-1", "1;7;moving", "99;7;", "4;7;True"),
        ("-1", "1;7;moving", "5;seven;there", "4;7;True"),
        ("-1", "1;7;moving", "2;7;Invalid ID", "4;7;True"),
        ("-1", "1;7;moving", "2;7;Invalid ID '7'", "4;7;True"),
        (
            "-1",
            "1;7;moving",
            "3;7;Controller threw exception: no",
            "4;7;True",
        ),
        ("1", "1;7;moving", "-7;7;dancing", "4;7;True"),
        ("1", "1;7;moving", "1;seven;None", "4;7;True"),
        ("1", "1;7;moving", "0;8;None", "4;7;True"),
        ("1", "1;7;moving", "1;7;None", "4;seven;True"),
        ("1", "1;7;moving", "1;7;None", "5;seven;True"),
        ("1", "1;7;moving", "1;seven;None", "-7;7;dancing"),
        ("1", "1;7;moving", "-7;7;dancing", "1;seven;False"),
        ("1", "1;7;moving", "1;7;None", "2;7;Invalid ID '7'"),
        ("1", "1;7;moving", "1;7;None", "6;7;dancing"),
        ("-1", "0;7;moving", "5;7;there", "4;7;True"),
        ("-1", "x;7;moving", "5;7;there", "4;7;True"),
        (
            "-1",
            &format!("1;{long};moving"),
            &format!("5;{long};there"),
            "4;7;True",
        ),
        ("-1", &format!("1;-{long};no"), "5;7;there", "4;7;True"),
        ("-1", "1; +0_7 ;moving", "5;7;there", "4;7;True"),
    ] {
        let server = FakeServer::answering(init, status, abort);
        let [ours, originals] = [ours_named(&files, "ztl_task_client"), original_client()]
            .map(|client| run_client(client, &server, timeout));
        assert_eq!(ours.stdout, originals.stdout, "{init} {status} {abort}");
        assert_eq!(ours.code, originals.code, "{init} {status} {abort}");
    }
}

#[test]
fn task_client_reports_an_invalid_reply_at_once() {
    for (status, words) in [
        (
            "6;7;dancing",
            "Could not wait for task with ID '7'. Reply is 'unknown: the server answered state 6, which ZTL does not define: dancing'.",
        ),
        (
            "2;7;Invalid ID",
            "Reply is 'unknown: the server does not know task 7",
        ),
        (
            "x;7;dancing",
            "Reply is 'unknown: the server's answer is not a ZTL message",
        ),
    ] {
        let server = FakeServer::answering("1;7;moving", status, "4;7;True");
        let ended = run_client(our_client(), &server, "-1");
        assert!(ended.stdout.contains(words), "{ended:?}");
        let mut client = our_client();
        client.arg("--json").arg("--exit-status");
        let ended = run_client(client, &server, "-1");
        assert_eq!(ended.code, Some(5), "{ended:?}");
        assert!(ended.stdout.contains(r#""outcome":"unknown""#), "{ended:?}");
    }
}

#[test]
fn an_id_in_json_is_a_number_below_2_to_the_53() {
    for (id, json) in [
        ("7", "7"),
        ("4294967296", "4294967296"),
        ("9007199254740991", "9007199254740991"),
        ("9007199254740992", "\"9007199254740992\""),
        ("99999999999999999999", "\"99999999999999999999\""),
    ] {
        let server = FakeServer::answering(&format!("1;{id};moving"), "5;1;there", "4;1;True");
        let mut client = our_client();
        client.arg("--json");
        let ended = run_client(client, &server, "-1");
        let line = format!(r#"{{"event":"started","id":{json},"reply":"moving"}}"#);
        assert!(ended.stdout.contains(&line), "{ended:?}");
    }
}

#[test]
fn a_task_with_a_large_id_is_aborted_by_its_id() {
    for id in large_ids() {
        let server = FakeServer::answering(
            "1;7;x",
            &format!("4;{id};half way"),
            &format!("4;{id};True"),
        );
        let port = server.port.to_string();
        let ended = Process::run(ztl().args(["abort", "-p", &port, "-s", SCOPE, &id]));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert_eq!(ended.stdout, format!("{id}: ABORTED, half way\n"));
        assert_eq!(
            server.requests()[0],
            format!("{SCOPE};3;{id};abort command")
        );
    }
}

/// The field would end there, and the rest be read as the state.
#[test]
fn a_scope_with_a_semicolon_is_rejected_before_anything_is_sent() {
    let error = RemoteTask::connect("tcp://127.0.0.1:1", "/a;3").expect_err("no scope");
    let words = "the scope '/a;3' contains ';', which would end it; write it as /lab";
    assert_eq!(error.to_string(), words);
    let files = Scratch::new();
    let remotes = "remotes: {arm: {host: 127.0.0.1, port: 1, scope: '/a;3'}}\n";
    fs::write(files.path("remotes.yaml"), remotes).unwrap();
    let run = |words: &[&str]| {
        let start = Instant::now();
        let ended = Process::run(ztl().args(words).current_dir(files.path("")));
        assert!(start.elapsed() < PATIENCE);
        assert!(ended.code != Some(0), "{words:?}: {ended:?}");
        ended.stderr
    };
    for tool in [
        &[
            "task-client",
            "-r",
            "127.0.0.1",
            "-p",
            "1",
            "-s",
            "/a;3",
            "x:y:z",
        ][..],
        &["simple-client", "127.0.0.1", "1", "/a;3", "x"],
        &[
            "remote-task",
            "--task",
            "arm",
            "127.0.0.1",
            "1",
            "/a;3",
            "arm",
            "x:y:z",
        ],
        &["abort", "-p", "1", "-s", "/a;3", "7"],
    ] {
        let error = run(tool);
        assert!(error.contains(words), "{tool:?}: {error}");
    }
    let error = run(&["remote-task", "-c", "remotes.yaml", "arm", "x:y:z"]);
    let place = format!("remotes.yaml:1:50: {words}");
    assert!(error.contains(&place), "{error}");
}
