//! The table of the wire specification, section 11.

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

/// The table of the wire specification, section 11, as far as the original survives it.
fn conforms(server: &Server) {
    let req = Socket::req(&server.endpoint());
    // 1, 2
    let id = init(&req, &task("test:echo:hi"), "'hi'");
    let end = req.ask_end(&format!("/test;2;{id};x"));
    assert_eq!(end, format!("/test;5;{id};hi"));
    // 3, 4
    assert_eq!(req.ask("/test;2;99;x"), "/test;2;99;Invalid ID '99'");
    assert_eq!(req.ask("/test;2; 1_0 ;x"), "/test;2;10;Invalid ID '10'");
    assert_eq!(req.ask("/test; 2;+0099\t;x"), "/test;2;99;Invalid ID '99'");
    let many = "9".repeat(300);
    assert_eq!(
        req.ask(format!("/test;2;{many};x")),
        format!("/test;2;{many};Invalid ID '{many}'")
    );
    // 5, 6
    assert_eq!(
        req.ask(format!("/test;3;{id};x")),
        format!("/test;5;{id};False")
    );
    assert_eq!(req.ask("/test;9;1;x"), "/test;2;1;Invalid request");
    // 7
    let thrown = "/test;3;-1;Controller threw exception: ";
    for payload in ["abc", "", "/////w=="] {
        let answer = req.ask(format!("/test;1;-1;{payload}"));
        assert!(answer.starts_with(thrown), "{payload}: {answer}");
    }
    // 8
    let strewn: Vec<String> = task("test:echo:hi").chars().map(String::from).collect();
    let next = init(&req, &strewn.join("!"), "'hi'");
    assert!(next > id);
    // 9, 10
    let thrown = |message: &str| format!("{thrown}{message}");
    assert_eq!(req.ask("/test;1;-1;dGVzdA=="), thrown("'component'"));
    assert_eq!(req.ask("/test;1;-1;dGVzdDplY2hv"), thrown("'goal'"));
    let handler = thrown("No such handler '', try 'test'.");
    assert_eq!(req.ask("/test;1;-1;Ojo="), handler);
    // 11: neither code nor id is checked.
    for request in ["/nope;1;-1;x", "/nope;x;y;x", "/nope;2;1;x"] {
        let refused = "/nope;2;-1;No controller for scope: /nope";
        assert_eq!(req.ask(request), refused);
    }
    assert_eq!(req.ask(";1;-1;x"), ";2;-1;No controller for scope: ");
    // 12
    assert_eq!(
        req.ask(format!("/test;2;{id};a;b;c")),
        format!("/test;5;{id};hi")
    );
    // 13, 14
    init(&req, &task("test:echo:it's"), r#""it's""#);
    init(&req, &task("test:echo:l1\nl2"), r"'l1\nl2'");
    // 16
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
