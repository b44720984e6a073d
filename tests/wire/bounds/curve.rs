//! Our client and an encrypted server of libzmq.

use std::process::Command;
use std::time::Duration;

use ztl_std::keys::KeyPair;
use ztl_std::{RequestError, State};
use ztl_tests::lab::{Keys, PATIENCE, Process, connect, python, until};

/// Answers an INIT with its own id, and a STATUS with the payload of the last INIT. Says how many requests came.
const SERVER: &str = r#"
import sys, zmq, zmq.auth
kind, keys = sys.argv[1:]
socket = zmq.Context().socket(getattr(zmq, kind))
socket.curve_server = True
socket.curve_publickey, socket.curve_secretkey = zmq.auth.load_certificate(keys)
print("tcp://127.0.0.1:%d" % socket.bind_to_random_port("tcp://127.0.0.1"), flush=True)
last = b""
while True:
    *envelope, body = socket.recv_multipart()
    scope, code, _, payload = body.split(b";", 3)
    print("asked", scope.decode(), code.decode(), flush=True)
    if scope == b"$ztl":
        answer = b"$ztl;2;-1;No controller for scope: $ztl"
    elif code == b"1":
        last = payload
        answer = scope + b";1;7;taken"
    else:
        answer = scope + b";5;7;" + last
    socket.send_multipart(envelope + [answer])
"#;

fn messages_pass_both_ways(kind: &str) {
    let keys = Keys::make(&["robot", "anna"]);
    let file = keys.path("robot.key_secret");
    let mut server = Process::start(Command::new(python()).args(["-c", SERVER, kind, &file]));
    let endpoint = server.next_line(PATIENCE);
    // With a wrong key of the server, there is no connection.
    let wrong = KeyPair::generate().public();
    let stranger = connect(&endpoint).with_timeout(Duration::from_millis(500));
    let stranger = stranger.with_keys(keys.pair("anna"), wrong);
    let answer = stranger.expect("encryption").status(7);
    let nothing = matches!(&answer, Err(error) if error.nothing_was_sent());
    assert!(nothing, "{answer:?}");

    let mut remote = keys.client(&endpoint, "anna", "robot");
    for length in [0, 1, 300, 900_000] {
        let payload = "x".repeat(length);
        let task = remote.trigger_payload(&payload).expect("taken");
        let end = remote.status(&task.id).expect("an answer");
        assert_eq!(end.state, State::Completed);
        assert!(end.text == payload, "{length}: {} bytes", end.text.len());
    }
    // The stranger asked nothing. The last lines may still be on their way.
    let asked = || server.stdout().matches("asked /test").count();
    until("its last lines", PATIENCE, || (asked() >= 8).then_some(()));
    assert_eq!(asked(), 8, "{}", server.stdout());
    // Without keys there is no connection either.
    let answer = connect(&endpoint)
        .with_timeout(Duration::from_millis(500))
        .status(7);
    assert!(
        matches!(&answer, Err(error) if error.nothing_was_sent()),
        "{answer:?}"
    );
    assert!(!matches!(answer, Err(RequestError::UnknownTask { .. })));
}

#[test]
fn our_client_and_libzmqs_encrypted_rep_socket_understand_each_other() {
    messages_pass_both_ways("REP");
}

#[test]
fn our_client_and_libzmqs_encrypted_router_socket_understand_each_other() {
    messages_pass_both_ways("ROUTER");
}
