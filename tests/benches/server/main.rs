//! Whole servers, as processes of their own, side by side in one run: ours, the original's, and bare
//! libzmq (REP and ROUTER) that echoes as many bytes; 1, 8 and 64 clients. `cargo xtask bench` runs it.
//!
//! Each client is a libzmq REQ socket on a thread of its own, which asks again as soon as it is
//! answered. All servers are measured in turn, round by round, so that what else the machine does
//! meets all of them; a ratio is the median of the rounds' ratios, and its interval their middle half.

use std::process::Command;
use std::sync::Barrier;
use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server};

const ROUNDS: usize = 21;
const SLICE: Duration = Duration::from_millis(100);
const CLIENTS: [usize; 3] = [1, 8, 64];

/// `test:echo:hi`
const INIT: &str = "/test;1;-1;dGVzdDplY2hvOmhp";

/// What was seen in one slice.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    /// Answers in a second.
    rate: f64,
    /// Microseconds until an answer.
    p50: f64,
    p99: f64,
}

/// Something to be measured.
struct Subject {
    name: &'static str,
    endpoint: String,
    request: String,
    /// What every answer begins with.
    answer: &'static str,
    seen: Vec<Seen>,
}

fn percentile(sorted: &[f64], percent: usize) -> f64 {
    let place = sorted.len() * percent / 100;
    sorted
        .get(place)
        .or(sorted.last())
        .copied()
        .unwrap_or(f64::NAN)
}

