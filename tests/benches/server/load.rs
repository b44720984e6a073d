//! Clients that ask as fast as they are answered: libzmq REQ sockets, each on a thread of its own; and
//! the bare servers.

use std::process::Command;
use std::sync::Barrier;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server};

use crate::ROUNDS;
use crate::numbers::percentile;

/// What was seen in one measurement.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Seen {
    /// Answers in a second.
    pub(crate) rate: f64,
    /// Microseconds until an answer.
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    /// Microseconds of the server's CPU time for an answer.
    pub(crate) cpu: f64,
}

/// Something to be measured.
pub(crate) struct Subject {
    pub(crate) name: &'static str,
    endpoint: String,
    /// Its process.
    pub(crate) id: u32,
    request: String,
    /// What every answer begins with.
    answer: &'static str,
    pub(crate) seen: Vec<Seen>,
}

impl Subject {
    pub(crate) fn new(
        name: &'static str,
        server: &Server,
        request: String,
        answer: &'static str,
    ) -> Self {
        Self {
            name,
            endpoint: server.endpoint(),
            id: server.process.id(),
            request,
            answer,
            seen: Vec::new(),
        }
    }
}

/// A bare libzmq server.
pub(crate) struct Bare {
    process: Process,
    endpoint: String,
}

impl Bare {
    pub(crate) fn subject(&self, name: &'static str, request: &str) -> Subject {
        Subject {
            name,
            endpoint: self.endpoint.clone(),
            id: self.process.id(),
            request: request.to_owned(),
            answer: SCOPE,
            seen: Vec::new(),
        }
    }
}

/// Starts this program as a bare libzmq server.
pub(crate) fn bare(kind: &str) -> Bare {
    let program = std::env::current_exe().expect("this program");
    let mut process = Process::start(Command::new(program).env("ZTL_BENCH_ECHO", kind));
    let endpoint = process.next_line(PATIENCE);
    Bare { process, endpoint }
}

/// Answers what comes, until it is killed.
pub(crate) fn echo(kind: &str) {
    let router = kind == "router";
    let context = zmq::Context::new();
    let kind = if router { zmq::ROUTER } else { zmq::REP };
    let socket = context.socket(kind).expect("a socket");
    socket.bind("tcp://127.0.0.1:*").expect("a port");
    let endpoint = socket.get_last_endpoint().expect("bound");
    println!("{}", endpoint.expect("text"));
    loop {
        // As messages, so that nothing is copied that need not be.
        let mut message = socket.recv_msg(0).expect("a message");
        while message.get_more() {
            socket.send(message, zmq::SNDMORE).expect("to send");
            message = socket.recv_msg(0).expect("a message");
        }
        socket.send(message, 0).expect("to send");
    }
}

/// Sockets that connect.
pub(crate) fn connect(subject: &Subject, clients: usize) -> Vec<zmq::Socket> {
    let context = zmq::Context::new();
    let open = |_| {
        let socket = context.socket(zmq::REQ).expect("a socket");
        socket.set_linger(0).expect("an option");
        socket.set_rcvtimeo(10_000).expect("an option");
        socket.connect(&subject.endpoint).expect("an address");
        socket
    };
    (0..clients).map(open).collect()
}

/// CPU time that a process has taken, in microseconds.
fn cpu(process: u32) -> f64 {
    let threads = std::fs::read_dir(format!("/proc/{process}/task"));
    let threads = threads.into_iter().flatten().flatten();
    let spent = threads.filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<f64>().ok()
    });
    spent.sum::<f64>() / 1000.0
}

/// Lets the sockets ask for so long, and gives them back.
pub(crate) fn measure(
    subject: &Subject,
    sockets: Vec<zmq::Socket>,
    slice: Duration,
) -> (Seen, Vec<zmq::Socket>) {
    let ready = Barrier::new(sockets.len());
    let mut times = Vec::new();
    let mut back = Vec::new();
    let (start, before) = (Instant::now(), cpu(subject.id));
    std::thread::scope(|scope| {
        let threads: Vec<_> = sockets
            .into_iter()
            .map(|socket| {
                let ready = &ready;
                scope.spawn(move || {
                    ready.wait();
                    let (start, mut times) = (Instant::now(), Vec::new());
                    while start.elapsed() < slice {
                        let asked = Instant::now();
                        socket.send(&subject.request, 0).expect("to send");
                        let answer = socket.recv_bytes(0).expect("an answer");
                        times.push(asked.elapsed().as_secs_f64() * 1e6);
                        assert!(answer.starts_with(subject.answer.as_bytes()));
                    }
                    (times, socket)
                })
            })
            .collect();
        for thread in threads {
            let (mut part, socket) = thread.join().expect("no panic");
            times.append(&mut part);
            back.push(socket);
        }
    });
    let (took, spent) = (start.elapsed().as_secs_f64(), cpu(subject.id) - before);
    times.sort_by(f64::total_cmp);
    let seen = Seen {
        rate: times.len() as f64 / took,
        p50: percentile(&times, 50),
        p99: percentile(&times, 99),
        cpu: spent / times.len() as f64,
    };
    (seen, back)
}

/// Measures all of them in turn, again and again.
pub(crate) fn rounds(subjects: &mut [Subject], clients: usize, slice: Duration) {
    let mut sockets: Vec<_> = subjects
        .iter()
        .map(|subject| measure(subject, connect(subject, clients), slice).1)
        .collect();
    for subject in subjects.iter_mut() {
        subject.seen.clear();
    }
    for _ in 0..ROUNDS {
        for (subject, sockets) in subjects.iter_mut().zip(&mut sockets) {
            let (seen, back) = measure(subject, std::mem::take(sockets), slice);
            subject.seen.push(seen);
            *sockets = back;
        }
    }
}
