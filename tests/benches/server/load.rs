//! Clients that send the next request after each reply, their measurements, and the bare servers.

use std::process::Command;
use std::sync::Barrier;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server};

use crate::numbers::percentile;

/// The result of one measurement.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Seen {
    /// Answers in a second.
    pub(crate) rate: f64,
    /// Microseconds until an answer.
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    /// Microseconds of the server's CPU time for an answer.
    pub(crate) cpu: f64,
    /// The share of a core that the clients' running threads used.
    pub(crate) load: f64,
}

/// Something to be measured.
pub(crate) struct Subject {
    pub(crate) name: &'static str,
    endpoint: String,
    /// Its process.
    pub(crate) id: u32,
    request: String,
    /// The beginning of every reply.
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

    /// The TCP port where it listens.
    pub(crate) fn port(&self) -> u16 {
        let port = self.endpoint.rsplit(':').next();
        port.and_then(|port| port.parse().ok()).expect("a port")
    }

    /// The repeated request.
    pub(crate) fn request(&self) -> &str {
        &self.request
    }

    /// Whether it is the right answer.
    #[track_caller]
    pub(crate) fn check(&self, answer: &[u8]) {
        assert!(answer.starts_with(self.answer.as_bytes()), "{answer:?}");
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

/// Answers every request until it is killed.
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

/// Clients that ask as fast as they are answered.
pub(crate) trait Clients {
    /// So many, connected.
    fn connect(subject: &Subject, count: usize) -> Self;

    /// Lets all of them ask for so long; microseconds until each answer.
    fn ask(&mut self, subject: &Subject, slice: Duration) -> Vec<f64>;
}

/// The usual clients: libzmq's REQ sockets, each on its own thread.
pub(crate) struct Libzmq(Vec<zmq::Socket>);

impl Clients for Libzmq {
    fn connect(subject: &Subject, count: usize) -> Self {
        let context = zmq::Context::new();
        let open = |_| {
            let socket = context.socket(zmq::REQ).expect("a socket");
            socket.set_linger(0).expect("an option");
            socket.set_rcvtimeo(10_000).expect("an option");
            socket.connect(&subject.endpoint).expect("an address");
            socket
        };
        Self((0..count).map(open).collect())
    }

    fn ask(&mut self, subject: &Subject, slice: Duration) -> Vec<f64> {
        let ready = Barrier::new(self.0.len());
        std::thread::scope(|scope| {
            let begin = |socket| {
                let ready = &ready;
                scope.spawn(move || {
                    ready.wait();
                    ask_again_and_again(subject, socket, slice)
                })
            };
            let threads: Vec<_> = self.0.iter_mut().map(begin).collect();
            let times = threads
                .into_iter()
                .map(|thread| thread.join().expect("no panic"));
            times.flatten().collect()
        })
    }
}

fn ask_again_and_again(subject: &Subject, socket: &mut zmq::Socket, slice: Duration) -> Vec<f64> {
    let (start, mut times) = (Instant::now(), Vec::new());
    while start.elapsed() < slice {
        let asked = Instant::now();
        socket.send(&subject.request, 0).expect("to send");
        let answer = socket.recv_bytes(0).expect("an answer");
        times.push(asked.elapsed().as_secs_f64() * 1e6);
        subject.check(&answer);
    }
    times
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

/// Lets the clients ask for so long.
pub(crate) fn measure(subject: &Subject, clients: &mut impl Clients, slice: Duration) -> Seen {
    let own = std::process::id();
    let (start, before) = (Instant::now(), [cpu(subject.id), cpu(own)]);
    let mut times = clients.ask(subject, slice);
    let took = start.elapsed().as_secs_f64();
    let [spent, load] = [cpu(subject.id) - before[0], cpu(own) - before[1]];
    times.sort_by(f64::total_cmp);
    Seen {
        rate: times.len() as f64 / took,
        p50: percentile(&times, 50),
        p99: percentile(&times, 99),
        cpu: spent / times.len() as f64,
        load: load / 1e6 / took,
    }
}

/// Measures all of them in turn, this many times, after a warm-up round.
pub(crate) fn rounds<C: Clients>(
    subjects: &mut [Subject],
    clients: usize,
    slice: Duration,
    count: usize,
) {
    let mut all: Vec<C> = subjects
        .iter()
        .map(|subject| C::connect(subject, clients))
        .collect();
    for (subject, clients) in subjects.iter_mut().zip(&mut all) {
        measure(subject, clients, slice);
    }
    for _ in 0..count {
        for (subject, clients) in subjects.iter_mut().zip(&mut all) {
            let seen = measure(subject, clients, slice);
            subject.seen.push(seen);
        }
    }
}
