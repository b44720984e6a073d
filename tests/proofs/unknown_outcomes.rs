//! Answers without an outcome: about a task that may still run, about another task, or longer than expected. None counts as a
//! final state, and none makes a client start a task again.

use std::fs;
use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, RemoteTask, RequestError, RunError, State, TaskContext, TaskController,
    TaskError, TaskRequest, TriggerError,
};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, SCOPE, Scratch, Server, connect, our_client,
    our_client_at, serve, until, ztl,
};

/// The reply of a relay whose server was restarted.
pub(crate) const LOST: &str = "unknown: tcp://robot:1: the server does not know task 9";

/// Plays a script without an operator.
fn play(script: &str, port: u16) -> Ended {
    let files = Scratch::new();
    fs::write(files.path("show.yaml"), script).expect("a file");
    let mut command = ztl();
    command.args(["run-script", "--yes", "--plain", "-s"]);
    command.arg(files.path("show.yaml"));
    command.args(["--task", "test", "127.0.0.1", &port.to_string(), SCOPE]);
    Process::run(&mut command)
}

#[test]
fn a_final_state_unknown_to_the_server_is_an_unknown_outcome() {
    let lost = format!("3;7;{LOST}");
    let server = FakeServer::answering("1;7;moving", &lost, &lost);
    let mut remote = connect(&server.endpoint());
    let id = remote.trigger("arm", "left", "up").expect("it is taken").id;
    let words = "the server could not learn how the task ended: \
                 tcp://robot:1: the server does not know task 9";
    let waited = remote.wait(&id, None).expect_err("no end is known");
    let error = waited.last.expect_err("no state is known");
    assert!(error.was_answered());
    assert_eq!(error.to_string(), words);
    let error = remote.abort(&id).expect_err("no state is known");
    assert_eq!(error.to_string(), words);
    // An ABORT after the end gets the same reply, without the reason.
    let after = FakeServer::answering("1;7;moving", &lost, "3;7;False");
    let error = connect(&after.endpoint())
        .abort(&id)
        .expect_err("no state is known");
    assert_eq!(error.to_string(), words);

    let script = "s: {a(on_failure=go on): {test: {print: moving}}, b: {test: {echo: after}}}\n";
    let ended = play(script, server.port);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert_eq!(server.inits(), 2, "step b never starts: {ended:?}");
    assert!(ended.stderr.contains("Step 'a' waits: "), "{ended:?}");
}

pub(crate) struct Loses;

impl TaskController for Loses {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let task = |_: &TaskContext| Err::<String, TaskError>(LOST.into());
        Ok(Box::new(task))
    }
}

#[test]
fn an_unknown_outcome_in_the_init_reply_is_reported_as_unknown() {
    let server = serve(Loses);
    let mut remote = connect(server.endpoint());
    let ran = remote.run("h", "c", "g", Some(PATIENCE));
    let Err(RunError::NotEnded(error)) = ran else {
        panic!("an end is known: {ran:?}");
    };
    assert!(
        matches!(error.last, Err(RequestError::UnknownOutcome { .. })),
        "{error:?}"
    );
}

/// `answer` is about another task than the one started with the id 7.
#[test]
fn a_reply_about_another_task_is_not_accepted() {
    for (answer, words) in [
        ("/test;5;55;there", "about task '55' of scope '/test'"),
        ("/other;5;7;there", "about task '7' of scope '/other'"),
        ("/test;4;-1;True", "about task '-1' of scope '/test'"),
        ("/test;2;-1;not now", "about task '-1' of scope '/test'"),
        ("/test;5;seven;there", "about task 'seven' of scope '/test'"),
        (
            "/test;2;8;Invalid ID '8'",
            "about task '8' of scope '/test'",
        ),
    ] {
        let reply = answer.to_owned();
        let server = FakeServer::start(move |request| match request.split(';').nth(1) {
            Some("1") => b"/test;1;7;moving".to_vec(),
            _ => reply.clone().into_bytes(),
        });
        let mut remote = connect(&server.endpoint());
        let id = remote.trigger("arm", "left", "up").expect("it is taken").id;
        let error = remote.wait(&id, None).expect_err(answer).last;
        let error = error.expect_err("no state is known").to_string();
        assert!(error.contains(words), "{answer}: {error}");
        let error = remote.abort(&id).expect_err(answer).to_string();
        assert!(error.contains(words), "{answer}: {error}");

        let script = "s: {a(on_failure=retry 2): {test: {x: 1}}, b: {test: {echo: 1}}}\n";
        let ended = play(script, server.port);
        assert_eq!(ended.code, Some(1), "{answer}: {ended:?}");
        assert_eq!(server.inits(), 2, "{answer}: {ended:?}");
    }
    // The original sends these with or without the task's id; they say nothing about the task either.
    for answer in [
        "/test;2;-1;No controller for scope: /test",
        ";2;-1;Unknown protocol",
    ] {
        let server = FakeServer::start(move |request| match request.split(';').nth(1) {
            Some("1") => b"/test;1;7;moving".to_vec(),
            _ => answer.as_bytes().to_vec(),
        });
        let mut remote = connect(&server.endpoint());
        let id = remote.trigger("arm", "left", "up").expect("it is taken").id;
        let error = remote.abort(&id).expect_err(answer);
        assert!(matches!(error, RequestError::NotTold { .. }), "{error:?}");
    }
}

