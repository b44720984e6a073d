//! Answers without an outcome: about a task that may still run, about another task, or longer than expected. None counts as a
//! final state, and none makes a client start a task again.

use std::fs;

use ztl_std::{
    ExecutableTask, RemoteTask, RequestError, State, TaskContext, TaskController, TaskError,
    TaskRequest, TriggerError,
};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, SCOPE, Scratch, Server, connect, our_client,
    our_client_at, port_of, serve, until, ztl,
};

/// What a relay answers whose server was restarted.
const LOST: &str = "unknown: tcp://robot:1: the server does not know task 9";

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
fn a_task_whose_end_its_server_could_not_learn_has_an_unknown_outcome() {
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
    // So is an ABORT answered that comes after the end: without the reason.
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

struct Loses;

impl TaskController for Loses {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let task = |_: &TaskContext| Err::<String, TaskError>(LOST.into());
        Ok(Box::new(task))
    }
}

#[test]
fn an_unknown_outcome_that_comes_with_the_answer_to_the_init_is_unknown_too() {
    let server = serve(Loses);
    let mut remote = connect(server.endpoint());
    let ran = remote.run("h", "c", "g", Some(PATIENCE));
    let error = ran.expect("it is taken").expect_err("no end is known");
    assert!(
        matches!(error.last, Err(RequestError::UnknownEnd { .. })),
        "{error:?}"
    );
}

