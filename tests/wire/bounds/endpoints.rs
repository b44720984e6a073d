//! Sockets in the file system, and IPv6.

use std::net::TcpListener;
use std::os::unix::net::{UnixListener, UnixStream};

use ztl_std::{
    BindError, ExecutableTask, State, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer,
};
use ztl_tests::lab::{LIMIT, PATIENCE, SCOPE, Scratch, connect, until};

use crate::socket::{Socket, assert_serves};

/// Completes each task with its goal.
struct Echo;

impl TaskController for Echo {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let goal = request.goal.clone();
        Ok(Box::new(move |_: &TaskContext| Ok::<_, TaskError>(goal)))
    }
}

/// Both libraries' clients get an answer at this address.
#[track_caller]
fn serves(server: TaskServer) {
    let mut server = server;
    server.register(SCOPE, Echo);
    let server = server.spawn().expect("a thread");
    let mut remote = connect(server.endpoint());
    for goal in ["hi", &"long ".repeat(30_000)] {
        let end = remote.run("h", "c", goal, LIMIT).expect("its end");
        assert_eq!((end.state, end.text.as_str()), (State::Completed, goal));
    }
    let dealer = Socket::prepared(zmq::DEALER, server.endpoint(), PATIENCE, |dealer| {
        dealer.set_ipv6(true).unwrap();
    });
    dealer.send(&["", "/test;2;99;x"]);
    assert_eq!(dealer.receive()[1], b"/test;2;99;Invalid ID '99'");
    assert_serves(server.endpoint(), "both");
}

#[test]
fn a_socket_in_the_file_system_is_served_and_removed() {
    let scratch = Scratch::new();
    let path = scratch.path("robot.sock");
    let endpoint = format!("ipc://{}", path.display());
    // What a killed server leaves.
    drop(UnixListener::bind(&path).expect("a socket"));
    assert!(path.exists(), "it leaves nothing");
    // A process that another test has just started may still hold the socket.
    until("the socket is closed", PATIENCE, || {
        UnixStream::connect(&path).err()
    });
    for _ in 0..2 {
        let server = TaskServer::bind(&endpoint).expect("a place");
        assert_eq!(server.endpoint(), endpoint);
        serves(server);
        assert!(!path.exists(), "it leaves its file");
    }
}

#[test]
fn a_path_in_use_is_refused() {
    let scratch = Scratch::new();
    let endpoint = format!("ipc://{}", scratch.path("robot.sock").display());
    let first = TaskServer::bind(&endpoint).expect("a place");
    let second = TaskServer::bind(&endpoint).map(drop);
    match second {
        Err(error @ BindError::InUse { .. }) => {
            let told = error.to_string();
            assert!(told.contains("the path is in use"), "{told}");
        }
        other => panic!("{other:?}"),
    }
    // The first keeps its place.
    serves(first);
    // A file that is not a socket is not replaced.
    std::fs::write(scratch.path("notes"), "keep me").expect("a file");
    let endpoint = format!("ipc://{}", scratch.path("notes").display());
    let third = TaskServer::bind(&endpoint).map(drop);
    assert!(matches!(third, Err(BindError::InUse { .. })), "{third:?}");
    assert_eq!(
        std::fs::read(scratch.path("notes")).expect("it"),
        b"keep me"
    );
}

#[test]
fn ipv6_is_served() {
    if let Err(error) = TcpListener::bind("[::1]:0") {
        println!("not tested, since this machine does not have the address ::1: {error}");
        return;
    }
    let server = TaskServer::bind("tcp://[::1]:*").expect("a port");
    assert!(
        server.endpoint().starts_with("tcp://[::1]:"),
        "{}",
        server.endpoint()
    );
    serves(server);
}