#[test]
fn an_init_answered_for_another_scope_has_an_unknown_outcome() {
    for answer in ["/other;1;7;moving", "/other;2;-1;not now"] {
        let server = FakeServer::start(move |_| answer.as_bytes().to_vec());
        let error = connect(&server.endpoint()).trigger("arm", "left", "up");
        let Err(TriggerError::Request(error @ RequestError::OtherTask { .. })) = error else {
            panic!("{error:?}");
        };
        assert!(!error.nothing_was_sent());
        let script = "s: {a(on_failure=retry 2): {test: {x: 1}}}\n";
        let ended = play(script, server.port);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert_eq!(server.inits(), 2, "{ended:?}");
    }
}

#[test]
fn an_abort_answered_for_another_task_is_not_retried() {
    for abort in ["4;55;True", "2;-1;not now", "5;55;there"] {
        let server = FakeServer::answering("1;7;moving", "1;7;None", abort);
        let script = "s: {a(on_failure=retry 2): {test: {x(timeout=0.2): 1}}}\n";
        let ended = play(script, server.port);
        assert_eq!(ended.code, Some(1), "{abort}: {ended:?}");
        assert_eq!(server.inits(), 1, "{abort}: {ended:?}");
        assert!(ended.stderr.contains("Step 'a' waits: "), "{ended:?}");
    }
}

