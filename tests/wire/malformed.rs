//! Messages that silence the original, or that no client may send: each is answered exactly once, and the next client is
//! served.

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{ABORTED, COMPLETED, OriginalClient, PATIENCE, SCOPE, Server, port_of, ztl};

use crate::socket::{Socket, assert_serves, in_process};

/// Bodies that no client may send, and the answer that each must get.
fn malformed() -> Vec<(Vec<Vec<u8>>, String)> {
    let one = |body: &[u8]| vec![body.to_vec()];
    let unknown = |scope: &str| format!("{scope};2;-1;Unknown protocol");
    let invalid = || format!("{SCOPE};2;-1;Invalid request");
    let nines = "9".repeat(5000);
    vec![
        // Not UTF-8, in the payload and in the scope.
        (one(b"/test;1;-1;\xff\xfe"), unknown(SCOPE)),
        (one(b"/te\xffst;1;-1;x"), unknown("")),
        (one(b"\xff\xfe\xfd"), unknown("")),
        (one(b"/test;1;-1;\xed\xa0\x80"), unknown(SCOPE)),
        // Too few fields.
        (one(b""), unknown("")),
        (one(b"/test"), unknown(SCOPE)),
        (one(b"/test;1"), unknown(SCOPE)),
        (one(b"/test;1;-1"), unknown(SCOPE)),
        (one(b"hello"), unknown("hello")),
        (one(b"\0\0\0\0"), unknown("\0\0\0\0")),
        // Invalid numbers.
        (one(b"/test;x;1;p"), invalid()),
        (one(b"/test;2;x;p"), invalid()),
        (one(b"/test;2;;p"), invalid()),
        (one(b"/test;;1;p"), invalid()),
        (one(b"/test;1.0;1;p"), invalid()),
        (one(b"/test;2;1e3;p"), invalid()),
        (one(b"/test;2;0x1;p"), invalid()),
        (one(b"/test;2;- 1;p"), invalid()),
        (one(b"/test;2;1__0;p"), invalid()),
        (one(format!("/test;2;{nines};p").as_bytes()), invalid()),
        (one(format!("/test;{nines};1;p").as_bytes()), invalid()),
        // Invalid codes.
        (one(b"/test;9;1;x"), format!("{SCOPE};2;1;Invalid request")),
        (one(b"/test;0;7;x"), format!("{SCOPE};2;7;Invalid request")),
        (
            one(b"/test;-1;-7;x"),
            format!("{SCOPE};2;-7;Invalid request"),
        ),
        (
            one(b"/test;18446744073709551617;1;x"),
            format!("{SCOPE};2;1;Invalid request"),
        ),
        // Several frames: never one request each.
        (
            vec![b"/test;2;99;x".to_vec(), b"/test;2;99;x".to_vec()],
            unknown(""),
        ),
        (vec![vec![], b"/test;2;99;x".to_vec()], unknown("")),
        (vec![b"/test;2;99;x".to_vec(), vec![]], unknown("")),
        (vec![vec![]; 100], unknown("")),
    ]
}

fn answers_what_is_malformed(endpoint: &str) {
    for (frames, expected) in malformed() {
        let what = format!(
            "{:?}",
            frames
                .iter()
                .map(|f| String::from_utf8_lossy(f))
                .collect::<Vec<_>>()
        );
        let what = &what[..what.floor_char_boundary(80)];
        let req = Socket::req(endpoint);
        req.send(&frames);
        let answer = [expected.clone().into_bytes()];
        assert_eq!(req.receive(), answer, "{what}");
        // The same client is served again, and so is another one.
        let good = req.ask("/test;2;99;x");
        assert_eq!(good, "/test;2;99;Invalid ID '99'", "after {what}");
        assert_serves(endpoint, what);

        let dealer = Socket::dealer(endpoint);
        let envelope = [b"client".to_vec(), vec![0, 1, 255], vec![]];
        dealer.send(&[&envelope[..], &frames].concat());
        let answer = [&envelope[..], &answer].concat();
        assert_eq!(dealer.receive(), answer, "{what}");
    }
}

#[test]
fn a_task_server_answers_malformed_messages_and_continues() {
    let server = in_process();
    answers_what_is_malformed(server.endpoint());
    let mut client = OriginalClient::connect(port_of(server.endpoint()), SCOPE);
    let id = client.start("any", "echo", "hi");
    assert_eq!(client.end(id), (COMPLETED, "hi"));
}

