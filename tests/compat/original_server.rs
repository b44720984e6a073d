//! Our client, as a library, against the original's `ztl_task_server`.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, RequestError, State, TaskId, TriggerError};
use ztl_tests::lab::{
    LIMIT, OriginalClient, PATIENCE, SCOPE, Server, connect, start, status, until,
};

#[test]
fn a_task_is_accepted_and_completes() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let task = remote.trigger("test", "echo", "it's").expect("taken");
    // The original counts from 1.
    assert_eq!(task.id.as_str(), "1");
    let request = r#"{'handler': 'test', 'component': 'echo', 'goal': "it's"}"#;
    let reply = format!("Initiated task '1' with request: {request}");
    assert_eq!(task.reply, reply);
    let end = status(State::Completed, "it's");
    assert_eq!(remote.wait(&task.id, LIMIT), Ok(end.clone()));
    assert_eq!(remote.status(task.id), Ok(end));
}

#[test]
fn wait_returns_when_the_task_has_ended() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let id = start(&mut remote, "test", "sleep", "5");
    let mut seen = Vec::new();
    let end = remote.wait_with(id, LIMIT, |answer| {
        seen.push(answer.clone().expect("an answer").state);
        true
    });
    assert_eq!(end, Ok(status(State::Completed, "True")));
    let last = seen.pop();
    assert_eq!(last, Some(State::Completed));
    assert!(seen.len() > 3 && seen.iter().all(|state| *state == State::Accepted));
}

#[test]
fn a_wait_that_times_out_returns_no_final_state() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let id = start(&mut remote, "test", "sleep", "5");
    let error = remote.wait(id, Some(Duration::from_millis(300)));
    let error = error.expect_err("it still runs");
    assert_eq!(error.last, Ok(status(State::Accepted, "None")));
    let end = remote.wait(id, LIMIT);
    assert_eq!(end, Ok(status(State::Completed, "True")));
}

/// The original has no limit, and quotes the goal in its answer: here each byte as four.
#[test]
fn a_goal_of_any_length_is_accepted() {
    let server = Server::original();
    // On a busy machine the original may need more than the usual 2 s for such a goal.
    let mut remote = connect(&server.endpoint());
    for goal in ["x".repeat(1_000_000), "\u{1}".repeat(1_500_000)] {
        let end = remote.run("test", "echo", &goal, LIMIT);
        let end = end.expect("its end");
        assert!(end == status(State::Completed, &goal), "{}", end.text.len());
    }
}

#[test]
fn a_rejected_init_creates_no_task() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let reason = "Controller threw exception: No such handler 'robot', try 'test'.";
    let refused = TriggerError::Rejected {
        id: (-1).into(),
        reason: reason.to_owned(),
    };
    assert_eq!(remote.trigger("robot", "echo", "hi"), Err(refused));

    let id = start(&mut remote, "test", "dance", "waltz");
    let reason = "No such component 'dance', try 'echo/print/sleep'.";
    assert_eq!(remote.wait(id, LIMIT), Ok(status(State::Failed, reason)));
}

#[test]
fn a_rejected_abort_reports_that_the_task_continues() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let id = start(&mut remote, "test", "sleep", "5");
    assert_eq!(remote.abort(id), Ok(status(State::Accepted, "False")));
    let end = status(State::Completed, "True");
    assert_eq!(remote.wait(id, LIMIT), Ok(end.clone()));
    assert_eq!(remote.abort(id), Ok(end));
}

#[test]
fn an_unknown_id_or_scope_is_refused() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let id = TaskId::new(99).expect("an id");
    let unknown = RequestError::UnknownTask {
        id: id.into(),
        text: "Invalid ID '99'".to_owned(),
    };
    assert_eq!(remote.status(id), Err(unknown.clone()));
    assert_eq!(remote.abort(id), Err(unknown));

    let stranger = RemoteTask::connect(&server.endpoint(), "/elsewhere");
    let refused = TriggerError::Rejected {
        id: (-1).into(),
        reason: "No controller for scope: /elsewhere".to_owned(),
    };
    let mut stranger = stranger.expect("an address").with_timeout(PATIENCE);
    assert_eq!(stranger.trigger("test", "echo", "hi"), Err(refused));
}