/// Starts our client for a task that takes a minute, and waits for it to run.
fn start_nap(server: &Server, timeout: &str) -> Process {
    let mut client = our_client();
    client.args(["--json", "--exit-status", "-t", timeout]);
    let client = server.start_client(client, &["nap:for:60"]);
    client.wait_for(r#""event":"started""#);
    client
}

fn runs_nothing(server: &Server) {
    let remote = RemoteTask::connect(&server.endpoint(), "$ztl").expect("an address");
    let mut remote = remote.with_timeout(PATIENCE);
    until("no task runs", PATIENCE, || {
        let told = remote.describe().ok()??;
        told.running
            .is_some_and(|tasks| tasks.is_empty())
            .then_some(())
    });
}

#[test]
fn a_task_over_its_time_limit_is_aborted_after_its_server_hung() {
    // On a busy machine, the client may have given up before the server goes on.
    until("the server goes on in time", PATIENCE, || {
        let server = Server::naps();
        // Long enough to stop the server first.
        let client = start_nap(&server, "5");
        server.process.signal("STOP");
        client.wait_for(r#""event":"aborting""#);
        let tries = || client.stderr().matches("disconnecting: ").count();
        let (before, aborting) = (tries(), Instant::now());
        until("an ABORT fails", PATIENCE, || {
            let is_over = aborting.elapsed() > Duration::from_secs(10);
            (tries() > before || is_over).then_some(())
        });
        server.process.signal("CONT");
        let ended = client.end(PATIENCE);
        if ended.code == Some(5) {
            return None;
        }
        assert_eq!(ended.code, Some(4), "{ended:?}");
        assert!(ended.stdout.contains(r#""outcome":"aborted""#), "{ended:?}");
        runs_nothing(&server);
        Some(())
    });
}

#[test]
fn a_task_with_an_unanswered_abort_is_reported_as_possibly_running() {
    let server = Server::naps();
    // Long enough to start the second client and stop the server first.
    let limit = "10";
    let client = start_nap(&server, limit);
    let mut words = our_client();
    words.args(["--exit-status", "-t", limit]);
    let words = server.start_client(words, &["nap:for:60"]);
    words.wait_for("Initialised task");
    server.process.signal("STOP");
    let (client, words) = (client.end(PATIENCE), words.end(PATIENCE));
    assert_eq!((client.code, words.code), (Some(5), Some(5)), "{words:?}");
    assert!(
        client.stdout.contains(r#""outcome":"unknown""#),
        "{client:?}"
    );
    let last = words.stdout.lines().last().unwrap_or_default();
    assert!(last.ends_with("may still run."), "{words:?}");
    for ended in [client, words] {
        assert!(!ended.stdout.contains("no server"), "{ended:?}");
        assert!(!ended.stdout.contains("nothing was sent"), "{ended:?}");
        assert!(!ended.stderr.contains("nothing was sent"), "{ended:?}");
    }
    server.process.signal("CONT");
}

/// 2 MiB: twice the limit of our server.
const LONG: usize = 2 << 20;

#[test]
fn a_reply_longer_than_the_request_limit_is_accepted() {
    let server = FakeServer::with_questions(|request| {
        let long = "x".repeat(LONG);
        match request.split(';').nth(1) {
            _ if request.starts_with("$ztl;2;-1;probe") => {
                format!("$ztl;5;0;{{ztl: 1, version: '9', boot: 7, more: '{long}'}}")
            }
            Some("1") => format!("{SCOPE};1;7;moving"),
            _ => format!("{SCOPE};5;7;{long}"),
        }
        .into_bytes()
    });
    let mut remote = connect(&server.endpoint());
    let task = remote.trigger("arm", "left", "up").expect("it is taken");
    let end = remote.wait(&task.id, Some(PATIENCE)).expect("its end");
    assert_eq!((end.state, end.text.len()), (State::Completed, LONG));
}

#[test]
fn the_reply_to_an_abort_is_not_reported_as_the_result() {
    for (abort, status, expected) in [
        ("5;7;False", "5;7;there", (State::Completed, "there")),
        ("4;7;True", "4;7;half way", (State::Aborted, "half way")),
        ("3;7;False", "3;7;no link", (State::Failed, "no link")),
        // These have no further information.
        ("5;7;False", "6;7;dancing", (State::Completed, "None")),
        ("4;7;True", "5;55;there", (State::Aborted, "None")),
        ("4;7;True", "5;7;there", (State::Aborted, "None")),
        // It may still run.
        ("4;7;True", "1;7;half way", (State::Accepted, "half way")),
    ] {
        let server = FakeServer::answering("1;7;moving", status, abort);
        let told = connect(&server.endpoint()).abort(7).expect("its state");
        assert_eq!(
            (told.state, told.text.as_str()),
            expected,
            "{abort} {status}"
        );
    }
    // Its time limit passed, and it ended just before the ABORT.
    let server = FakeServer::start({
        let mut aborted = false;
        move |request| {
            let answer = match request.split(';').nth(1) {
                Some("1") => "1;7;moving",
                Some("3") => {
                    aborted = true;
                    "5;7;False"
                }
                _ if aborted => "5;7;there",
                _ => "1;7;None",
            };
            format!("{SCOPE};{answer}").into_bytes()
        }
    });
    let mut client = our_client_at(server.port);
    let ended = Process::run(client.args(["--json", "-t", "1", "arm:left:up"]));
    let last = ended.stdout.lines().last().unwrap_or_default();
    assert!(last.contains(r#""outcome":"completed""#), "{ended:?}");
    assert!(last.contains(r#""text":"there""#), "{ended:?}");
}

#[test]
fn a_client_reports_that_an_unaborted_task_may_still_run() {
    let server = FakeServer::answering("1;7;moving", "1;7;None", "1;7;False");
    let mut client = our_client_at(server.port);
    let ended = Process::run(client.args(["-t", "1", "arm:left:up"]));
    let words = "Task with ID '7' may still run after unsuccessful abort signal. Reply is 'None'.";
    assert_eq!(ended.stdout.lines().last(), Some(words), "{ended:?}");
    assert!(!ended.stdout.contains("finished"), "{ended:?}");
}
