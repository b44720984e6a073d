//! Limits of a server: requests beyond them are rejected with the reason, and affect nothing else.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_std::server::{MAX_MESSAGE, TaskHandler, TaskReporter};
use ztl_std::{
    ExecutableTask, Limits, RemoteTask, RequestError, RunError, RunningServer, State, TaskContext,
    TaskController, TaskError, TaskId, TaskRequest, TaskServer, TriggerError, WaitError,
};
use ztl_tests::lab::{PATIENCE, SCOPE, connect, end, in_time, reserve_port, start, until};

use crate::socket::{Socket, assert_serves};

/// Tasks that end when they are aborted; those that echo end at once.
struct Patient;

impl TaskController for Patient {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let TaskRequest {
            component, goal, ..
        } = request.clone();
        Ok(Box::new(move |context: &TaskContext| {
            if component == "wait" {
                context.sleep(Duration::MAX)?;
            }
            Ok(goal)
        }))
    }
}

fn serve(change: impl FnOnce(&mut Limits)) -> RunningServer {
    serve_at("tcp://127.0.0.1:*", change)
}

fn serve_at(endpoint: &str, change: impl FnOnce(&mut Limits)) -> RunningServer {
    let mut limits = Limits::default();
    change(&mut limits);
    let server = TaskServer::builder().limits(limits).bind(endpoint);
    let mut server = server.expect("a port");
    server.register(SCOPE, Patient);
    server.spawn().expect("a thread")
}

#[track_caller]
fn refused(remote: &mut RemoteTask) -> String {
    match remote.trigger("h", "wait", "g") {
        Err(TriggerError::Rejected { id, reason }) if id.as_str() == "-1" => reason,
        other => panic!("not refused: {other:?}"),
    }
}

fn is_known(remote: &mut RemoteTask, id: TaskId) -> bool {
    match remote.status(id) {
        Err(RequestError::UnknownTask { .. }) => false,
        status => status.is_ok(),
    }
}

#[test]
fn a_task_above_the_limit_is_rejected_without_dropping_outcomes() {
    let server = serve(|limits| (limits.running, limits.remembered) = (2, 4));
    let mut remote = connect(server.endpoint());
    let ended = [0, 1].map(|_| {
        let id = start(&mut remote, "h", "echo", "g");
        remote.wait(id, Some(PATIENCE)).expect("its end");
        id
    });
    let running = [0, 1].map(|_| start(&mut remote, "h", "wait", "g"));
    for _ in 0..10 {
        let reason = "too many tasks are running, wait for one to end";
        assert_eq!(refused(&mut remote), reason);
    }
    assert!(ended.iter().all(|id| is_known(&mut remote, *id)));
    remote.abort(running[0]).expect("an answer");
    assert_eq!(end(&mut remote, running[0]).0, State::Aborted);
    start(&mut remote, "h", "wait", "g");
    // Five would exceed the limit: the task that ended first is gone.
    assert!(!is_known(&mut remote, ended[0]) && is_known(&mut remote, ended[1]));
}

#[test]
fn an_outcome_is_kept_for_the_configured_time() {
    let server = serve(|limits| limits.keep = Duration::from_millis(300));
    let mut remote = connect(server.endpoint());
    let running = start(&mut remote, "h", "wait", "g");
    // A busy machine may ask too late.
    let id = until("an outcome", PATIENCE, || {
        let id = start(&mut remote, "h", "echo", "g");
        match remote.wait(id, Some(PATIENCE)) {
            Ok(end) => assert_eq!(end.state, State::Completed),
            Err(WaitError {
                last: Err(RequestError::UnknownTask { .. }),
            }) => return None,
            Err(error) => panic!("{error}"),
        }
        Some(id)
    });
    until("it is forgotten", PATIENCE, || {
        (!is_known(&mut remote, id)).then_some(())
    });
    // Time counts from the end.
    assert!(is_known(&mut remote, running));
}

/// Aborts its tasks when it is dropped.
struct Held(Vec<TaskReporter>);

impl TaskHandler for Held {
    fn start(&mut self, task: TaskReporter, request: TaskRequest) {
        task.accepted(request.reply());
        self.0.push(task);
    }

