//! A Stop reaches each task at once, however long the others take to answer, and a client prints how its task ended.

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::mpsc::{Sender, TryRecvError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_std::{RemoteId, RequestError, State, Status};
use ztl_tests::lab::{
    FakeServer, PATIENCE, Process, SCOPE, Scratch, connect, original_client, our_client,
    ours_named, port_of, status, ztl,
};

/// It keeps its connections until it is asked for the requests: libzmq's clients drop answers that they have not read when
/// a connection ends.
struct Holding {
    endpoint: String,
    end: Sender<()>,
    thread: JoinHandle<Vec<String>>,
}

impl Holding {
    /// What it was asked.
    fn requests(self) -> Vec<String> {
        drop(self.end);
        self.thread.join().expect("requests")
    }
}

/// Answers nothing until it has `count` ABORTs; then all but the last, backwards, and each STATUS.
fn server(count: usize, lost: usize) -> Holding {
    let socket = zmq::Context::new().socket(zmq::ROUTER).expect("a socket");
    socket.set_linger(0).expect("an option");
    socket.set_rcvtimeo(100).expect("an option");
    socket.bind("tcp://127.0.0.1:*").expect("a free port");
    let endpoint = socket.get_last_endpoint().expect("it is bound");
    let port = port_of(&endpoint.expect("UTF-8"));
    let (end, ended) = channel();
    let serve = move || {
        let mut requests = Vec::new();
        let mut held = Vec::new();
        while ended.try_recv() == Err(TryRecvError::Empty) {
            let Ok(mut frames) = socket.recv_multipart(0) else {
                continue;
            };
            let body = String::from_utf8(frames.pop().expect("a body")).expect("UTF-8");
            let id = body.split(';').nth(2).expect("an id").to_owned();
            let is_abort = body.split(';').nth(1) == Some("3");
            requests.push(body);
            let (state, text) = if is_abort { (4, "True") } else { (4, "there") };
            frames.push(format!("{SCOPE};{state};{id};{text}").into_bytes());
            if is_abort {
                held.push(frames);
            } else {
                socket.send_multipart(frames, 0).expect("a client");
            }
            if is_abort && held.len() == count {
                for answer in held.drain(..).rev().skip(lost) {
                    socket.send_multipart(answer, 0).expect("a client");
                }
            }
        }
        requests
    };
    Holding {
        endpoint: format!("tcp://127.0.0.1:{port}"),
        end,
        thread: std::thread::spawn(serve),
    }
}

fn tasks(count: i64) -> Vec<(String, RemoteId)> {
    let id = |id: i64| (SCOPE.to_owned(), RemoteId::from(id));
    (1..=count).map(id).collect()
}

fn abort(
    endpoint: &str,
    limit: Duration,
    tasks: &[(String, RemoteId)],
) -> BTreeMap<usize, Result<Status, RequestError>> {
    let mut told = BTreeMap::new();
    let mut remote = connect(endpoint).with_timeout(limit);
    remote.abort_all(tasks, |at, outcome| {
        assert_eq!(told.insert(at, outcome), None, "told once");
    });
    told
}

#[test]
fn all_aborts_are_sent_before_the_first_answer() {
    let server = server(5, 0);
    let told = abort(&server.endpoint, PATIENCE, &tasks(5));
    let expected = (0..5).map(|at| (at, Ok(status(State::Aborted, "there"))));
    assert_eq!(told, expected.collect());
    let requests = server.requests();
    let aborts = (1..=5).map(|id| format!("{SCOPE};3;{id};abort command"));
    assert_eq!(requests[..5], aborts.collect::<Vec<_>>());
}

#[test]
fn a_lost_answer_concerns_only_its_task() {
    let server = server(5, 1);
    let mut told = abort(&server.endpoint, Duration::from_secs(5), &tasks(5));
    let lost = told.remove(&4).expect("the last");
    assert!(
        matches!(lost, Err(RequestError::NoAnswer { .. })),
        "{lost:?}"
    );
    let expected = (0..4).map(|at| (at, Ok(status(State::Aborted, "there"))));
    assert_eq!(told, expected.collect());
}

#[test]
fn a_lost_connection_ends_the_wait() {
    let socket = zmq::Context::new().socket(zmq::ROUTER).expect("a socket");
    socket.set_linger(0).expect("an option");
    socket.bind("tcp://127.0.0.1:*").expect("a free port");
    let endpoint = socket
        .get_last_endpoint()
        .expect("it is bound")
        .expect("UTF-8");
    let server = std::thread::spawn(move || {
        for _ in 0..3 {
            socket.recv_multipart(0).expect("an ABORT");
        }
        // Its socket is closed.
    });
    let start = std::time::Instant::now();
    let told = abort(&endpoint, PATIENCE, &tasks(3));
    assert!(start.elapsed() < PATIENCE / 2, "{:?}", start.elapsed());
    let lost = |outcome: &Result<_, _>| matches!(outcome, Err(RequestError::NoAnswer { .. }));
    assert!(told.len() == 3 && told.values().all(lost), "{told:?}");
    server.join().expect("three ABORTs");
}

#[test]
fn without_a_server_nothing_was_sent() {
    let nobody = format!("tcp://127.0.0.1:{}", ztl_tests::lab::reserve_port());
    let mut tasks = tasks(3);
    tasks.push(("/a;3".to_owned(), RemoteId::from(4)));
    let told = abort(&nobody, Duration::from_millis(300), &tasks);
    assert_eq!(told.len(), 4);
    for outcome in told.values() {
        let error = outcome.as_ref().expect_err("nobody is there");
        assert!(error.nothing_was_sent(), "{error}");
    }
}

/// Answers an ABORT with this state, and each STATUS after it with the state and a text. Before, the task runs.
fn ending(state: i32, text: &'static str) -> FakeServer {
    let mut ended = false;
    FakeServer::start(move |request| {
        let code = request.split(';').nth(1);
        ended |= code == Some("3");
        let told = match code {
            Some("1") => "1;7;moving".to_owned(),
            Some("3") => format!("{state};7;False"),
            _ if ended => format!("{state};7;{text}"),
            _ => "1;7;None".to_owned(),
        };
        format!("{SCOPE};{told}").into_bytes()
    })
}

fn lines(mut client: Command, words: &[&str], payload: &str) -> Vec<String> {
    let ended = Process::run(client.args(words).arg(payload));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    ended.stdout.lines().map(str::to_owned).collect()
}

#[test]
fn a_client_prints_how_a_task_ended_that_it_aborted_too_late() {
    let files = Scratch::new();
    for (state, text, said) in [
        (
            5,
            "there",
            "in state 'COMPLETED' after abort signal. Result is 'there'.",
        ),
        (
            3,
            "it broke",
            "in state 'FAILED' after abort signal. Result is 'it broke'.",
        ),
        (
            2,
            "no",
            "in state 'REJECTED' after abort signal. Result is 'no'.",
        ),
        // No result is known.
        (
            5,
            "None",
            "in state 'COMPLETED' after abort signal. Reply is 'False'.",
        ),
    ] {
        let server = ending(state, text);
        let port = server.port.to_string();
        let said = format!("Task with ID '7' finished {said}");
        let at = ["-r", "127.0.0.1", "-p", &port, "-s", SCOPE, "-t", "1"];
        let told = lines(our_client(), &at, "arm:left:up");
        assert_eq!(told.last(), Some(&said), "{told:?}");
        let server = ending(state, text);
        let port = server.port.to_string();
        let mut remote_task = ztl();
        remote_task.args(["remote-task", "--task", "arm", "127.0.0.1", &port, SCOPE]);
        let told = lines(remote_task, &["-t", "1", "arm"], "arm:left:up");
        assert_eq!(told.last(), Some(&said), "{told:?}");
        // The original's output does not change.
        let told = [ours_named(&files, "ztl_task_client"), original_client()].map(|client| {
            let server = ending(state, text);
            let port = server.port.to_string();
            let at = ["-r", "127.0.0.1", "-p", &port, "-s", SCOPE, "-t", "1"];
            let told = lines(client, &at, "arm:left:up");
            assert_eq!(
                told.last().map(String::as_str),
                Some("Aborting task with ID '7'...")
            );
            told[1..].to_vec()
        });
        assert_eq!(told[0], told[1]);
    }
    let server = ending(4, "there");
    let port = server.port.to_string();
    let at = ["-r", "127.0.0.1", "-p", &port, "-s", SCOPE, "-t", "1"];
    let told = lines(our_client(), &at, "arm:left:up");
    let said = "Task with ID '7' aborted. Reply is 'False'.";
    assert_eq!(told.last().map(String::as_str), Some(said), "{told:?}");
}

#[test]
fn the_simple_client_prints_the_end_of_a_task_that_it_aborted_too_late() {
    let files = Scratch::new();
    let run = |mut client: Command| {
        let server = ending(5, "there");
        let port = server.port.to_string();
        client.args(["127.0.0.1", &port, SCOPE]);
        lines(client, &[], "x")
    };
    let mut ours = ztl();
    ours.arg("simple-client");
    let told = run(ours);
    // As its other lines: without the state.
    let said = "Task with ID '7' finished after abort signal. Result is 'there'.";
    assert_eq!(told.last().map(String::as_str), Some(said), "{told:?}");
    let told = run(ours_named(&files, "ztl_simple_client"));
    let said = "Aborting task with ID '7'...";
    assert_eq!(told.last().map(String::as_str), Some(said), "{told:?}");
}
