//! An INIT or its reply is lost: the client never resends it, and asks the server for the outcome.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use ztl_std::{
    ExecutableTask, RemoteTask, RequestError, State, TaskContext, TaskController, TaskError,
    TaskRequest, TaskServer, TriggerError,
};
use ztl_tests::lab::{PATIENCE, SCOPE, Server, port_of, until};

/// The fault of the wire for the first INIT.
#[derive(Clone, Copy, PartialEq)]
enum Fault {
    RequestLost,
    AnswerLost,
    /// The reply is lost, and the server is restarted afterwards.
    Restart,
}

struct Counter(Arc<AtomicU32>);

impl TaskController for Counter {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        self.0.fetch_add(1, Ordering::SeqCst);
        let task = |_: &TaskContext| Ok::<_, TaskError>("done".to_owned());
        Ok(Box::new(task))
    }
}

fn server(started: &Arc<AtomicU32>) -> ztl_std::RunningServer {
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
    server.register("/lab", Counter(Arc::clone(started)));
    server.spawn().unwrap()
}

/// Whether these frames of a client are an INIT.
fn is_init(frames: &[Vec<u8>]) -> bool {
    frames
        .last()
        .is_some_and(|body| body.starts_with(b"/lab;1;"))
}

/// Relays messages between clients and `server`, with one fault, until `stop` is dropped.
fn wire(
    fault: Fault,
    server: String,
    other: String,
    stop: std::sync::mpsc::Receiver<()>,
) -> String {
    let context = zmq::Context::new();
    let front = context.socket(zmq::ROUTER).unwrap();
    front.set_linger(0).unwrap();
    front.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = front.get_last_endpoint().unwrap().unwrap();
    std::thread::spawn(move || {
        let open = |to: &str| {
            let back = context.socket(zmq::DEALER).unwrap();
            back.set_linger(0).unwrap();
            back.connect(to).unwrap();
            back
        };
        let mut back = open(&server);
        let (mut lost, mut inits) = (false, 0);
        while stop.try_recv() != Err(std::sync::mpsc::TryRecvError::Disconnected) {
            let mut items = [
                front.as_poll_item(zmq::POLLIN),
                back.as_poll_item(zmq::POLLIN),
            ];
            zmq::poll(&mut items, 20).unwrap();
            if let Ok(frames) = front.recv_multipart(zmq::DONTWAIT) {
                inits += u32::from(is_init(&frames));
                assert!(inits <= 1, "an INIT was sent twice");
                if is_init(&frames) && fault == Fault::RequestLost {
                    continue;
                }
                back.send_multipart(frames, 0).unwrap();
            }
            if let Ok(frames) = back.recv_multipart(zmq::DONTWAIT) {
                if !lost && is_init(&frames) {
                    lost = true;
                    if fault == Fault::Restart {
                        back = open(&other);
                    }
                    continue;
                }
                front.send_multipart(frames, 0).unwrap();
            }
        }
    });
    endpoint
}

/// Triggers a task over a wire with a fault; returns the client's result and how often the task started.
fn trigger(fault: Fault) -> (Result<State, TriggerError>, u32) {
    let started = Arc::default();
    let (one, other) = (server(&started), server(&started));
    let (_running, stop) = std::sync::mpsc::channel();
    let endpoint = wire(
        fault,
        one.endpoint().to_owned(),
        other.endpoint().to_owned(),
        stop,
    );
    let remote = RemoteTask::connect(&endpoint, "/lab").unwrap();
    let mut remote = remote.with_timeout(PATIENCE);
    // The client connects first, so the fault affects the INIT.
    remote.server_info(false).expect("an answer");
    // Each answer that is not lost comes earlier, also on a busy machine.
    let mut remote = remote.with_timeout(Duration::from_secs(5));
    let told = remote.trigger("h", "c", "g").map(|task| {
        let limit = Some(PATIENCE);
        remote.wait(task.id, limit).expect("it ends").state
    });
    (told, started.load(Ordering::SeqCst))
}

#[test]
fn a_task_with_a_lost_reply_is_found() {
    assert_eq!(trigger(Fault::AnswerLost), (Ok(State::Completed), 1));
}

#[test]
fn a_lost_init_is_reported_as_not_started() {
    assert_eq!(
        trigger(Fault::RequestLost),
        (Err(TriggerError::NeverCame), 0)
    );
}

#[test]
fn after_a_server_restart_a_lost_init_has_an_unknown_outcome() {
    let (told, started) = trigger(Fault::Restart);
    let unknown = matches!(
        told,
        Err(TriggerError::Request(RequestError::NoAnswer { .. }))
    );
    assert!(unknown, "{told:?}");
    assert_eq!(started, 1);
}