#[test]
fn a_lost_server_gives_an_unknown_outcome_and_never_failed() {
    let mut server = Server::original();
    let mut remote = connect(&server.endpoint());
    let id = start(&mut remote, "test", "sleep", "60");
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    server.process.kill();

    let lost = |error: &RequestError| {
        matches!(
            error,
            RequestError::NotConnected { .. } | RequestError::NoAnswer { .. }
        )
    };
    let asked = Instant::now();
    let error = remote.status(id).expect_err("nobody is there");
    assert!(lost(&error), "{error:?}");
    let error = remote.wait(id, Some(Duration::from_millis(100)));
    let error = error.expect_err("nobody is there").last;
    assert!(error.as_ref().is_err_and(lost), "{error:?}");
    let error = remote.abort(id).expect_err("nobody is there");
    assert!(lost(&error), "{error:?}");
    let error = remote.trigger("test", "echo", "hi");
    assert!(
        matches!(&error, Err(TriggerError::Request(cause)) if lost(cause)),
        "{error:?}"
    );
    // Each of the four gave up after its 2 s.
    assert!(asked.elapsed() < Duration::from_secs(12));
}

#[test]
fn a_late_reply_is_never_matched_to_the_next_request() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let first = start(&mut remote, "test", "echo", "first");
    let second = start(&mut remote, "test", "echo", "second");
    assert!(remote.wait(first, LIMIT).is_ok() && remote.wait(second, LIMIT).is_ok());

    // The server is not dead, only slow: it holds its answer back.
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    server.process.signal("STOP");
    for _ in 0..3 {
        let error = remote.status(first).expect_err("it has stopped");
        assert!(
            matches!(
                error,
                RequestError::NoAnswer { .. } | RequestError::NotConnected { .. }
            ),
            "{error:?}"
        );
    }
    server.process.signal("CONT");
    let end = until("an answer", PATIENCE, || remote.status(second).ok());
    assert_eq!(end, status(State::Completed, "second"));
}

#[test]
fn an_unanswered_init_is_not_resent() {
    let server = Server::original();
    let mut remote = connect(&server.endpoint());
    let first = start(&mut remote, "test", "echo", "first");
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    server.process.signal("STOP");
    let error = remote.trigger("test", "echo", "second");
    assert!(
        matches!(
            error,
            Err(TriggerError::Request(RequestError::NoAnswer { .. }))
        ),
        "{error:?}"
    );
    server.process.signal("CONT");
    let mut witness = OriginalClient::connect(server.port, SCOPE);
    let third = witness.start("test", "echo", "third");
    // One id for the single INIT.
    assert_eq!(third, i64::from(first.get()) + 2);
}

/// The original's server has one thread, which takes the ABORTs one after the other and answers each at once.
#[test]
fn tasks_that_are_aborted_together_are_aborted_once_each() {
    let server = Server::original_with_patient_tasks();
    let mut remote = connect(&server.endpoint());
    let ids = [1, 2, 3, 4, 5].map(|goal: u8| start(&mut remote, "nap", "for", &goal.to_string()));
    let tasks = ids.map(|id| (SCOPE.to_owned(), id.into()));
    let mut told = BTreeMap::new();
    remote.abort_all(&tasks, |at, outcome| {
        assert_eq!(told.insert(at, outcome), None);
    });
    let expected = (0..5).map(|at| (at, Ok(status(State::Aborted, "None"))));
    assert_eq!(told, expected.collect());
    server.process.wait_for("abort 5");
    let aborted = server.process.stdout();
    let aborted: Vec<&str> = aborted
        .lines()
        .filter(|line| line.starts_with("abort "))
        .collect();
    assert_eq!(
        aborted,
        ["abort 1", "abort 2", "abort 3", "abort 4", "abort 5"]
    );
    assert_eq!(
        remote.status(ids[0]).expect("an answer").state,
        State::Aborted
    );
}
