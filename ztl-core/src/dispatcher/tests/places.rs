//! A server that stores the last INIT of two clients and serves many (`docs/protocol.md`, 9.5).

use std::format;
use std::string::ToString as _;

use super::*;

const INIT: &str = "/test;1;-1;x";
const PROBE: &str = "$ztl;2;-1;probe";

impl Desk {
    /// Starts as our clients do: request 1 is a probe, request 2 an INIT.
    #[track_caller]
    fn start(&mut self, client: u8, peer: u8) -> u32 {
        self.request_of(client, peer, 1, false, PROBE);
        let Some(("start", id)) = self.request_of(client, peer, 2, false, INIT) else {
            panic!("client {client} is rejected: {:?}", self.answers);
        };
        self.event(id, TaskEvent::Accepted { reply: "ok" });
        id
    }

    /// Starts a task, asks about it and lets it complete.
    #[track_caller]
    fn start_and_complete(&mut self, client: u8, peer: u8) -> u32 {
        let id = self.start(client, peer);
        let status = format!("/test;2;{id};x");
        self.request_of(client, peer, 3, false, &status);
        self.event(id, TaskEvent::Completed { result: "done" });
        self.answers.clear();
        id
    }

    #[track_caller]
    fn expect_rejected(&mut self, client: u8, peer: u8, number: u64, request: &str) {
        self.answers.clear();
        let action = self.request_of(client, peer, number, false, request);
        assert_eq!(action, None, "{client} {number} {request}");
        let (_, answer) = self.answers.pop().expect("an answer");
        assert!(answer.contains(";2;"), "{answer}");
        assert!(answer.ends_with(MANY_CLIENTS), "{answer}");
    }
}

#[test]
fn any_number_of_clients_are_served_in_turn() {
    // Either request shows that the client has the id.
    for request in ["2", "3"] {
        let mut desk = Desk::new();
        for client in 1..=100 {
            let id = desk.start(client, 0);
            desk.request_of(client, 0, 3, false, &format!("/test;{request};{id};x"));
            desk.event(id, TaskEvent::Aborted { result: "here" });
        }
    }
}

/// A rejection would tell the client that nothing was done.
#[test]
fn a_repeated_init_gets_its_task_while_its_client_has_not_shown_that_it_knows() {
    let mut desk = Desk::new();
    for client in [1, 2] {
        let id = desk.start(client, 0);
        desk.event(id, TaskEvent::Completed { result: "done" });
    }
    desk.expect_rejected(3, 1, 2, INIT);
    desk.request_of(1, 0, 2, false, INIT);
    desk.told(&[(0, "/test;1;1;ok")]);
}

