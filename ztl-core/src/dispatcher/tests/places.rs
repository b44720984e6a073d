//! A server that stores the last INIT of two clients and serves many (`docs/protocol.md`, 9.5).

use std::format;
use std::string::ToString as _;

use super::*;

const INIT: &str = "/test;1;-1;x";
const PROBE: &str = "$ztl;2;-1;probe";

impl TestServer {
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
        let mut server = TestServer::new();
        for client in 1..=100 {
            let id = server.start(client, 0);
            server.request_of(client, 0, 3, false, &format!("/test;{request};{id};x"));
            server.event(id, TaskEvent::Aborted { result: "here" });
        }
    }
}

/// A rejection would tell the client that nothing was done.
#[test]
fn a_repeated_init_gets_its_task_while_its_client_has_not_shown_that_it_knows() {
    let mut server = TestServer::new();
    for client in [1, 2] {
        let id = server.start(client, 0);
        server.event(id, TaskEvent::Completed { result: "done" });
    }
    server.expect_rejected(3, 1, 2, INIT);
    server.request_of(1, 0, 2, false, INIT);
    server.told(&[(0, "/test;1;1;ok")]);
}

#[test]
fn a_repeated_init_that_found_no_room_starts_nothing_once_there_is_room() {
    let mut server = TestServer::new();
    let (one, _) = (server.start(1, 0), server.start(2, 1));
    server.request_of(3, 2, 1, false, PROBE);
    server.expect_rejected(3, 2, 2, INIT);
    server.request_of(1, 0, 3, false, &format!("/test;2;{one};x"));
    server.expect_rejected(3, 2, 2, INIT);
    // A new number is served.
    server.request_of(3, 2, 3, false, PROBE);
    assert_eq!(server.request_of(3, 2, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn a_rejected_task_occupies_no_record() {
    let mut server = TestServer::new();
    for client in 1..=20 {
        server.request_of(client, 0, 1, false, PROBE);
        let (_, id) = server.request_of(client, 0, 2, false, INIT).expect("room");
        server.event(id, TaskEvent::Rejected { reason: "busy" });
    }
    assert_eq!(
        server.answers.last().unwrap(),
        &(0, "/test;2;-1;busy".to_string())
    );
}

#[test]
fn the_record_of_a_running_task_is_evictable_once_its_client_has_asked_about_it() {
    let mut server = TestServer::new();
    let (one, _) = (server.start(1, 0), server.start(2, 1));
    server.expect_rejected(3, 2, 2, INIT);
    // Requests of another client or about another task do not count.
    server.request_of(4, 2, 1, false, &format!("/test;2;{one};x"));
    server.ask(2, &format!("/test;2;{one};x"));
    server.request_of(1, 0, 3, false, "/test;2;2;x");
    server.expect_rejected(3, 2, 3, INIT);
    server.request_of(1, 0, 4, false, &format!("/test;2;{one};x"));
    server.request_of(3, 2, 4, false, PROBE);
    server.answers.clear();
    assert_eq!(server.request_of(3, 2, 5, false, INIT), Some(("start", 3)));
    server.event(3, TaskEvent::Accepted { reply: "ok" });
    server.told(&[(2, "/test;1;3;ok")]);
    // The other client's record is still there.
    server.request_of(2, 1, 3, false, "$ztl;2;-1;outcome 2");
    server.told(&[(1, "$ztl;1;2;ok")]);
}

#[test]
fn a_repeated_init_with_an_evicted_record_starts_nothing() {
    let mut server = TestServer::new();
    server.start_and_complete(1, 0);
    server.start_and_complete(2, 0);
    for client in 3..=9 {
        server.start_and_complete(client, 0);
        // Over its former connection, another one, and an unused one.
        for peer in [0, 1, 200] {
            server.expect_rejected(1, peer, 2, INIT);
        }
        server.expect_rejected(1, 1, 4, "$ztl;2;-1;outcome 2");
    }
    // Nor over a connection that it used for a request before.
    server.request_of(1, 3, 5, false, PROBE);
    server.expect_rejected(1, 3, 2, INIT);

    // A higher number is new.
    assert_eq!(server.request_of(1, 3, 6, false, INIT), Some(("start", 10)));
}

#[test]
fn an_evicted_init_is_rejected_for_as_long_as_its_record_would_have_lived() {
    let mut server = TestServer::new();
    server.start_and_complete(1, 0);
    server.pass(Duration::from_secs(59));
    for client in 2..=4 {
        server.start_and_complete(client, 0);
    }
    // The records of the first and third client are evicted.
    server.pass(Duration::from_secs(58));
    server.expect_rejected(1, 0, 2, INIT);
    server.expect_rejected(3, 0, 2, INIT);
    server.pass(Duration::from_secs(2));
    assert_eq!(server.request_of(3, 0, 2, false, INIT), Some(("start", 5)));
}

#[test]
fn an_init_that_never_arrived_is_new_if_its_client_was_heard_before() {
    let mut server = TestServer::new();
    for client in 1..=4 {
        server.start_and_complete(client, 0);
    }
    // The INIT after the probe is lost.
    server.request_of(5, 1, 1, false, PROBE);
    server.answers.clear();
    server.request_of(5, 2, 3, false, "$ztl;2;-1;outcome 2");
    server.told(&[(2, "$ztl;2;0;never seen since boot 4711")]);
    // Client 6 has not sent anything before.
    server.expect_rejected(6, 1, 3, "$ztl;2;-1;outcome 2");
}

#[test]
fn a_voided_init_stays_void_when_the_later_record_is_evicted() {
    let mut server = TestServer::new();
    // INIT 2 is still on its way over connection 0.
    server.request_of(1, 0, 1, false, PROBE);
    server.request_of(1, 1, 3, false, "$ztl;2;-1;outcome 2");
    server.request_of(1, 1, 4, false, PROBE);
    assert_eq!(server.request_of(1, 1, 5, false, INIT), Some(("start", 1)));
    server.event(1, TaskEvent::Completed { result: "done" });
    server.request_of(1, 1, 6, false, "/test;2;1;x");
    for client in 2..=4 {
        server.start_and_complete(client, 1);
    }
    server.expect_rejected(1, 0, 2, INIT);
}

#[test]
fn a_client_that_stays_connected_is_served_while_many_others_come_and_go() {
    let mut server = TestServer::new();
    let stays = server.start_and_complete(1, 0);
    assert_eq!(stays, 1);
    for client in 2..=99 {
        server.start_and_complete(client, 1);
    }
    // The client has sent requests since its INIT, so this number is not new.
    server.expect_rejected(1, 0, 2, INIT);
    let next = server.request_of(1, 0, 4, false, INIT);
    assert_eq!(next, Some(("start", 100)));
}

#[test]
fn status_releases_the_reply_that_waits_for_an_early_end() {
    let mut server = TestServer::new();
    server.request_of(1, 0, 2, true, INIT);
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.told(&[]);
    server.request_of(1, 0, 3, false, "/test;2;1;x");
    server.told(&[(0, "/test;1;1;ok"), (0, "/test;1;1;None")]);
}

#[test]
fn an_undecided_init_that_was_replaced_waits_for_no_early_end() {
    let mut server = TestServer::new();
    server.request_of(1, 0, 2, true, INIT);
    server.request_of(1, 0, 3, true, INIT);
    // Its record was replaced, so the reply cannot wait.
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.told(&[(0, "/test;1;1;ok")]);
    server.event(2, TaskEvent::Accepted { reply: "ok" });
    server.told(&[]);
    server.event(2, TaskEvent::Completed { result: "done" });
    server.told(&[(0, "/test;5;2;done")]);
}

#[test]
fn the_record_of_an_undecided_init_is_kept_even_if_its_id_is_known() {
    let mut server = TestServer::new();
    for client in [1, 2] {
        server.request_of(client, 0, 2, false, INIT);
        server.pass(HOLD);
        let id = u32::from(client);
        server.request_of(client, 0, 3, false, &format!("/test;2;{id};x"));
    }
    server.expect_rejected(3, 0, 2, INIT);
    server.event(1, TaskEvent::Accepted { reply: "ok" });
    server.request_of(3, 0, 3, false, PROBE);
    assert_eq!(server.request_of(3, 0, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn repeating_one_evicted_init_does_not_admit_another() {
    let mut server = TestServer::new();
    server.start_and_complete(1, 0);
    server.request_of(1, 0, 4, false, INIT);
    server.event(2, TaskEvent::Completed { result: "done" });
    server.request_of(1, 0, 5, false, "/test;2;2;x");
    for client in 2..=9 {
        server.start_and_complete(client, 0);
    }
    for number in [2, 4, 2, 4] {
        server.expect_rejected(1, 1, number, INIT);
    }
}

#[test]
fn a_reply_received_earlier_does_not_make_the_next_record_evictable() {
    let mut server = TestServer::new();
    // The next INIT of the same client, and of another client that reuses the record.
    for number in [2, 4] {
        let Some((_, id)) = server.request_of(1, 0, number, false, INIT) else {
            panic!("it is rejected");
        };
        server.event(id, TaskEvent::Accepted { reply: "ok" });
        if number == 2 {
            server.request_of(1, 0, 3, false, &format!("/test;2;{id};x"));
            server.event(id, TaskEvent::Completed { result: "done" });
        }
    }
    server.start_and_complete(2, 1);
    server.start(3, 1);
    server.expect_rejected(4, 1, 2, INIT);
}