/// What `answer` says is about another task than the one that was started with the id 7.
#[test]
fn an_answer_about_another_task_is_no_answer_about_this_one() {
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
    // The original says these without the task's id or with it; they tell nothing of the task either.
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
fn an_init_that_is_answered_for_another_scope_may_have_started_its_task() {
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
fn a_step_whose_abort_is_answered_about_another_task_is_not_tried_again() {
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
    let mut remote = RemoteTask::connect(&server.endpoint(), "$ztl").expect("an address");
    until("no task runs", PATIENCE, || {
        let told = remote.describe().ok()??;
        told.running
            .is_some_and(|tasks| tasks.is_empty())
            .then_some(())
    });
}

#[test]
fn a_task_is_aborted_when_its_time_is_over_though_its_server_hung_for_a_while() {
    let server = Server::naps();
    let client = start_nap(&server, "1");
    server.process.signal("STOP");
    client.wait_for(r#""event":"aborting""#);
    let tries = || client.stderr().matches("disconnecting: no answer").count();
    let before = tries();
    until("an ABORT is not answered", PATIENCE, || {
        (tries() > before).then_some(())
    });
    server.process.signal("CONT");
    let ended = client.end(PATIENCE);
    assert_eq!(ended.code, Some(4), "{ended:?}");
    assert!(ended.stdout.contains(r#""fate":"aborted""#), "{ended:?}");
    runs_nothing(&server);
}

#[test]
fn a_task_whose_abort_is_never_answered_is_said_to_run_perhaps() {
    let server = Server::naps();
    let client = start_nap(&server, "1");
    let mut words = our_client();
    words.args(["--exit-status", "-t", "1"]);
    let words = server.start_client(words, &["nap:for:60"]);
    words.wait_for("Initialised task");
    server.process.signal("STOP");
    let (client, words) = (client.end(PATIENCE), words.end(PATIENCE));
    assert_eq!((client.code, words.code), (Some(5), Some(5)), "{words:?}");
    assert!(client.stdout.contains(r#""fate":"unknown""#), "{client:?}");
    let last = words.stdout.lines().last().unwrap_or_default();
    assert!(last.ends_with("may still run."), "{words:?}");
    for ended in [client, words] {
        assert!(!ended.stdout.contains("no server"), "{ended:?}");
        assert!(!ended.stdout.contains("nothing was sent"), "{ended:?}");
        assert!(!ended.stderr.contains("nothing was sent"), "{ended:?}");
    }
    server.process.signal("CONT");
}

/// 2 MiB: twice of what a server of ours takes.
const LONG: usize = 2 << 20;

#[test]
fn an_answer_that_is_longer_than_a_request_may_be_is_taken() {
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

/// A server of ours, as far as `probe` and `tasks` tell: `rest` stands behind its boot id.
fn telling(rest: &str, tasks: Option<&str>) -> FakeServer {
    let probe = format!("$ztl;5;0;{{ztl: 1, version: '9', boot: 7{rest}}}");
    let tasks = match tasks {
        Some(tasks) => format!("$ztl;5;0;{tasks}"),
        None => "$ztl;2;0;Invalid request".to_owned(),
    };
    FakeServer::with_questions(move |request| {
        let mut fields = request.split(';');
        let (scope, id) = (fields.next(), fields.nth(1));
        match request.strip_prefix("$ztl;2;-1;") {
            Some("probe") => probe.clone(),
            Some("tasks") => tasks.clone(),
            _ => format!("{};4;{};True", scope.unwrap_or(""), id.unwrap_or("")),
        }
        .into_bytes()
    })
}

fn run(server: &FakeServer, words: &[&str]) -> Ended {
    let port = server.port.to_string();
    Process::run(ztl().args(words).args(["-p", &port]))
}

#[test]
fn a_task_that_cannot_be_read_hides_no_other() {
    let entry = |id: &str, state: &str, age: &str| {
        format!(
            r#"{{"id": {id}, "scope": "/lab", "task": "a:b:{id}", "state": {state}, "text": "", "age_ms": {age}, "ended_ms": null}}"#
        )
    };
    let tasks = [
        entry("8", "1", "5"),
        entry("4294967296", "1", "5"),
        entry("9", "-1", "5"),
        entry("10", "1", "-5"),
    ];
    let server = telling(
        "",
        Some(&format!(
            r#"{{"tasks": [{}], "more": 0}}"#,
            tasks.join(", ")
        )),
    );
    let ended = run(&server, &["ps"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stdout.contains("a:b:8"), "{ended:?}");
    assert!(ended.stdout.contains("4294967296"), "{ended:?}");
    assert!(ended.stderr.contains("2 of the tasks"), "{ended:?}");
    let ended = run(&server, &["abort", "--all"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended.stdout.contains("4294967296 a:b:4294967296: ABORTED"),
        "{ended:?}"
    );
    assert!(ended.stderr.contains("2 of the tasks"), "{ended:?}");
    let aborted = |id: &str| {
        server
            .requests()
            .contains(&format!("/lab;3;{id};abort command"))
    };
    assert!(aborted("8") && aborted("4294967296"));

    // A device tells only ids and scopes.
    let server = telling(", running: {8: /lab, 4294967296: /lab, x: /lab}", None);
    let ended = run(&server, &["ps"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stdout.contains("4294967296"), "{ended:?}");
    assert!(ended.stderr.contains("1 of the tasks"), "{ended:?}");
    assert_eq!(run(&server, &["abort", "--all"]).code, Some(1));
}

#[test]
fn a_server_that_does_not_tell_what_runs_is_not_said_to_be_idle() {
    let server = telling("", None);
    for words in [&["abort", "--all"][..], &["ps"], &["ps", "--json"]] {
        let ended = run(&server, words);
        assert_eq!(ended.code, Some(1), "{words:?}: {ended:?}");
        assert!(!ended.stdout.contains("No task is running"), "{ended:?}");
        let words = "does not tell which tasks run";
        assert!(ended.stderr.contains(words), "{ended:?}");
    }
    let ended = run(&server, &["describe"]);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(!ended.stdout.contains("No task is running"), "{ended:?}");
}

#[test]
fn what_cannot_be_read_is_quoted_in_a_few_hundred_characters() {
    let long = "é".repeat(450_000);
    let server = telling(&format!(", '{long}"), Some(&format!("\"{long}\"")));
    let answer = format!("3;7;Controller threw exception: {long}");
    let throws = FakeServer::answering("1;7;moving", &answer, &answer);
    for (server, words) in [
        (&server, &["describe"][..]),
        (&server, &["ps"]),
        (&server, &["abort", "--all"]),
        (&throws, &["abort", "-s", SCOPE, "7"]),
    ] {
        let ended = run(server, words);
        assert_eq!(ended.code, Some(1), "{words:?}: {ended:?}");
        let said = ended.stdout.len() + ended.stderr.len();
        assert!((20..2000).contains(&said), "{words:?}: {said} bytes");
    }
}

/// A task as `tasks` lists it.
fn listed(id: u32, scope: &str, state: u8, text: &str, ended_ms: &str) -> String {
    format!(
        r#"{{"id": {id}, "scope": "{scope}", "task": "a:b:{id}", "state": {state}, "text": "{text}", "age_ms": 5, "ended_ms": {ended_ms}}}"#
    )
}

/// Whether an ABORT for this task came.
fn abort_came(server: &FakeServer, scope: &str, id: u32) -> bool {
    let request = format!("{scope};3;{id};abort command");
    server.requests().contains(&request)
}

#[test]
fn a_task_that_cannot_be_reached_keeps_no_other_from_being_aborted() {
    let running = r#", running: {9: "/t;x", 8: /t, 7: /t}"#;
    for words in [&["abort", "--all"][..], &["abort", "9", "7", "8"]] {
        let server = telling(running, None);
        let ended = run(&server, words);
        assert_eq!(ended.code, Some(1), "{words:?}: {ended:?}");
        assert!(ended.stderr.contains("cannot abort task 9: "), "{ended:?}");
        assert!(abort_came(&server, "/t", 8), "{words:?}: {ended:?}");
        assert!(abort_came(&server, "/t", 7), "{words:?}: {ended:?}");
    }
}

#[test]
fn what_the_probe_or_the_list_says_runs_is_aborted() {
    let one = listed(8, "/t", 1, "", "null");
    let contradiction = listed(8, "/t", 1, "", "5");
    let ended_already = listed(8, "/t", 5, "", "5");
    let running = ", running: {8: /t}";
    for (rest, tasks, code) in [
        // One list is cut, the other is not.
        (
            ", running: {7: /t, 8: /t}",
            format!(r#"{{"tasks": [{one}], "more": 1}}"#),
            0,
        ),
        // One id in two scopes.
        (
            ", running: {8: /t, 8: /u}",
            format!(r#"{{"tasks": [{one}], "more": 0}}"#),
            0,
        ),
        // The list cannot be read, or not as a whole.
        (running, r#"{"tasks": [], "more": -5}"#.to_owned(), 1),
        (running, r#"{"tasks": []}"#.to_owned(), 1),
        (running, r#"{"more": 0}"#.to_owned(), 1),
        (running, "nonsense".to_owned(), 1),
        // They contradict each other, or themselves.
        (running, r#"{"tasks": [], "more": 0}"#.to_owned(), 0),
        (
            running,
            format!(r#"{{"tasks": [{ended_already}], "more": 0}}"#),
            0,
        ),
        (
            ", running: {}",
            format!(r#"{{"tasks": [{contradiction}], "more": 0}}"#),
            0,
        ),
        // There is no probe that can be read.
        (", '", format!(r#"{{"tasks": [{one}], "more": 0}}"#), 0),
    ] {
        let server = telling(rest, Some(&tasks));
        let told = run(&server, &["ps"]);
        assert_eq!(told.code, Some(code), "{rest} {tasks}: {told:?}");
        assert!(told.stdout.contains("\n8   /t"), "{rest} {tasks}: {told:?}");
        let ended = run(&server, &["abort", "--all"]);
        assert_eq!(ended.code, Some(code), "{rest} {tasks}: {ended:?}");
        assert_eq!(ended.stderr.is_empty(), code == 0, "{ended:?}");
        assert!(abort_came(&server, "/t", 8), "{rest} {tasks}: {ended:?}");
        for (id, scope) in [(7, "/t"), (8, "/u")] {
            let runs = rest.contains(&format!("{id}: {scope}"));
            assert_eq!(
                abort_came(&server, scope, id),
                runs,
                "{rest} {tasks}: {ended:?}"
            );
        }
    }
    // The list is not told in a ZTL message.
    let server = FakeServer::with_questions(|request| {
        let answer = match request {
            "$ztl;2;-1;probe" => "$ztl;5;0;{ztl: 1, version: '9', boot: 7, running: {8: /t}}",
            "$ztl;2;-1;tasks" => "nonsense",
            _ => "/t;4;8;True",
        };
        answer.as_bytes().to_vec()
    });
    let ended = run(&server, &["abort", "--all"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stderr.contains("other tasks may run"), "{ended:?}");
    assert!(abort_came(&server, "/t", 8), "{ended:?}");
}

#[test]
fn a_task_that_the_server_does_not_list_is_not_said_to_have_ended() {
    let one = listed(8, "/t", 1, "", "null");
    for (rest, tasks, words) in [
        (
            "",
            r#"{"tasks": [], "more": 5}"#.to_owned(),
            "5 more tasks may run",
        ),
        (
            ", running: {}",
            r#"{"tasks": [], "more": 5}"#.to_owned(),
            "5 more tasks may run",
        ),
        (
            "",
            format!(r#"{{"tasks": [{one}], "more": 200}}"#),
            "200 more tasks may run",
        ),
    ] {
        let server = telling(rest, Some(&tasks));
        for command in [&["ps"][..], &["abort", "--all"]] {
            let ended = run(&server, command);
            assert_eq!(ended.code, Some(1), "{command:?} {tasks}: {ended:?}");
            assert!(
                ended.stderr.contains(words),
                "{command:?} {tasks}: {ended:?}"
            );
            assert!(!ended.stdout.contains("No task is running"), "{ended:?}");
        }
    }
    // The list reaches those that have ended, so the others have ended too.
    let end = listed(9, "/t", 5, "there", "5");
    let server = telling("", Some(&format!(r#"{{"tasks": [{end}], "more": 5}}"#)));
    for command in [&["ps"][..], &["abort", "--all"]] {
        let ended = run(&server, command);
        assert_eq!(ended.code, Some(0), "{command:?}: {ended:?}");
        assert_eq!(ended.stdout, "No task is running.\n", "{command:?}");
    }
}

#[test]
fn a_task_whose_end_its_server_could_not_learn_is_shown_and_aborted_as_one_that_may_run() {
    let server = serve(Loses);
    let mut remote = connect(server.endpoint());
    let id = remote.trigger("h", "c", "g").expect("it is taken").id;
    remote
        .wait(&id, Some(PATIENCE))
        .expect_err("no end is known");
    let port = port_of(server.endpoint()).to_string();
    let ztl = |words: &[&str]| Process::run(ztl().args(words).args(["-p", &port]));

    let told = ztl(&["ps"]);
    assert!(told.stdout.contains("may still run"), "{told:?}");
    assert!(told.stdout.contains("h:c:g"), "{told:?}");
    for words in [&["abort", "--all"][..], &["abort", id.as_str()]] {
        let ended = ztl(words);
        assert_eq!(ended.code, Some(1), "{words:?}: {ended:?}");
        let start = format!("{id} h:c:g: it may still run: ");
        assert!(ended.stdout.starts_with(&start), "{words:?}: {ended:?}");
    }
}

#[test]
fn the_answer_to_an_abort_is_not_told_as_the_result() {
    for (abort, status, expected) in [
        ("5;7;False", "5;7;there", (State::Completed, "there")),
        ("4;7;True", "4;7;half way", (State::Aborted, "half way")),
        ("3;7;False", "3;7;no link", (State::Failed, "no link")),
        // Nobody says more about these.
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
    // Its time is over, and it ended just before the ABORT.
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
    assert!(last.contains(r#""fate":"completed""#), "{ended:?}");
    assert!(last.contains(r#""text":"there""#), "{ended:?}");
}

#[test]
fn a_client_says_that_a_task_may_run_which_was_not_aborted() {
    let server = FakeServer::answering("1;7;moving", "1;7;None", "1;7;False");
    let mut client = our_client_at(server.port);
    let ended = Process::run(client.args(["-t", "1", "arm:left:up"]));
    let words = "Task with ID '7' may still run after unsuccessful abort signal. Reply is 'None'.";
    assert_eq!(ended.stdout.lines().last(), Some(words), "{ended:?}");
    assert!(!ended.stdout.contains("finished"), "{ended:?}");
}
