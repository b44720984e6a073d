//! `ztl ps` and `ztl abort` with incomplete or unreadable task lists: no task that may run is hidden or said to have ended.

use ztl_tests::lab::{Ended, FakeServer, PATIENCE, Process, SCOPE, connect, port_of, serve, ztl};

use crate::unknown_outcomes::Loses;

/// Simulates our server's replies to `probe` and `tasks`; `rest` follows its boot id.
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
fn an_unreadable_task_hides_no_other() {
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

    // A device reports only ids and scopes.
    let server = telling(", running: {8: /lab, 4294967296: /lab, x: /lab}", None);
    let ended = run(&server, &["ps"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.stdout.contains("4294967296"), "{ended:?}");
    assert!(ended.stderr.contains("1 of the tasks"), "{ended:?}");
    assert_eq!(run(&server, &["abort", "--all"]).code, Some(1));
}

#[test]
fn a_server_without_a_task_list_is_not_reported_as_idle() {
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
fn unreadable_text_is_quoted_up_to_a_limit() {
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

/// Whether an ABORT for this task arrived.
fn abort_came(server: &FakeServer, scope: &str, id: u32) -> bool {
    let request = format!("{scope};3;{id};abort command");
    server.requests().contains(&request)
}

#[test]
fn a_task_that_cannot_be_aborted_does_not_block_others() {
    let running = r#", running: {9: "/t;x", 8: /t, 7: /t}"#;
    for words in [&["abort", "--all"][..], &["abort", "9", "7", "8"]] {
        let server = telling(running, None);
        let ended = run(&server, words);
        assert_eq!(ended.code, Some(1), "{words:?}: {ended:?}");
        assert!(ended.stdout.contains("9: it may still run: "), "{ended:?}");
        assert!(abort_came(&server, "/t", 8), "{words:?}: {ended:?}");
        assert!(abort_came(&server, "/t", 7), "{words:?}: {ended:?}");
    }
}

#[test]
fn tasks_in_either_the_probe_or_the_list_are_aborted() {
    let one = listed(8, "/t", 1, "", "null");
    let contradiction = listed(8, "/t", 1, "", "5");
    let ended_already = listed(8, "/t", 5, "", "5");
    let running = ", running: {8: /t}";
    for (rest, tasks, code) in [
        // One list is truncated, the other is not.
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
        // The list is unreadable, in part or as a whole.
        (running, r#"{"tasks": [], "more": -5}"#.to_owned(), 1),
        (running, r#"{"tasks": []}"#.to_owned(), 1),
        (running, r#"{"more": 0}"#.to_owned(), 1),
        (running, "nonsense".to_owned(), 1),
        // They contradict each other or themselves.
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
        // No probe is readable.
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
    // The list is not a ZTL message.
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
fn a_task_missing_from_the_list_is_not_reported_as_ended() {
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
    // The list includes ended tasks, so unlisted ones have ended, too.
    let end = listed(9, "/t", 5, "there", "5");
    let server = telling("", Some(&format!(r#"{{"tasks": [{end}], "more": 5}}"#)));
    for command in [&["ps"][..], &["abort", "--all"]] {
        let ended = run(&server, command);
        assert_eq!(ended.code, Some(0), "{command:?}: {ended:?}");
        assert_eq!(ended.stdout, "No task is running.\n", "{command:?}");
    }
}

#[test]
fn a_task_with_an_unknown_outcome_is_listed_and_aborted() {
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