    fn abort(&mut self, _: TaskId) {}
}

impl Drop for Held {
    fn drop(&mut self) {
        for task in self.0.drain(..) {
            task.aborted("stopped");
        }
    }
}

#[test]
fn a_server_that_stops_answers_until_the_ends_are_told_or_for_2_s() {
    let stop = |ask: bool| {
        let server = TaskServer::builder().bind("tcp://127.0.0.1:*");
        let mut server = server.expect("a port");
        server.register_handler(SCOPE, Held(Vec::new()));
        let server = server.spawn().expect("a thread");
        let mut remote = connect(server.endpoint());
        let id = start(&mut remote, "h", "c", "g");
        let begun = Instant::now();
        let stopping = std::thread::spawn(move || drop(server));
        if ask && let Ok(end) = remote.wait(id, Some(PATIENCE)) {
            assert_eq!(end.state, State::Aborted);
        }
        stopping.join().expect("no panic");
        begun.elapsed()
    };
    let longest = Duration::from_secs(2);
    for _ in 0..5 {
        assert!(stop(false) >= longest, "nobody has asked");
    }
    // On a busy machine, asking may take as long.
    let early = (0..10).any(|_| stop(true) < longest);
    assert!(early, "all ends are told");
}

#[test]
fn waiting_requests_above_the_limit_are_rejected() {
    let server = serve(|limits| limits.held = 1);
    let (mut remote, mut other) = (connect(server.endpoint()), connect(server.endpoint()));
    let id = start(&mut remote, "h", "wait", "g");
    let tried = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&tried);
    let waiting = std::thread::spawn(move || {
        remote.wait_with(id, Some(PATIENCE), |_| !stop.load(Ordering::SeqCst))
    });
    let reason = until("the wait", PATIENCE, || {
        match other.trigger("h", "echo", "g") {
            Err(TriggerError::Rejected { reason, .. }) => Some(reason),
            _ => None,
        }
    });
    assert_eq!(reason, "too many requests are waiting, try again");
    assert_eq!(other.status(id).expect("an answer").state, State::Accepted);
    tried.store(true, Ordering::SeqCst);
    assert!(waiting.join().expect("no panic").is_err(), "it still runs");
}

#[test]
fn a_message_that_is_too_long_closes_only_its_connection() {
    let server = serve(|limits| limits.message = 1000);
    let (fits, too_long) = (vec![b'x'; 1000], vec![b'x'; 1001]);
    let req = Socket::req(server.endpoint());
    assert!(req.ask(fits).ends_with(";2;-1;Unknown protocol"));
    req.send(&[too_long]);
    req.assert_silent("a message that is too long");
    assert_serves(server.endpoint(), "a message that is too long");
}

/// The length of a goal that makes a message of so many bytes, in which it goes as base64.
fn goal(message: usize) -> String {
    let task = (message - "/test;1;-1;".len()) / 4 * 3;
    "x".repeat(task - "h:echo:".len())
}

#[test]
fn a_client_sends_no_message_above_the_servers_limit() {
    // The longest whole number of base64 groups, and one more group.
    let (fits, too_long) = (11 + 4 * 247, 11 + 4 * 248);
    let endpoint = format!("tcp://127.0.0.1:{}", reserve_port());
    let server = serve_at(&endpoint, |limits| limits.message = 1000);
    let mut remote = connect(server.endpoint());
    let mut run = |bytes| remote.run("h", "echo", &goal(bytes), Some(PATIENCE));
    let end = run(fits).expect("its end");
    assert_eq!(end.text, goal(fits));
    // It waits for no answer.
    let error = in_time(Duration::from_secs(2), || run(too_long)).expect_err("it is too long");
    let told = RequestError::TooLong {
        endpoint: endpoint.clone(),
        bytes: too_long,
        most: 1000,
    };
    assert!(told.nothing_was_sent());
    assert_eq!(error, RunError::NotStarted(TriggerError::Request(told)));
    assert!(run(fits).is_ok(), "it goes on");

    // Another start of the server may take more, and the client finds it. A question about the limit that was
    // under way to the first one is lost, and then nothing was sent.
    drop(server);
    let _server = serve_at(&endpoint, |limits| limits.message = too_long);
    let mut remote = remote.with_timeout(Duration::from_secs(2));
    let mut run = |bytes| remote.run("h", "echo", &goal(bytes), Some(PATIENCE));
    let end = until("the next server's answer", PATIENCE, || {
        match run(too_long) {
            Ok(end) => Some(end),
            Err(RunError::NotStarted(TriggerError::Request(error))) => {
                assert!(error.nothing_was_sent(), "{error}");
                None
            }
            Err(error) => panic!("{error}"),
        }
    });
    assert_eq!(end.text, goal(too_long));
}

