//! Requests and answers of the original's test server (`docs/protocol.md`, sections 4 and 5), compared between both
//! servers.

use ztl_std::TaskSpec;
use ztl_tests::lab::{SCOPE, Server};

use crate::socket::Socket;

/// The base64 of a task.
fn task(text: &str) -> String {
    let spec = TaskSpec::split(text).expect("three parts");
    let mut buffer = vec![0; spec.encoded_len()];
    spec.encode_into(&mut buffer).expect("it fits").to_owned()
}

/// Starts a task and returns its id if the reply contains the goal in this form.
#[track_caller]
fn init(req: &Socket, payload: &str, quoted: &str) -> u32 {
    let answer = req.ask(format!("{SCOPE};1;-1;{payload}"));
    let id = answer.split(';').nth(2).unwrap_or_default();
    let request = format!("{{'handler': 'test', 'component': 'echo', 'goal': {quoted}}}");
    let expected = format!("{SCOPE};1;{id};Initiated task '{id}' with request: {request}");
    assert_eq!(answer, expected);
    id.parse().expect("an id")
}

/// Sends requests that the original survives, and checks the answers.
fn conforms(server: &Server) {
    let req = Socket::req(&server.endpoint());
    // A task, and its result.
    let id = init(&req, &task("test:echo:hi"), "'hi'");
    let end = req.ask_end(&format!("/test;2;{id};x"));
    assert_eq!(end, format!("/test;5;{id};hi"));
    // Ids are integers as Python reads them.
    assert_eq!(req.ask("/test;2;99;x"), "/test;2;99;Invalid ID '99'");
    assert_eq!(req.ask("/test;2; 1_0 ;x"), "/test;2;10;Invalid ID '10'");
    assert_eq!(req.ask("/test; 2;+0099\t;x"), "/test;2;99;Invalid ID '99'");
    let many = "9".repeat(300);
    assert_eq!(
        req.ask(format!("/test;2;{many};x")),
        format!("/test;2;{many};Invalid ID '{many}'")
    );
    // An ABORT of an ended task, and an undefined code.
    assert_eq!(
        req.ask(format!("/test;3;{id};x")),
        format!("/test;5;{id};False")
    );
    assert_eq!(req.ask("/test;9;1;x"), "/test;2;1;Invalid request");
    // Payloads that are not base64 of UTF-8.
    let thrown = "/test;3;-1;Controller threw exception: ";
    for payload in ["abc", "", "/////w=="] {
        let answer = req.ask(format!("/test;1;-1;{payload}"));
        assert!(answer.starts_with(thrown), "{payload}: {answer}");
    }
    // Characters outside the base64 alphabet are skipped.
    let strewn: Vec<String> = task("test:echo:hi").chars().map(String::from).collect();
    let next = init(&req, &strewn.join("!"), "'hi'");
    assert!(next > id);
    // A missing part, and an unknown handler.
    let thrown = |message: &str| format!("{thrown}{message}");
    assert_eq!(req.ask("/test;1;-1;dGVzdA=="), thrown("'component'"));
    assert_eq!(req.ask("/test;1;-1;dGVzdDplY2hv"), thrown("'goal'"));
    let handler = thrown("No such handler '', try 'test'.");
    assert_eq!(req.ask("/test;1;-1;Ojo="), handler);
    // To an unknown scope: neither code nor id is checked.
    for request in ["/nope;1;-1;x", "/nope;x;y;x", "/nope;2;1;x"] {
        let refused = "/nope;2;-1;No controller for scope: /nope";
        assert_eq!(req.ask(request), refused);
    }
    assert_eq!(req.ask(";1;-1;x"), ";2;-1;No controller for scope: ");
    // Further `;` belong to the payload.
    assert_eq!(
        req.ask(format!("/test;2;{id};a;b;c")),
        format!("/test;5;{id};hi")
    );
    // Goals with a quote and with a line feed.
    init(&req, &task("test:echo:it's"), r#""it's""#);
    init(&req, &task("test:echo:l1\nl2"), r"'l1\nl2'");
    // Several requests in flight from one DEALER.
    let dealer = Socket::dealer(&server.endpoint());
    dealer.send(&["c", "u", "", "/test;2;99;x"]);
    dealer.send(&["c", "v", "", &format!("/test;2;{id};x")]);
    for expected in [
        ["c", "u", "", "/test;2;99;Invalid ID '99'"],
        ["c", "v", "", &format!("/test;5;{id};hi")],
    ] {
        assert_eq!(dealer.receive(), expected.map(|f| f.as_bytes().to_vec()));
    }
    // Any id, because INIT ignores it.
    let answer = req.ask(format!("/test;1;7;{}", task("test:echo:hi")));
    assert!(answer.starts_with("/test;1;"), "{answer}");
}

#[test]
fn the_original_conforms_to_the_table() {
    conforms(&Server::original());
}

#[test]
fn our_task_server_conforms_to_the_table() {
    conforms(&Server::ours());
}
