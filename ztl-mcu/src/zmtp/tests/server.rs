//! The whole device: clients, tasks, components.

use core::time::Duration;

use ztl_core::envelope::{ClientId, Envelope};

use super::{
    BOTH, Client, End, NOW, Pieces, TestServer, connect, frame, greeting, init, ready, request,
    server, text,
};
use crate::Instant;
use crate::zmtp::{Fault, HANDSHAKE, Peer};

const STARTED: &str = "/lab;1;1;Initiated task '1' with request: {'handler': 'desk', 'component': 'motor', 'goal': 'up'}";

fn later(millis: u64) -> Instant {
    NOW + Duration::from_millis(millis)
}

/// Lets the motor take this many steps.
fn steps(server: &mut TestServer, count: usize) {
    for _ in 0..count {
        server.handle_timeout(NOW);
    }
}

#[test]
fn a_task_completes() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    assert_eq!(client.ask(&init("desk:motor:up")), STARTED);
    assert_eq!(client.ask("/lab;2;1;"), "/lab;1;1;None");
    steps(client.server, 1);
    assert_eq!(client.ask("/lab;2;1;"), "/lab;1;1;1 of 3");
    steps(client.server, 2);
    assert_eq!(client.ask("/lab;2;1;"), "/lab;5;1;3 of 3");
    assert_eq!(
        client.ask("/lab;3;1;"),
        "/lab;5;1;False",
        "a final state never changes"
    );
}

#[test]
fn an_abort_is_answered_when_the_task_has_stopped() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.ask(&init("desk:motor:up"));
    assert_eq!(client.ask("/lab;3;1;"), "", "held");
    steps(client.server, 1);
    assert_eq!(text(&client.drain()), "/lab;4;1;True");
    assert_eq!(client.ask("/lab;2;1;"), "/lab;4;1;stopped half way");
}

#[test]
fn an_abort_is_answered_in_time_even_if_the_motor_does_not_stop() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.server.components_mut()[0].stubborn = true;
    client.ask(&init("desk:motor:up"));
    assert_eq!(client.ask("/lab;3;1;"), "");
    let due = later(1500);
    assert!(client.server.poll_timeout(NOW) <= due);
    client.server.handle_timeout(due);
    assert_eq!(text(&client.drain()), "/lab;1;1;aborting");
}

#[test]
fn a_waiting_task_has_no_progress() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.server.components_mut()[0].patient = true;
    client.ask(&init("desk:motor:up"));
    assert!(
        client
            .ask(&init("desk:motor:down"))
            .starts_with("/lab;1;2;")
    );
    steps(client.server, 1);
    assert_eq!(client.ask("/lab;2;2;"), "/lab;1;2;None");
    steps(client.server, 3);
    assert_eq!(client.ask("/lab;2;1;"), "/lab;5;1;3 of 3");
    assert_eq!(client.ask("/lab;2;2;"), "/lab;1;2;1 of 3");
    steps(client.server, 2);
    assert_eq!(client.ask("/lab;2;2;"), "/lab;5;2;3 of 3");
}

#[test]
fn an_impossible_task_is_rejected_with_the_reason() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    for (task, answer) in [
        ("desk:motor:sideways", "/lab;2;-1;motor takes up or down"),
        ("desk:arm:up", "/lab;2;-1;no component 'arm'; it has: motor"),
        (
            "table:motor:up",
            "/lab;2;-1;no device 'table'; this is desk",
        ),
    ] {
        assert_eq!(client.ask(&init(task)), answer);
    }
    client.ask(&init("desk:motor:up"));
    assert_eq!(
        client.ask(&init("desk:motor:down")),
        "/lab;2;-1;busy with another task"
    );
}

/// `docs/protocol.md`, sections 4 and 11.
#[test]
fn each_kind_of_request_is_answered_as_specified() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    for (body, answer) in [
        ("/nope;1;-1;x", "/nope;2;-1;No controller for scope: /nope"),
        ("/lab;9;1;x", "/lab;2;1;Invalid request"),
        ("/lab;2;99;x", "/lab;2;99;Invalid ID '99'"),
        ("/lab;2; 1_0 ;x", "/lab;2;10;Invalid ID '10'"),
        ("/lab;x;1;p", "/lab;2;-1;Invalid request"),
        ("/lab;2;;p", "/lab;2;-1;Invalid request"),
        ("/lab;1", "/lab;2;-1;Unknown protocol"),
        ("", ";2;-1;Unknown protocol"),
        (
            "/lab;1;-1;abc",
            "/lab;3;-1;Controller threw exception: Incorrect padding",
        ),
        (
            "/lab;1;-1;/w==",
            "/lab;3;-1;Controller threw exception: the task is not UTF-8",
        ),
        (
            "/lab;1;-1;YTpi",
            "/lab;3;-1;Controller threw exception: 'goal'",
        ),
        (
            "/lab;1;-1;YQ==",
            "/lab;3;-1;Controller threw exception: 'component'",
        ),
    ] {
        assert_eq!(client.ask(body), answer, "{body}");
    }
    let heard = client.talk(Pieces::Whole, &request(b"/lab;\xFF;1;x"));
    assert_eq!(text(&heard), "/lab;2;-1;Unknown protocol");
    let several = [frame(1, b""), frame(1, b"/lab;2;1;"), frame(0, b"x")].concat();
    let heard = client.talk(Pieces::Whole, &several);
    assert_eq!(text(&heard), ";2;-1;Unknown protocol");
    let heard = client.talk(Pieces::Whole, &request(&[b'x'; 300]));
    assert_eq!(
        text(&heard),
        ";2;-1;the request is too long for this device"
    );
}

