//! INITs of our clients, which number them: repeated, voided, and answered with an early end.

use super::*;

#[test]
fn a_repeated_init_starts_nothing_and_gets_the_same_reply() {
    let mut server = TestServer::new();
    assert_eq!(server.ours(1, 5, "/test;1;-1;x"), Some(("start", 1)));
    assert_eq!(server.ours(2, 5, "/test;1;-1;x"), None);
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.pass(Duration::from_millis(3));
    assert_eq!(server.ours(3, 5, "/test;1;-1;x"), None);
    server.told(&[
        (1, "/test;1;1;ok"),
        (2, "/test;1;1;ok"),
        (3, "/test;1;1;ok"),
    ]);
    // The next number is a new INIT.
    assert_eq!(server.ours(1, 6, "/test;1;-1;x"), Some(("start", 2)));
    assert_eq!(server.ours(1, 5, "/test;1;-1;x"), None);
    server.told(&[(1, "/test;2;-1;this INIT was given up by its client")]);
}

#[test]
fn a_repeated_rejected_init_gets_the_same_reply() {
    let mut server = TestServer::new();
    server.ours(1, 5, "/test;1;-1;x");
    server.event(1, TaskEvent::Threw { message: "'goal'" });
    server.ours(1, 5, "/test;1;-1;x");
    server.ours(1, 6, "$ztl;2;-1;outcome 5");
    let threw = "Controller threw exception: 'goal'";
    server.told(&[
        (1, &std::format!("/test;3;-1;{threw}")),
        (1, &std::format!("/test;3;-1;{threw}")),
        (1, &std::format!("$ztl;3;-1;{threw}")),
    ]);
}

#[test]
fn outcome_reports_an_init_or_voids_it_for_a_minute() {
    let mut server = TestServer::new();
    server.ours(1, 5, "/test;1;-1;x");
    server.ours(2, 6, "$ztl;2;-1;outcome 5");
    server.told(&[]);
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.told(&[(1, "/test;1;1;ok"), (2, "$ztl;1;1;ok")]);
    server.ours(2, 7, "$ztl;2;-1;outcome 5");
    server.told(&[(2, "$ztl;1;1;ok")]);
    server.ours(2, 9, "$ztl;2;-1;outcome 8");
    server.told(&[(2, "$ztl;2;0;never seen since boot 4711")]);
    assert_eq!(
        server.ours(2, 8, "/test;1;-1;x"),
        None,
        "it arrives after all"
    );
    server.told(&[(2, "/test;2;-1;this INIT was given up by its client")]);
}

#[test]
fn outcome_waits_for_an_undecided_init() {
    let mut server = TestServer::new();
    server.ours(1, 5, "/test;1;-1;x");
    server.pass(HOLD);
    server.ours(2, 6, "$ztl;2;-1;outcome 5");
    server.pass(HOLD);
    let undecided = "Initiated task '1', nobody has taken it yet";
    server.told(&[
        (1, &std::format!("/test;1;1;{undecided}")),
        (2, &std::format!("$ztl;1;1;{undecided}")),
    ]);
}

#[test]
fn an_answered_init_is_kept_for_a_minute() {
    let mut server = TestServer::new();
    server.ours(1, 5, "/test;1;-1;x");
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.pass(Duration::from_millis(59_990));
    server.answers.clear();
    server.ours(1, 5, "/test;1;-1;x");
    server.told(&[(1, "/test;1;1;ok")]);
    server.pass(Duration::from_millis(20));
    assert_eq!(
        server.dispatcher.poll_timeout(),
        None,
        "its record has expired"
    );
}

#[test]
fn an_early_end_replaces_the_reply_if_the_client_asks_for_it() {
    let mut server = TestServer::new();
    server.with_early_end(1, 5, true, "/test;1;-1;x");
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.told(&[]);
    server.event(1, TaskEvent::Completed { result: "40" });
    server.told(&[(1, "/test;5;1;40")]);
    // A slower task gets the usual reply, and so does an INIT that does not ask for an early end.
    server.with_early_end(1, 6, true, "/test;1;-1;x");
    server.event(2, TaskEvent::Accepted { reply: "ok" });
    server.pass(Duration::from_millis(3));
    server.told(&[(1, "/test;1;2;ok")]);
    server.ours(1, 7, "/test;1;-1;x");
    server.event(3, TaskEvent::Accepted { reply: "ok" });
    server.told(&[(1, "/test;1;3;ok")]);
}

#[test]
fn an_init_that_replaces_one_with_a_held_reply_leaves_its_text_intact() {
    let mut server = TestServer::new();
    let second = Duration::from_secs(1);
    for (id, next, asked) in [
        (1, "/test;1;-1;x", None),
        (
            3,
            "$ztl;2;-1;outcome 99",
            Some("$ztl;2;0;never seen since boot 4711"),
        ),
    ] {
        let number = u64::from(id);
        server.with_early_end(1, number, true, "/test;1;-1;x");
        server.event(id, TaskEvent::Accepted { reply: "ok" });
        server.pass(Duration::from_millis(1));
        server.told(&[]);
        // Sent before the 3 ms have passed.
        server.ours(2, number + 1, next);
        server.event(id + 1, TaskEvent::Rejected { reason: "no" });
        let asked = asked.unwrap_or("/test;2;-1;no");
        server.told(&[(1, &std::format!("/test;1;{id};ok")), (2, asked)]);
        server.pass(second);
        server.told(&[]);
    }
}

#[test]
fn a_reused_number_is_rejected_under_the_requested_scope() {
    let mut server = TestServer::new();
    let taken = "2;-1;another INIT has this number";
    server.ours(1, 5, "/test;1;-1;x");
    for decided in [false, true] {
        if decided {
            server.event(1, TaskEvent::Accepted { reply: "ok" });
            server.told(&[(1, "/test;1;1;ok")]);
        }
        assert_eq!(server.ours(2, 5, "/other;1;-1;x"), None);
        assert_eq!(server.ours(2, 5, "/test;1;-1;y"), None);
        server.told(&[
            (2, &std::format!("/other;{taken}")),
            (2, &std::format!("/test;{taken}")),
        ]);
    }
    assert_eq!(server.ours(2, 5, "/test;1;-1;x"), None);
    server.told(&[(2, "/test;1;1;ok")]);
}

#[test]
fn a_final_state_without_prior_acceptance_answers_the_init_each_time() {
    let mut server = TestServer::new();
    server.ours(1, 5, "/test;1;-1;x");
    server.event(1, TaskEvent::Failed { reason: "stuck" });
    server.ours(1, 5, "/test;1;-1;x");
    server.ask(1, "/test;2;1;");
    server.told(&[
        (1, "/test;1;1;stuck"),
        (1, "/test;1;1;stuck"),
        (1, "/test;3;1;stuck"),
    ]);
}

#[test]
fn an_init_is_rejected_if_its_reply_could_not_be_recorded() {
    let mut server = TestServer::new();
    for client in [1, 2, 3] {
        server.request_of(client, client, 1, false, "/test;1;-1;x");
    }
    server.told(&[(3, &std::format!("/test;2;-1;{MANY_CLIENTS}"))]);
}
