//! A server that remembers the last INIT of two clients, and many come (`docs/protocol.md`, 9.5).

use std::format;
use std::string::ToString as _;

use super::*;

const INIT: &str = "/test;1;-1;x";
const PROBE: &str = "$ztl;2;-1;probe";

impl Lab {
    /// A client begins as all of ours do: it asks who serves, and sends an INIT, its request 2.
    #[track_caller]
    fn begins(&mut self, client: u8, peer: u8) -> u32 {
        self.of(client, peer, 1, false, PROBE);
        let Some(("start", id)) = self.of(client, peer, 2, false, INIT) else {
            panic!("client {client} is refused: {:?}", self.answers);
        };
        self.event(id, TaskEvent::Accepted { reply: "ok" });
        id
    }

    /// It does, and its task completes.
    #[track_caller]
    fn comes_and_goes(&mut self, client: u8, peer: u8) -> u32 {
        let id = self.begins(client, peer);
        let status = format!("/test;2;{id};x");
        self.of(client, peer, 3, false, &status);
        self.event(id, TaskEvent::Completed { result: "done" });
        self.answers.clear();
        id
    }

    #[track_caller]
    fn is_refused(&mut self, client: u8, peer: u8, number: u64, request: &str) {
        self.answers.clear();
        let action = self.of(client, peer, number, false, request);
        assert_eq!(action, None, "{client} {number} {request}");
        let (_, answer) = self.answers.pop().expect("an answer");
        assert!(answer.contains(";2;"), "{answer}");
        assert!(answer.ends_with(MANY_CLIENTS), "{answer}");
    }
}

#[test]
fn any_number_of_clients_come_one_after_the_other() {
    // By STATUS or ABORT each shows that it has the id.
    for request in ["2", "3"] {
        let mut lab = Lab::new();
        for client in 1..=100 {
            let id = lab.begins(client, 0);
            lab.of(client, 0, 3, false, &format!("/test;{request};{id};x"));
            lab.event(id, TaskEvent::Aborted { result: "here" });
        }
    }
}

/// Were it refused, its client would take it that nothing was done.
#[test]
fn an_init_that_comes_again_is_told_of_its_task_while_nobody_knows_that_its_client_was() {
    let mut lab = Lab::new();
    for client in [1, 2] {
        let id = lab.begins(client, 0);
        lab.event(id, TaskEvent::Completed { result: "done" });
    }
    lab.is_refused(3, 1, 2, INIT);
    lab.of(1, 0, 2, false, INIT);
    lab.told(&[(0, "/test;1;1;ok")]);
}

