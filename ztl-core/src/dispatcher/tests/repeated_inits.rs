//! INITs of our clients, which number them: repeated, voided, and answered with an early end.

use super::*;

#[test]
fn a_repeated_init_starts_nothing_and_gets_the_same_reply() {
    let mut desk = Desk::new();
    assert_eq!(desk.ours(1, 5, "/test;1;-1;x"), Some(("start", 1)));
    assert_eq!(desk.ours(2, 5, "/test;1;-1;x"), None);
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.pass(Duration::from_millis(3));
    assert_eq!(desk.ours(3, 5, "/test;1;-1;x"), None);
    desk.told(&[
        (1, "/test;1;1;ok"),
        (2, "/test;1;1;ok"),
        (3, "/test;1;1;ok"),
    ]);
    // The next number is a new INIT.
    assert_eq!(desk.ours(1, 6, "/test;1;-1;x"), Some(("start", 2)));
    assert_eq!(desk.ours(1, 5, "/test;1;-1;x"), None);
    desk.told(&[(1, "/test;2;-1;this INIT was given up by its client")]);
}

#[test]
fn a_repeated_rejected_init_gets_the_same_reply() {
    let mut desk = Desk::new();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.event(1, TaskEvent::Threw { message: "'goal'" });
    desk.ours(1, 5, "/test;1;-1;x");
    desk.ours(1, 6, "$ztl;2;-1;outcome 5");
    let threw = "Controller threw exception: 'goal'";
    desk.told(&[
        (1, &std::format!("/test;3;-1;{threw}")),
        (1, &std::format!("/test;3;-1;{threw}")),
        (1, &std::format!("$ztl;3;-1;{threw}")),
    ]);
}

#[test]
fn outcome_reports_an_init_or_voids_it_for_a_minute() {
    let mut desk = Desk::new();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.ours(2, 6, "$ztl;2;-1;outcome 5");
    desk.told(&[]);
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[(1, "/test;1;1;ok"), (2, "$ztl;1;1;ok")]);
    desk.ours(2, 7, "$ztl;2;-1;outcome 5");
    desk.told(&[(2, "$ztl;1;1;ok")]);
    desk.ours(2, 9, "$ztl;2;-1;outcome 8");
    desk.told(&[(2, "$ztl;2;0;never seen since boot 4711")]);
    assert_eq!(
        desk.ours(2, 8, "/test;1;-1;x"),
        None,
        "it arrives after all"
    );
    desk.told(&[(2, "/test;2;-1;this INIT was given up by its client")]);
}

#[test]
fn outcome_waits_for_an_undecided_init() {
    let mut desk = Desk::new();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.pass(HOLD);
    desk.ours(2, 6, "$ztl;2;-1;outcome 5");
    desk.pass(HOLD);
    let undecided = "Initiated task '1', nobody has taken it yet";
    desk.told(&[
        (1, &std::format!("/test;1;1;{undecided}")),
        (2, &std::format!("$ztl;1;1;{undecided}")),
    ]);
}

#[test]
fn an_answered_init_is_kept_for_a_minute() {
    let mut desk = Desk::new();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.pass(Duration::from_millis(59_990));
    desk.answers.clear();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.told(&[(1, "/test;1;1;ok")]);
    desk.pass(Duration::from_millis(20));
    assert_eq!(
        desk.dispatcher.poll_timeout(),
        None,
        "its record has expired"
    );
}

#[test]
fn an_early_end_replaces_the_reply_if_the_client_asks_for_it() {
    let mut desk = Desk::new();
    desk.with_early_end(1, 5, true, "/test;1;-1;x");
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[]);
    desk.event(1, TaskEvent::Completed { result: "40" });
    desk.told(&[(1, "/test;5;1;40")]);
    // A slower task gets the usual reply, and so does an INIT that does not ask for an early end.
    desk.with_early_end(1, 6, true, "/test;1;-1;x");
    desk.event(2, TaskEvent::Accepted { reply: "ok" });
    desk.pass(Duration::from_millis(3));
    desk.told(&[(1, "/test;1;2;ok")]);
    desk.ours(1, 7, "/test;1;-1;x");
    desk.event(3, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[(1, "/test;1;3;ok")]);
}

#[test]
fn an_init_that_replaces_one_with_a_held_reply_leaves_its_text_intact() {
    let mut desk = Desk::new();
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
        desk.with_early_end(1, number, true, "/test;1;-1;x");
        desk.event(id, TaskEvent::Accepted { reply: "ok" });
        desk.pass(Duration::from_millis(1));
        desk.told(&[]);
        // Sent before the 3 ms have passed.
        desk.ours(2, number + 1, next);
        desk.event(id + 1, TaskEvent::Rejected { reason: "no" });
        let asked = asked.unwrap_or("/test;2;-1;no");
        desk.told(&[(1, &std::format!("/test;1;{id};ok")), (2, asked)]);
        desk.pass(second);
        desk.told(&[]);
    }
}

#[test]
fn a_reused_number_is_rejected_under_the_requested_scope() {
    let mut desk = Desk::new();
    let taken = "2;-1;another INIT has this number";
    desk.ours(1, 5, "/test;1;-1;x");
    for decided in [false, true] {
        if decided {
            desk.event(1, TaskEvent::Accepted { reply: "ok" });
            desk.told(&[(1, "/test;1;1;ok")]);
        }
        assert_eq!(desk.ours(2, 5, "/other;1;-1;x"), None);
        assert_eq!(desk.ours(2, 5, "/test;1;-1;y"), None);
        desk.told(&[
            (2, &std::format!("/other;{taken}")),
            (2, &std::format!("/test;{taken}")),
        ]);
    }
    assert_eq!(desk.ours(2, 5, "/test;1;-1;x"), None);
    desk.told(&[(2, "/test;1;1;ok")]);
}

#[test]
fn a_final_state_without_prior_acceptance_answers_the_init_each_time() {
    let mut desk = Desk::new();
    desk.ours(1, 5, "/test;1;-1;x");
    desk.event(1, TaskEvent::Failed { reason: "stuck" });
    desk.ours(1, 5, "/test;1;-1;x");
    desk.ask(1, "/test;2;1;");
    desk.told(&[
        (1, "/test;1;1;stuck"),
        (1, "/test;1;1;stuck"),
        (1, "/test;3;1;stuck"),
    ]);
}

#[test]
fn an_init_is_rejected_if_its_reply_could_not_be_recorded() {
    let mut desk = Desk::new();
    for client in [1, 2, 3] {
        desk.request_of(client, client, 1, false, "/test;1;-1;x");
    }
    desk.told(&[(3, &std::format!("/test;2;-1;{MANY_CLIENTS}"))]);
}