#[test]
fn a_cancelled_task_is_found_without_waiting_for_its_reply() {
    let started = Arc::default();
    let server = server(&started);
    let (_running, stop) = std::sync::mpsc::channel();
    let endpoint = server.endpoint().to_owned();
    let endpoint = wire(Fault::AnswerLost, endpoint.clone(), endpoint, stop);
    let patient = Duration::from_secs(3600);
    let mut remote = RemoteTask::connect(&endpoint, "/lab")
        .unwrap()
        .with_timeout(patient);
    let begun = || started.load(Ordering::SeqCst) > 0;
    let spec = ztl_std::TaskSpec {
        handler: "h",
        component: "c",
        goal: "g",
    };
    let mut payload = vec![0; spec.encoded_len()];
    let payload = spec.encode_into(&mut payload).unwrap();
    let task = remote.trigger_while(payload, || !begun()).unwrap();
    let end = remote.wait(task.id, Some(PATIENCE)).unwrap();
    assert_eq!(end.state, State::Completed);
    assert_eq!(started.load(Ordering::SeqCst), 1);
    // A task cancelled earlier is not sent at all.
    let given_up = remote.trigger_while(payload, || false);
    assert_eq!(given_up, Err(TriggerError::GivenUp));
    assert_eq!(started.load(Ordering::SeqCst), 1);
}

#[test]
fn a_quick_task_is_run_in_a_single_round_trip() {
    let started = Arc::default();
    let server = server(&started);
    let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
    let mut remote = remote.with_timeout(PATIENCE);
    let end = remote.run("h", "c", "g", Some(PATIENCE));
    let end = end.expect("it ends");
    assert_eq!((end.state, end.text.as_str()), (State::Completed, "done"));
}

#[test]
fn an_init_to_a_hanging_server_has_an_unknown_outcome() {
    let server = Server::ours();
    let remote = RemoteTask::connect(&server.endpoint(), SCOPE).unwrap();
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    until("the server answers", PATIENCE, || {
        remote.server_info(true).ok()
    });
    server.process.signal("STOP");
    // It waits in the server's connection. The question about it needs another one, which a server that hangs
    // does not accept.
    let error = remote.trigger("test", "sleep", "60").unwrap_err();
    let TriggerError::Request(error) = error else {
        panic!("{error:?}");
    };
    assert!(matches!(error, RequestError::NoAnswer { .. }), "{error:?}");
    assert!(!error.nothing_was_sent());
    server.process.signal("CONT");
    until("the task runs", PATIENCE, || {
        let tasks = remote.ask_server("tasks").ok()??;
        tasks.contains("test:sleep:60").then_some(())
    });
}

/// Relays bytes between clients and a server. While it is `stalled`, nothing more arrives at the server, as when a network
/// is down. Returns its port, and how many directions of connections are open.
fn network(server: u16, stalled: &Arc<AtomicBool>) -> (u16, Arc<AtomicU32>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let (stalled, open) = (Arc::clone(stalled), Arc::new(AtomicU32::new(0)));
    let counted = Arc::clone(&open);
    std::thread::spawn(move || {
        for client in listener.incoming() {
            let (client, server) = (
                client.unwrap(),
                TcpStream::connect(("127.0.0.1", server)).unwrap(),
            );
            for (mut from, mut to, stalled) in [
                (
                    client.try_clone().unwrap(),
                    server.try_clone().unwrap(),
                    Arc::clone(&stalled),
                ),
                (server, client, Arc::default()),
            ] {
                counted.fetch_add(1, Ordering::SeqCst);
                let counted = Arc::clone(&counted);
                std::thread::spawn(move || {
                    let mut bytes = [0; 4096];
                    loop {
                        while stalled.load(Ordering::SeqCst) {
                            std::thread::sleep(Duration::from_millis(5));
                        }
                        match from.read(&mut bytes) {
                            Ok(count @ 1..) if to.write_all(&bytes[..count]).is_ok() => {}
                            _ => break,
                        }
                    }
                    for stream in [from, to] {
                        let _ = stream.shutdown(Shutdown::Both);
                    }
                    counted.fetch_sub(1, Ordering::SeqCst);
                });
            }
        }
    });
    (port, open)
}

#[test]
fn an_init_that_nobody_waits_for_does_not_arrive_later() {
    let started = Arc::default();
    let server = server(&started);
    let stalled = Arc::new(AtomicBool::new(false));
    let (port, open) = network(port_of(server.endpoint()), &stalled);
    let remote = RemoteTask::connect(&format!("tcp://127.0.0.1:{port}"), "/lab").unwrap();
    let mut remote = remote.with_timeout(PATIENCE);
    remote.server_info(false).expect("an answer");
    let mut remote = remote.with_timeout(Duration::from_millis(300));
    stalled.store(true, Ordering::SeqCst);
    // Longer than what the network holds.
    let error = remote
        .trigger("h", "c", &"long ".repeat(140_000))
        .unwrap_err();
    let unknown = matches!(error, TriggerError::Request(RequestError::NoAnswer { .. }));
    assert!(unknown, "{error:?}");
    drop(remote);
    stalled.store(false, Ordering::SeqCst);
    until("the end of what was sent", PATIENCE, || {
        (open.load(Ordering::SeqCst) == 0).then_some(())
    });
    let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
    let mut remote = remote.with_timeout(PATIENCE);
    remote.run("h", "c", "g", Some(PATIENCE)).expect("it ends");
    assert_eq!(started.load(Ordering::SeqCst), 1);
}