/// Sockets that are connected and have been answered once.
fn connect(subject: &Subject, clients: usize) -> Vec<zmq::Socket> {
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

fn measure(subject: &Subject, sockets: Vec<zmq::Socket>) -> (Seen, Vec<zmq::Socket>) {
    let ready = Barrier::new(sockets.len());
    let mut times = Vec::new();
    let mut back = Vec::new();
    let start = Instant::now();
    std::thread::scope(|scope| {
        let threads: Vec<_> = sockets
            .into_iter()
            .map(|socket| {
                let ready = &ready;
                scope.spawn(move || {
                    ready.wait();
                    let (start, mut times) = (Instant::now(), Vec::new());
                    while start.elapsed() < SLICE {
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
    let took = start.elapsed().as_secs_f64();
    times.sort_by(f64::total_cmp);
    let seen = Seen {
        rate: times.len() as f64 / took,
        p50: percentile(&times, 50),
        p99: percentile(&times, 99),
    };
    (seen, back)
}

/// Starts this program as a bare libzmq server.
fn bare(kind: &str) -> (Process, String) {
    let program = std::env::current_exe().expect("this program");
    let mut process = Process::start(Command::new(program).env("ZTL_BENCH_ECHO", kind));
    let endpoint = process.next_line(PATIENCE);
    (process, endpoint)
}

/// Answers what comes, until it is killed.
fn echo(kind: &str) {
    let router = kind == "router";
    let context = zmq::Context::new();
    let kind = if router { zmq::ROUTER } else { zmq::REP };
    let socket = context.socket(kind).expect("a socket");
    socket.bind("tcp://127.0.0.1:*").expect("a port");
    println!(
        "{}",
        socket.get_last_endpoint().expect("bound").expect("text")
    );
    loop {
        if router {
            let frames = socket.recv_multipart(0).expect("a message");
            socket.send_multipart(frames, 0).expect("to send");
        } else {
            let body = socket.recv_bytes(0).expect("a message");
            socket.send(body, 0).expect("to send");
        }
    }
}

fn median(values: impl Iterator<Item = f64>) -> [f64; 3] {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    [50, 25, 75].map(|percent| percentile(&values, percent))
}

fn show(subjects: &[Subject], base: &str) {
    let of = subjects.iter().find(|subject| subject.name == base);
    let of = of.expect("a subject");
    for subject in subjects {
        let [rate, ..] = median(subject.seen.iter().map(|seen| seen.rate));
        let [p50, ..] = median(subject.seen.iter().map(|seen| seen.p50));
        let [p99, ..] = median(subject.seen.iter().map(|seen| seen.p99));
        let pairs = subject.seen.iter().zip(&of.seen);
        let [ratio, low, high] = median(pairs.map(|(seen, of)| seen.rate / of.rate));
        println!(
            "  {:<22}{rate:>9.0}/s  p50 {p50:>7.0} µs  p99 {p99:>7.0} µs  {ratio:.2} of {base} ({low:.2} to {high:.2})",
            subject.name
        );
    }
}

fn rounds(subjects: &mut [Subject], clients: usize) {
    let mut sockets: Vec<_> = subjects
        .iter()
        .map(|subject| measure(subject, connect(subject, clients)).1)
        .collect();
    for subject in subjects.iter_mut() {
        subject.seen.clear();
    }
    for _ in 0..ROUNDS {
        for (subject, sockets) in subjects.iter_mut().zip(&mut sockets) {
            let (seen, back) = measure(subject, std::mem::take(sockets));
            subject.seen.push(seen);
            *sockets = back;
        }
    }
}

/// From the goal to its result: `run`, beside one bare round trip.
fn goal_to_result(ours: &Server, bare: &Subject) {
    let mut remote = RemoteTask::connect(&ours.endpoint(), SCOPE).expect("an address");
    let mut sockets = connect(bare, 1);
    let (mut runs, mut trips) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (start, mut times) = (Instant::now(), Vec::new());
        while start.elapsed() < SLICE {
            let asked = Instant::now();
            let end = remote.run("test", "echo", "hi", Some(PATIENCE));
            times.push(asked.elapsed().as_secs_f64() * 1e6);
            let end = end.expect("taken").expect("its end");
            assert_eq!(end.state, State::Completed);
        }
        times.sort_by(f64::total_cmp);
        runs.push(percentile(&times, 50));
        let (seen, back) = measure(bare, sockets);
        sockets = back;
        trips.push(seen.p50);
    }
    let [run, ..] = median(runs.iter().copied());
    let [trip, ..] = median(trips.iter().copied());
    println!("goal to result, 1 client: run {run:.0} µs, one bare round trip {trip:.0} µs (p50)");
}

fn main() {
    if let Ok(kind) = std::env::var("ZTL_BENCH_ECHO") {
        return echo(&kind);
    }
    let (ours, original) = (Server::ours(), Server::original());
    let ((_rep, rep), (_router, router)) = (bare("rep"), bare("router"));
    let subject = |name, endpoint: &str, request: String, answer| Subject {
        name,
        endpoint: endpoint.to_owned(),
        request,
        answer,
        seen: Vec::new(),
    };
    // A task that has completed, at each server.
    let status = |server: &Server| {
        let mut client = server.original_client();
        let id = client.start("test", "echo", "hi");
        assert_eq!(client.wait(id, 5.0).text, "hi");
        format!("/test;2;{id};status update")
    };
    let mut inits = [
        subject(
            "the original",
            &original.endpoint(),
            INIT.to_owned(),
            "/test;1;",
        ),
        subject("ours", &ours.endpoint(), INIT.to_owned(), "/test;1;"),
    ];
    for clients in CLIENTS {
        // Of a task that is new: the INITs below make a server forget it.
        let echoed = status(&ours);
        let mut statuses = [
            subject("bare REP", &rep, echoed.clone(), SCOPE),
            subject("bare ROUTER", &router, echoed, SCOPE),
            subject("ours", &ours.endpoint(), status(&ours), "/test;5;"),
            subject(
                "the original",
                &original.endpoint(),
                status(&original),
                "/test;5;",
            ),
        ];
        println!("STATUS, {clients} clients, medians of {ROUNDS} rounds in turn:");
        rounds(&mut statuses, clients);
        show(&statuses, "bare ROUTER");
        println!("INIT of a trivial task, {clients} clients:");
        rounds(&mut inits, clients);
        show(&inits, "the original");
    }
    goal_to_result(&ours, &subject("bare REP", &rep, INIT.to_owned(), SCOPE));
}