#[test]
fn the_longest_message_passes_and_a_longer_one_is_reported() {
    let server = serve(|_| ());
    let mut remote = connect(server.endpoint());
    let payload = |length: usize| "x".repeat(length - "/test;1;-1;".len());
    let refused = remote.trigger_payload(&payload(MAX_MESSAGE));
    assert!(
        matches!(refused, Err(TriggerError::Rejected { .. })),
        "it is not a task: {refused:?}"
    );
    let error = remote.trigger_payload(&payload(MAX_MESSAGE + 1));
    let error = error.expect_err("it is too long").to_string();
    assert!(
        error.starts_with("the message has 1048577 bytes, and the server at tcp://127.0.0.1:"),
        "{error}"
    );
    assert!(
        error.ends_with("takes at most 1048576; a goal can have somewhat less than 786432, because it is sent as base64; nothing was sent"),
        "{error}"
    );
}

#[test]
fn a_connection_above_the_limit_waits_for_a_slot() {
    let server = serve(|limits| {
        limits.connections = 4;
        limits.handshake = Duration::from_millis(500);
    });
    let send = |socket: &Socket| socket.send(&["", "/test;2;99;x"]);
    let ask = |socket: &Socket| {
        send(socket);
        socket.receive();
    };
    let mut inside: Vec<Socket> = (0..4).map(|_| Socket::dealer(server.endpoint())).collect();
    inside.iter().for_each(ask);
    let outside = Socket::dealer(server.endpoint());
    send(&outside);
    outside.assert_silent("one too many");
    inside.iter().for_each(ask);
    inside.pop();
    // Its requests wait in its own queue.
    let answer = outside.receive();
    assert_eq!(answer[1], b"/test;2;99;Invalid ID '99'");
}

/// Answers a client's probes with these limits in turn, then stops; fails on any other request.
fn probed(answers: &'static [&'static str]) -> (String, std::thread::JoinHandle<()>) {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::ROUTER).expect("a socket");
    socket.set_rcvtimeo(5000).expect("a time");
    socket.bind("tcp://127.0.0.1:*").expect("a port");
    let endpoint = socket.get_last_endpoint().expect("it").expect("text");
    let server = std::thread::spawn(move || {
        let mut answers = answers.iter();
        while let Ok(mut frames) = socket.recv_multipart(0) {
            let body = frames.pop().expect("a body");
            assert_eq!(body, b"$ztl;2;-1;probe", "{}", body.escape_ascii());
            if let Some(limit) = answers.next() {
                let answer = format!(
                    "$ztl;5;0;{{ztl: 1, version: '0.1.0', boot: 7, message: {limit}, scopes: {{}}}}"
                );
                frames.push(answer.into_bytes());
                socket.send_multipart(frames, 0).expect("sent");
            }
        }
    });
    (endpoint, server)
}

#[test]
fn a_limit_below_a_probes_length_does_not_stop_probes() {
    let (endpoint, server) = probed(&["10", "4096"]);
    let mut remote = connect(&endpoint);
    for _ in 0..2 {
        assert!(remote.server_info(true).expect("an answer").is_some());
    }
    drop(remote);
    server.join().expect("only probes");
}

#[test]
fn a_client_that_cannot_refresh_the_limit_reports_nothing_sent() {
    let (endpoint, server) = probed(&["100"]);
    let remote = connect(&endpoint);
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    let error = remote
        .trigger_payload(&"x".repeat(200))
        .expect_err("no word");
    assert!(
        matches!(&error, TriggerError::Request(error) if error.nothing_was_sent()),
        "{error:?}"
    );
    server.join().expect("only probes");
}