#[test]
fn the_reply_to_a_long_goal_is_cut_but_keeps_the_id() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    let goal = "u".repeat(140);
    let answer = client.ask(&init(&std::format!("desk:motor:{goal}")));
    assert!(
        answer.starts_with("/lab;1;1;Initiated task '1' with"),
        "{answer}"
    );
    assert!(answer.ends_with("u…"), "{answer}");
}

#[test]
fn replies_stay_readable_for_scopes_and_ids_of_any_length() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    for length in 0..256 {
        let (scope, id) = ("s".repeat(length), "9".repeat(length));
        for asked in [
            scope.clone(),
            std::format!("{scope};2;1;"),
            std::format!("{scope};;;"),
            std::format!("/lab;2;{id};"),
            std::format!("/lab;3;{id}"),
        ] {
            let answer = client.ask(&asked);
            let fields: std::vec::Vec<_> = answer.splitn(4, ';').collect();
            assert!(
                matches!(fields[..], [_, "2", id, _] if id.parse::<f64>().is_ok()),
                "{asked}: {answer}"
            );
        }
    }
}

#[test]
fn clients_are_served_concurrently_up_to_the_slots() {
    for pieces in BOTH {
        let mut server = server();
        assert_eq!(server.vacant(), Some(Peer(0)));
        connect(&mut server, 0).ask(&init("desk:motor:up"));
        assert_eq!(server.vacant(), Some(Peer(1)));
        let mut second = connect(&mut server, 1);
        let heard = second.talk(pieces, &request(b"/lab;2;1;"));
        assert_eq!(text(&heard), "/lab;1;1;None");
        assert_eq!(server.vacant(), None);
        // No slot: the other clients are not affected.
        server.open(NOW, Peer(2));
        assert_eq!(server.handle_bytes(NOW, Peer(2), b"abc"), 3);
        assert!(server.transmit_buf(Peer(2)).is_empty());
        assert!(!server.is_open(Peer(2)));
        server.close(Peer(0));
        assert_eq!(server.vacant(), Some(Peer(0)));
    }
}

#[test]
fn a_held_reply_never_reaches_the_next_client_in_the_slot() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.ask(&init("desk:motor:up"));
    assert_eq!(client.ask("/lab;3;1;"), "");
    server.close(Peer(0));
    let mut next = connect(&mut server, 0);
    let ask = enveloped(7, 1, "/lab;2;1;wait 1000");
    assert!(next.talk(Pieces::Whole, &ask).is_empty(), "held too");
    steps(next.server, 1);
    // The former client would have received `True`.
    assert_eq!(text(&next.drain()[32..]), "/lab;4;1;stopped half way");
}

#[test]
fn a_request_may_break_off_anywhere() {
    let whole = [
        greeting(),
        ready("REQ"),
        request(init("desk:motor:up").as_bytes()),
    ]
    .concat();
    for cut in 0..whole.len() {
        let mut server = server();
        server.open(NOW, Peer(0));
        server.handle_bytes(NOW, Peer(0), &whole[..cut]);
        server.close(Peer(0));
        assert_eq!(
            connect(&mut server, 0).ask("/lab;2;1;"),
            "/lab;2;1;Invalid ID '1'"
        );
    }
}

#[test]
fn a_thousand_clients_come_and_go() {
    let mut server = server();
    for round in 0..1000 {
        let peer = server.vacant().expect("a slot");
        let mut client = connect(&mut server, peer.0);
        assert_eq!(
            client.ask("/lab;2;1;"),
            "/lab;2;1;Invalid ID '1'",
            "{round}"
        );
        server.close(peer);
    }
}

#[test]
fn an_unfinished_greeting_frees_its_slot() {
    let mut server = server();
    server.open(NOW, Peer(0));
    server.handle_bytes(NOW, Peer(0), &greeting()[..20]);
    assert_eq!(server.poll_timeout(NOW), NOW + HANDSHAKE);
    server.handle_timeout(NOW + HANDSHAKE);
    assert!(!server.is_open(Peer(0)));
    assert_eq!(server.fault(Peer(0)), Some(Fault::Silent));
    assert_eq!(server.vacant(), Some(Peer(0)));
}