#[test]
fn a_gateway_answers_malformed_messages_and_continues() {
    let gateway = Server::simulated();
    let mut client = gateway.original_client();
    let id = client.start("gripper", "finger", "100");
    answers_what_is_malformed(&gateway.endpoint());
    assert_eq!(client.end(id), (COMPLETED, "100.0"));

    // A payload that no controller can read.
    let req = Socket::req(&gateway.endpoint());
    for payload in [
        "abc",
        "",
        "Z3JpcHBlcg==",
        "Z3JpcHBlcjpmaW5nZXI=",
        "/////w==",
    ] {
        let answer = req.ask(format!("{SCOPE};1;-1;{payload}"));
        let thrown = format!("{SCOPE};3;-1;Controller threw exception: ");
        assert!(answer.starts_with(&thrown), "{payload}: {answer}");
    }
    // It takes 20 s then, so it still runs when it is aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    let id = client.start("gripper", "finger", "0");
    assert_eq!(client.stop(id), ABORTED);
}

#[test]
fn only_messages_without_a_delimiter_are_dropped() {
    for endpoint in [in_process_endpoint(), gateway_endpoint()] {
        let dealer = Socket::dealer(&endpoint.0);
        for _ in 0..3 {
            dealer.send(&["/test;2;98;x"]);
            dealer.send(&["envelope", "/test;2;98;x"]);
            dealer.send(&["envelope", "", "/test;2;99;x"]);
            // The first reply is for the complete request.
            let answer = dealer.receive();
            let expected = ["envelope", "", "/test;2;99;Invalid ID '99'"];
            assert_eq!(answer, expected.map(|frame| frame.as_bytes().to_vec()));
        }
        // A delimiter and nothing after it is a request without a body.
        dealer.send(&["envelope", ""]);
        let answer = dealer.receive();
        assert_eq!(answer.last().unwrap(), b";2;-1;Unknown protocol");
        assert_serves(&endpoint.0, "messages without a delimiter");
    }
}

#[test]
fn junk_and_internal_work_do_not_flood_the_debug_log() {
    let words = "gateway -p 0 -d gripper=sim:gripper --log debug -s";
    let gateway = Server::start(ztl().args(words.split(' ')).arg(SCOPE));
    gateway.wait_ready("gripper");
    let mut client = gateway.original_client();
    let id = client.start("gripper", "finger", "20");
    assert_eq!(client.end(id), (COMPLETED, "20.0"));
    let dropped = || {
        let said = gateway.process.stderr();
        said.matches("dropped a message").count()
    };
    assert_eq!(dropped(), 0, "{}", gateway.process.stderr());
    let dealer = Socket::dealer(&gateway.endpoint());
    for _ in 0..500 {
        dealer.send(&["junk"]);
    }
    dealer.send(&["", "/test;2;99;x"]);
    dealer.receive();
    gateway
        .process
        .wait_for("dropped a message without a delimiter");
    let dropped = dropped();
    // A line in half a minute.
    assert!(dropped < 5, "{dropped}");
}

/// An address, and the server behind it, which runs until it is dropped.
type Endpoint = (String, Box<dyn std::any::Any>);

fn in_process_endpoint() -> Endpoint {
    let server = in_process();
    (server.endpoint().to_owned(), Box::new(server))
}

fn gateway_endpoint() -> Endpoint {
    let server = Server::simulated();
    (server.endpoint(), Box::new(server))
}

#[test]
fn a_long_goal_is_returned_whole_and_a_longer_one_affects_nobody() {
    let server = in_process();
    let remote = RemoteTask::connect(server.endpoint(), SCOPE).expect("an address");
    let mut remote = remote.with_timeout(PATIENCE);
    let goal = "long ".repeat(100_000);
    let id = remote.trigger("any", "echo", &goal).expect("taken").id;
    let end = remote.wait(id, Some(PATIENCE)).expect("its end");
    assert!(end.state == State::Completed && end.text == goal);

    let req = Socket::req(server.endpoint());
    req.send(&[vec![b'x'; 2 << 20]]);
    req.assert_silent("a message of 2 MiB");
    assert_serves(server.endpoint(), "a message of 2 MiB");
}