#[test]
fn an_init_that_found_no_room_never_acts_when_it_comes_again_and_there_is_some() {
    let mut lab = Lab::new();
    let (one, _) = (lab.begins(1, 0), lab.begins(2, 1));
    lab.of(3, 2, 1, false, PROBE);
    lab.is_refused(3, 2, 2, INIT);
    lab.of(1, 0, 3, false, &format!("/test;2;{one};x"));
    lab.is_refused(3, 2, 2, INIT);
    // Whoever asks anew is served.
    lab.of(3, 2, 3, false, PROBE);
    assert_eq!(lab.of(3, 2, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn a_refused_task_keeps_no_place() {
    let mut lab = Lab::new();
    for client in 1..=20 {
        lab.of(client, 0, 1, false, PROBE);
        let (_, id) = lab.of(client, 0, 2, false, INIT).expect("room");
        lab.event(id, TaskEvent::Rejected { reason: "busy" });
    }
    assert_eq!(
        lab.answers.last().unwrap(),
        &(0, "/test;2;-1;busy".to_string())
    );
}

#[test]
fn a_task_that_runs_leaves_its_place_when_its_client_has_asked_about_it() {
    let mut lab = Lab::new();
    let (one, _) = (lab.begins(1, 0), lab.begins(2, 1));
    lab.is_refused(3, 2, 2, INIT);
    // Neither another client's question shows it, nor one about another task.
    lab.of(4, 2, 1, false, &format!("/test;2;{one};x"));
    lab.ask(2, &format!("/test;2;{one};x"));
    lab.of(1, 0, 3, false, "/test;2;2;x");
    lab.is_refused(3, 2, 3, INIT);
    lab.of(1, 0, 4, false, &format!("/test;2;{one};x"));
    lab.of(3, 2, 4, false, PROBE);
    lab.answers.clear();
    assert_eq!(lab.of(3, 2, 5, false, INIT), Some(("start", 3)));
    lab.event(3, TaskEvent::Accepted { reply: "ok" });
    lab.told(&[(2, "/test;1;3;ok")]);
    // The other's is still there.
    lab.of(2, 1, 3, false, "$ztl;2;-1;outcome 2");
    lab.told(&[(1, "$ztl;1;2;ok")]);
}

#[test]
fn an_init_that_was_forgotten_for_another_starts_nothing_when_it_comes_again() {
    let mut lab = Lab::new();
    lab.comes_and_goes(1, 0);
    lab.comes_and_goes(2, 0);
    for client in 3..=9 {
        lab.comes_and_goes(client, 0);
        // Over the connection that it had, another, and a further one.
        for peer in [0, 1, 200] {
            lab.is_refused(1, peer, 2, INIT);
        }
        lab.is_refused(1, 1, 4, "$ztl;2;-1;outcome 2");
    }
    // Nor over a connection over which it asks something first.
    lab.of(1, 3, 5, false, PROBE);
    lab.is_refused(1, 3, 2, INIT);

    // A further one of it is new.
    assert_eq!(lab.of(1, 3, 6, false, INIT), Some(("start", 10)));
}

#[test]
fn it_is_refused_for_as_long_as_it_would_have_been_remembered() {
    let mut lab = Lab::new();
    lab.comes_and_goes(1, 0);
    lab.pass(Duration::from_secs(59));
    for client in 2..=4 {
        lab.comes_and_goes(client, 0);
    }
    // The first and the third are forgotten.
    lab.pass(Duration::from_secs(58));
    lab.is_refused(1, 0, 2, INIT);
    lab.is_refused(3, 0, 2, INIT);
    lab.pass(Duration::from_secs(2));
    assert_eq!(lab.of(3, 0, 2, false, INIT), Some(("start", 5)));
}

#[test]
fn an_init_that_never_came_is_known_to_be_new_by_what_its_client_said_before() {
    let mut lab = Lab::new();
    for client in 1..=4 {
        lab.comes_and_goes(client, 0);
    }
    // The INIT after the probe is lost.
    lab.of(5, 1, 1, false, PROBE);
    lab.answers.clear();
    lab.of(5, 2, 3, false, "$ztl;2;-1;outcome 2");
    lab.told(&[(2, "$ztl;2;0;never seen since boot 4711")]);
    // Nobody was heard of that one.
    lab.is_refused(6, 1, 3, "$ztl;2;-1;outcome 2");
}

#[test]
fn what_was_given_up_stays_so_when_the_later_init_is_forgotten() {
    let mut lab = Lab::new();
    // Its INIT 2 is still on its way over connection 0.
    lab.of(1, 0, 1, false, PROBE);
    lab.of(1, 1, 3, false, "$ztl;2;-1;outcome 2");
    lab.of(1, 1, 4, false, PROBE);
    assert_eq!(lab.of(1, 1, 5, false, INIT), Some(("start", 1)));
    lab.event(1, TaskEvent::Completed { result: "done" });
    lab.of(1, 1, 6, false, "/test;2;1;x");
    for client in 2..=4 {
        lab.comes_and_goes(client, 1);
    }
    lab.is_refused(1, 0, 2, INIT);
}

#[test]
fn a_client_that_stays_connected_is_served_however_many_come_and_go_beside_it() {
    let mut lab = Lab::new();
    let stays = lab.comes_and_goes(1, 0);
    assert_eq!(stays, 1);
    for client in 2..=99 {
        lab.comes_and_goes(client, 1);
    }
    // What it said since its INIT is known, so that this is none that was not heard yet.
    lab.is_refused(1, 0, 2, INIT);
    let next = lab.of(1, 0, 4, false, INIT);
    assert_eq!(next, Some(("start", 100)));
}

#[test]
fn who_asks_about_a_task_whose_quick_end_is_waited_for_has_its_answer_first() {
    let mut lab = Lab::new();
    lab.of(1, 0, 2, true, INIT);
    lab.event(1, TaskEvent::Accepted { reply: "ok" });
    lab.told(&[]);
    lab.of(1, 0, 3, false, "/test;2;1;x");
    lab.told(&[(0, "/test;1;1;ok"), (0, "/test;1;1;None")]);
}

#[test]
fn whose_init_was_settled_while_it_was_undecided_waits_for_no_quick_end() {
    let mut lab = Lab::new();
    lab.of(1, 0, 2, true, INIT);
    lab.of(1, 0, 3, true, INIT);
    // Its text is kept by nobody, so it is told at once.
    lab.event(1, TaskEvent::Accepted { reply: "ok" });
    lab.told(&[(0, "/test;1;1;ok")]);
    lab.event(2, TaskEvent::Accepted { reply: "ok" });
    lab.told(&[]);
    lab.event(2, TaskEvent::Completed { result: "done" });
    lab.told(&[(0, "/test;5;2;done")]);
}

#[test]
fn an_undecided_init_keeps_its_place_also_when_its_id_was_told() {
    let mut lab = Lab::new();
    for client in [1, 2] {
        lab.of(client, 0, 2, false, INIT);
        lab.pass(HOLD);
        let id = u32::from(client);
        lab.of(client, 0, 3, false, &format!("/test;2;{id};x"));
    }
    lab.is_refused(3, 0, 2, INIT);
    lab.event(1, TaskEvent::Accepted { reply: "ok" });
    lab.of(3, 0, 3, false, PROBE);
    assert_eq!(lab.of(3, 0, 4, false, INIT), Some(("start", 3)));
}

#[test]
fn of_two_forgotten_inits_the_first_that_comes_again_does_not_let_the_second_pass() {
    let mut lab = Lab::new();
    lab.comes_and_goes(1, 0);
    lab.of(1, 0, 4, false, INIT);
    lab.event(2, TaskEvent::Completed { result: "done" });
    lab.of(1, 0, 5, false, "/test;2;2;x");
    for client in 2..=9 {
        lab.comes_and_goes(client, 0);
    }
    for number in [2, 4, 2, 4] {
        lab.is_refused(1, 1, number, INIT);
    }
}

#[test]
fn that_a_client_had_one_answer_says_nothing_of_the_next() {
    let mut lab = Lab::new();
    // Its own next, and that of whoever has its place now.
    for number in [2, 4] {
        let Some((_, id)) = lab.of(1, 0, number, false, INIT) else {
            panic!("it is refused");
        };
        lab.event(id, TaskEvent::Accepted { reply: "ok" });
        if number == 2 {
            lab.of(1, 0, 3, false, &format!("/test;2;{id};x"));
            lab.event(id, TaskEvent::Completed { result: "done" });
        }
    }
    lab.comes_and_goes(2, 1);
    lab.begins(3, 1);
    lab.is_refused(4, 1, 2, INIT);
}