#[test]
fn a_repeated_init_that_found_no_room_starts_nothing_once_there_is_room() {
    let mut desk = Desk::new();
    let (one, _) = (desk.start(1, 0), desk.start(2, 1));
    desk.request_of(3, 2, 1, false, PROBE);
    desk.expect_rejected(3, 2, 2, INIT);
    desk.request_of(1, 0, 3, false, &format!("/test;2;{one};x"));
    desk.expect_rejected(3, 2, 2, INIT);
    // A new number is served.
    desk.request_of(3, 2, 3, false, PROBE);
    assert_eq!(desk.request_of(3, 2, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn a_rejected_task_occupies_no_record() {
    let mut desk = Desk::new();
    for client in 1..=20 {
        desk.request_of(client, 0, 1, false, PROBE);
        let (_, id) = desk.request_of(client, 0, 2, false, INIT).expect("room");
        desk.event(id, TaskEvent::Rejected { reason: "busy" });
    }
    assert_eq!(
        desk.answers.last().unwrap(),
        &(0, "/test;2;-1;busy".to_string())
    );
}

#[test]
fn the_record_of_a_running_task_is_evictable_once_its_client_has_asked_about_it() {
    let mut desk = Desk::new();
    let (one, _) = (desk.start(1, 0), desk.start(2, 1));
    desk.expect_rejected(3, 2, 2, INIT);
    // Requests of another client or about another task do not count.
    desk.request_of(4, 2, 1, false, &format!("/test;2;{one};x"));
    desk.ask(2, &format!("/test;2;{one};x"));
    desk.request_of(1, 0, 3, false, "/test;2;2;x");
    desk.expect_rejected(3, 2, 3, INIT);
    desk.request_of(1, 0, 4, false, &format!("/test;2;{one};x"));
    desk.request_of(3, 2, 4, false, PROBE);
    desk.answers.clear();
    assert_eq!(desk.request_of(3, 2, 5, false, INIT), Some(("start", 3)));
    desk.event(3, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[(2, "/test;1;3;ok")]);
    // The other client's record is still there.
    desk.request_of(2, 1, 3, false, "$ztl;2;-1;outcome 2");
    desk.told(&[(1, "$ztl;1;2;ok")]);
}

#[test]
fn a_repeated_init_with_an_evicted_record_starts_nothing() {
    let mut desk = Desk::new();
    desk.start_and_complete(1, 0);
    desk.start_and_complete(2, 0);
    for client in 3..=9 {
        desk.start_and_complete(client, 0);
        // Over its former connection, another one, and an unused one.
        for peer in [0, 1, 200] {
            desk.expect_rejected(1, peer, 2, INIT);
        }
        desk.expect_rejected(1, 1, 4, "$ztl;2;-1;outcome 2");
    }
    // Nor over a connection that it used for a request before.
    desk.request_of(1, 3, 5, false, PROBE);
    desk.expect_rejected(1, 3, 2, INIT);

    // A higher number is new.
    assert_eq!(desk.request_of(1, 3, 6, false, INIT), Some(("start", 10)));
}

#[test]
fn an_evicted_init_is_rejected_for_as_long_as_its_record_would_have_lived() {
    let mut desk = Desk::new();
    desk.start_and_complete(1, 0);
    desk.pass(Duration::from_secs(59));
    for client in 2..=4 {
        desk.start_and_complete(client, 0);
    }
    // The records of the first and third client are evicted.
    desk.pass(Duration::from_secs(58));
    desk.expect_rejected(1, 0, 2, INIT);
    desk.expect_rejected(3, 0, 2, INIT);
    desk.pass(Duration::from_secs(2));
    assert_eq!(desk.request_of(3, 0, 2, false, INIT), Some(("start", 5)));
}

#[test]
fn an_init_that_never_arrived_is_new_if_its_client_was_heard_before() {
    let mut desk = Desk::new();
    for client in 1..=4 {
        desk.start_and_complete(client, 0);
    }
    // The INIT after the probe is lost.
    desk.request_of(5, 1, 1, false, PROBE);
    desk.answers.clear();
    desk.request_of(5, 2, 3, false, "$ztl;2;-1;outcome 2");
    desk.told(&[(2, "$ztl;2;0;never seen since boot 4711")]);
    // Client 6 has not sent anything before.
    desk.expect_rejected(6, 1, 3, "$ztl;2;-1;outcome 2");
}

#[test]
fn a_voided_init_stays_void_when_the_later_record_is_evicted() {
    let mut desk = Desk::new();
    // INIT 2 is still on its way over connection 0.
    desk.request_of(1, 0, 1, false, PROBE);
    desk.request_of(1, 1, 3, false, "$ztl;2;-1;outcome 2");
    desk.request_of(1, 1, 4, false, PROBE);
    assert_eq!(desk.request_of(1, 1, 5, false, INIT), Some(("start", 1)));
    desk.event(1, TaskEvent::Completed { result: "done" });
    desk.request_of(1, 1, 6, false, "/test;2;1;x");
    for client in 2..=4 {
        desk.start_and_complete(client, 1);
    }
    desk.expect_rejected(1, 0, 2, INIT);
}

#[test]
fn a_client_that_stays_connected_is_served_while_many_others_come_and_go() {
    let mut desk = Desk::new();
    let stays = desk.start_and_complete(1, 0);
    assert_eq!(stays, 1);
    for client in 2..=99 {
        desk.start_and_complete(client, 1);
    }
    // The client has sent requests since its INIT, so this number is not new.
    desk.expect_rejected(1, 0, 2, INIT);
    let next = desk.request_of(1, 0, 4, false, INIT);
    assert_eq!(next, Some(("start", 100)));
}

#[test]
fn status_releases_the_reply_that_waits_for_an_early_end() {
    let mut desk = Desk::new();
    desk.request_of(1, 0, 2, true, INIT);
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[]);
    desk.request_of(1, 0, 3, false, "/test;2;1;x");
    desk.told(&[(0, "/test;1;1;ok"), (0, "/test;1;1;None")]);
}

#[test]
fn an_undecided_init_that_was_replaced_waits_for_no_early_end() {
    let mut desk = Desk::new();
    desk.request_of(1, 0, 2, true, INIT);
    desk.request_of(1, 0, 3, true, INIT);
    // Its record was replaced, so the reply cannot wait.
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[(0, "/test;1;1;ok")]);
    desk.event(2, TaskEvent::Accepted { reply: "ok" });
    desk.told(&[]);
    desk.event(2, TaskEvent::Completed { result: "done" });
    desk.told(&[(0, "/test;5;2;done")]);
}

#[test]
fn the_record_of_an_undecided_init_is_kept_even_if_its_id_is_known() {
    let mut desk = Desk::new();
    for client in [1, 2] {
        desk.request_of(client, 0, 2, false, INIT);
        desk.pass(HOLD);
        let id = u32::from(client);
        desk.request_of(client, 0, 3, false, &format!("/test;2;{id};x"));
    }
    desk.expect_rejected(3, 0, 2, INIT);
    desk.event(1, TaskEvent::Accepted { reply: "ok" });
    desk.request_of(3, 0, 3, false, PROBE);
    assert_eq!(desk.request_of(3, 0, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn repeating_one_evicted_init_does_not_admit_another() {
    let mut desk = Desk::new();
    desk.start_and_complete(1, 0);
    desk.request_of(1, 0, 4, false, INIT);
    desk.event(2, TaskEvent::Completed { result: "done" });
    desk.request_of(1, 0, 5, false, "/test;2;2;x");
    for client in 2..=9 {
        desk.start_and_complete(client, 0);
    }
    for number in [2, 4, 2, 4] {
        desk.expect_rejected(1, 1, number, INIT);
    }
}

#[test]
fn a_reply_received_earlier_does_not_make_the_next_record_evictable() {
    let mut desk = Desk::new();
    // The next INIT of the same client, and of another client that reuses the record.
    for number in [2, 4] {
        let Some((_, id)) = desk.request_of(1, 0, number, false, INIT) else {
            panic!("it is rejected");
        };
        desk.event(id, TaskEvent::Accepted { reply: "ok" });
        if number == 2 {
            desk.request_of(1, 0, 3, false, &format!("/test;2;{id};x"));
            desk.event(id, TaskEvent::Completed { result: "done" });
        }
    }
    desk.start_and_complete(2, 1);
    desk.start(3, 1);
    desk.expect_rejected(4, 1, 2, INIT);
}
