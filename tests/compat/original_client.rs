//! The original's Python client, unchanged, against `ztl task-server`.

use std::time::Duration;

use ztl_tests::lab::{
    ACCEPTED, Answer, COMPLETED, FAILED, OriginalClient, PATIENCE, REJECTED, SCOPE, Server,
    reserve_port, until,
};

/// Far from every id that a server here gives: they begin at a random place up to 2^30.
const NOBODYS: i64 = 2_000_000_000;

#[test]
fn a_task_is_accepted_and_completes() {
    let server = Server::ours();
    let mut client = server.original_client();
    let task = client.trigger("test", "echo", "hi");
    let id = task.number;
    assert!(id > 0, "{task:?}");
    let request = "{'handler': 'test', 'component': 'echo', 'goal': 'hi'}";
    let reply = format!("Initiated task '{id}' with request: {request}");
    assert_eq!(task.text, reply);
    assert_eq!(client.end(id), (COMPLETED, "hi"));
    assert_eq!(client.status(id), (COMPLETED, "hi"));
}

#[test]
fn a_long_task_stays_accepted_until_it_ends() {
    let server = Server::ours();
    let mut client = server.original_client();
    let asked = std::time::Instant::now();
    let id = client.start("test", "sleep", "5");
    assert_eq!(client.status(id), (ACCEPTED, "None"));
    assert_eq!(client.wait(id, 0.2), (ACCEPTED, "None"));
    assert_eq!(client.wait(id, -1.0), (COMPLETED, "True"));
    assert!(asked.elapsed() >= Duration::from_secs(5));
}

#[test]
fn an_unknown_handler_is_refused_as_the_original_does() {
    let server = Server::ours();
    let mut client = server.original_client();
    let reason = "Controller threw exception: No such handler 'robot', try 'test'.";
    assert_eq!(client.trigger("robot", "echo", "hi"), (-1, reason));
}

#[test]
fn an_impossible_task_fails_with_the_reason() {
    let server = Server::ours();
    let mut client = server.original_client();
    let id = client.start("test", "dance", "waltz");
    let reason = "No such component 'dance', try 'echo/print/sleep'.";
    assert_eq!(client.end(id), (FAILED, reason));
    let id = client.start("test", "sleep", "soon");
    let reason = "invalid literal for int() with base 10: 'soon'";
    assert_eq!(client.end(id), (FAILED, reason));
}

#[test]
fn a_rejected_abort_changes_nothing() {
    let server = Server::ours();
    let mut client = server.original_client();
    let id = client.start("test", "sleep", "5");
    assert_eq!(client.abort(id), (ACCEPTED, "False"));
    assert_eq!(client.end(id), (COMPLETED, "True"));
}

#[test]
fn abort_of_a_finished_task_keeps_its_result() {
    let server = Server::ours();
    let mut client = server.original_client();
    let id = client.start("test", "echo", "done");
    assert_eq!(client.end(id), (COMPLETED, "done"));
    assert_eq!(client.abort(id), (COMPLETED, "False"));
    assert_eq!(client.status(id), (COMPLETED, "done"));
}

#[test]
fn an_unknown_id_or_scope_is_refused() {
    let server = Server::ours();
    let mut client = server.original_client();
    assert_eq!(client.status(99), (REJECTED, "Invalid ID '99'"));
    assert_eq!(client.abort(99), (REJECTED, "Invalid ID '99'"));
    for id in [0, -1, NOBODYS, i64::MAX] {
        let text = format!("Invalid ID '{id}'");
        assert_eq!(client.status(id), (REJECTED, text.as_str()));
    }
    let mut stranger = OriginalClient::connect(server.port, "/elsewhere");
    let reason = "No controller for scope: /elsewhere";
    assert_eq!(stranger.trigger("test", "echo", "hi"), (-1, reason));
    // The same words, but not the same scope.
    let scope = format!("{SCOPE}/");
    let mut stranger = OriginalClient::connect(server.port, &scope);
    let reason = format!("No controller for scope: {scope}");
    assert_eq!(
        stranger.trigger("test", "echo", "hi"),
        (-1, reason.as_str())
    );
}

#[test]
fn goals_of_every_kind_are_printed_like_the_original() {
    let (ours, original) = (Server::ours(), Server::original());
    let mut clients = [ours.original_client(), original.original_client()];
    for goal in [
        "",
        " ",
        "grüße aus Köln",
        "it's",
        "say \"hi\"",
        "it's \"both\"",
        "back\\slash",
        "a:b;c:d",
        "l1\nl2\r\tl3",
        "[1, {'a': 'b'}]",
        "👍🏽 日本語 \u{a0} \u{200b} \u{2028} \u{7f} \u{e000}",
        &"long ".repeat(10_000),
    ] {
        let [ours, original] = clients.each_mut().map(|client| {
            let Answer { number: id, text } = client.trigger("test", "echo", goal);
            assert!(id > 0, "{goal:?}: {text}");
            let reply = text.replacen(&format!("task '{id}'"), "task 'ID'", 1);
            (reply, client.end(id))
        });
        assert_eq!(ours, original, "{goal:?}");
        assert_eq!(ours.1, (COMPLETED, goal));
    }
}

#[test]
fn concurrent_tasks_get_unique_ids() {
    let server = Server::ours();
    let mut clients = [server.original_client(), server.original_client()];
    let mut ids = Vec::new();
    for round in 0..10 {
        for client in &mut clients {
            ids.push(client.start("test", "sleep", "3"));
            // A rejected task must not pass its id to the next.
            let refused = client.trigger("robot", "echo", "hi");
            assert_eq!(refused.number, -1, "in round {round}");
        }
    }
    assert!(ids.is_sorted_by(|one, next| one < next), "{ids:?}");
    let [one, other] = &mut clients;
    // Any client may ask about any task; concurrently they take 3 s, in sequence 60 s.
    until("all tasks have ended", PATIENCE, || {
        let done = |id| one.status(id) == (COMPLETED, "True");
        ids.iter().copied().all(done).then_some(())
    });
    assert_eq!(other.status(ids[0]), (COMPLETED, "True"));
}

#[test]
fn an_id_from_before_a_restart_is_unknown() {
    let mut ids = Vec::new();
    for run in 0..3 {
        let server = Server::ours();
        let mut client = server.original_client();
        for old in &ids {
            let text = format!("Invalid ID '{old}'");
            assert_eq!(client.status(*old), (REJECTED, text.as_str()), "run {run}");
        }
        for goal in 0..5 {
            ids.push(client.start("test", "echo", &goal.to_string()));
        }
    }
    let all = ids.len();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), all);
}

#[test]
fn a_client_survives_a_restart_of_its_server() {
    let mut server = Server::ours_at(reserve_port());
    let mut client = server.original_client();
    let id = client.start("test", "echo", "hi");
    server.process.kill();
    // The original's client has no unknown outcome; after 2 s it reports FAILED.
    let lost = client.wait(id, 2.0);
    let reason = "Again('Resource temporarily unavailable')";
    assert_eq!(lost, (FAILED, reason));

    let _again = Server::ours_at(server.port);
    let text = format!("Invalid ID '{id}'");
    let found = until("the client is back", PATIENCE, || {
        Some(client.wait(id, 2.0)).filter(|answer| answer.number != FAILED)
    });
    assert_eq!(found, (REJECTED, text.as_str()));
    let id = client.start("test", "echo", "again");
    assert_eq!(client.end(id), (COMPLETED, "again"));
}