/// A request of our own client.
fn enveloped(client: u8, number: u64, body: &str) -> std::vec::Vec<u8> {
    let envelope = Envelope {
        client: ClientId([client; 16]),
        number,
        early_end: false,
    };
    let (first, second) = envelope.frames();
    [
        frame(1, &first),
        frame(1, &second),
        request(body.as_bytes()),
    ]
    .concat()
}

#[test]
fn a_repeated_init_of_our_client_starts_one_task() {
    for pieces in BOTH {
        let mut server = server();
        let mut client = connect(&mut server, 0);
        let ask = enveloped(7, 1, &init("desk:motor:up"));
        let first = client.talk(pieces, &ask);
        let envelope = &ask[..32];
        assert_eq!(&first[..32], envelope);
        assert_eq!(text(&first[32..]), STARTED);
        let again = client.talk(pieces, &ask);
        let again = text(&again[32..]);
        // The stored text is shorter.
        assert!(again.starts_with("/lab;1;1;Initiated task '1'"), "{again}");
        steps(client.server, 3);
        assert_eq!(client.ask("/lab;2;1;"), "/lab;5;1;3 of 3");
        assert_eq!(client.ask("/lab;2;2;"), "/lab;2;2;Invalid ID '2'");
    }
}

#[test]
fn status_of_our_client_waits_for_the_final_state() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.ask(&init("desk:motor:up"));
    let ask = enveloped(7, 1, "/lab;2;1;wait 1000");
    assert!(client.talk(Pieces::Whole, &ask).is_empty());
    steps(client.server, 3);
    assert_eq!(text(&client.drain()[32..]), "/lab;5;1;3 of 3");
    // Other clients are answered meanwhile.
    client.ask(&init("desk:motor:up"));
    assert!(
        client
            .talk(Pieces::Whole, &enveloped(7, 2, "/lab;2;2;wait 1000"))
            .is_empty()
    );
    assert_eq!(connect(&mut server, 1).ask("/lab;2;2;"), "/lab;1;2;None");
    server.handle_timeout(later(1000));
    let mut client = Client {
        server: &mut server,
        peer: Peer(0),
    };
    assert_eq!(text(&client.drain()[32..]), "/lab;1;2;1 of 3");
}

#[test]
fn an_emergency_stop_is_latched() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    client.ask(&init("desk:motor:up"));
    client.server.stop_everything(NOW);
    assert!(client.server.is_stopped());
    assert_eq!(client.ask("/lab;2;1;"), "/lab;4;1;emergency stop");
    assert_eq!(
        client.ask(&init("desk:motor:up")),
        "/lab;2;-1;emergency stop"
    );
    client.server.clear_stop();
    assert!(client.ask(&init("desk:motor:up")).starts_with("/lab;1;3;"));
}

#[test]
fn probe_describes_the_device() {
    let mut server = server();
    let mut client = connect(&mut server, 0);
    let answer = client.ask("$ztl;2;-1;probe");
    assert!(
        answer.contains("boot: 976010564, scopes: {\"/lab\": {}}"),
        "{answer}"
    );
}

#[test]
fn more_clients_than_records_are_served_within_a_minute() {
    let mut server = server();
    let mut asked = std::vec::Vec::<std::vec::Vec<u8>>::new();
    for number in 1..=100 {
        let mut client = connect(&mut server, number % 2);
        client.talk(Pieces::Whole, &enveloped(number, 1, "$ztl;2;-1;probe"));
        let ask = enveloped(number, 2, &init("desk:motor:up"));
        let heard = client.talk(Pieces::Whole, &ask);
        let started = text(&heard[32..]);
        let id = std::format!("/lab;1;{number};Initiated task");
        assert!(started.starts_with(&id), "{started}");
        let wait = std::format!("/lab;2;{number};wait 1000");
        assert!(
            client
                .talk(Pieces::Whole, &enveloped(number, 3, &wait))
                .is_empty()
        );
        steps(client.server, 3);
        let end = std::format!("/lab;5;{number};3 of 3");
        assert_eq!(text(&client.drain()[32..]), end);
        server.close(Peer(number % 2));
        // Repeat the INIT of the second-to-last client, whose record is gone.
        if let [_, _, _, .., again, _] = &asked[..] {
            let mut client = connect(&mut server, 1 - number % 2);
            let heard = client.talk(Pieces::Whole, again);
            let refused = text(&heard[32..]);
            assert!(
                refused.starts_with("/lab;2;-1;too many clients"),
                "{refused}"
            );
        }
        asked.push(ask);
    }
}
