//! Whole servers, as processes of their own, side by side in one run: ours, the same over libzmq, the original's, bare
//! libzmq (REP and ROUTER) that echoes as many bytes, and a loop around epoll that does so: the limit.
//! `cargo xtask bench` runs it.
//!
//! All are measured in turn, round by round, so that other load on the machine affects all of them; a
//! ratio is the median of the rounds' ratios. Behind it stands the interval in which the true median lies
//! with 95 % (of 21 rounds the 6th and the 16th). For rates, the servers are restarted every third
//! round. The output shows the target beside each result, and no result fails the run.
//!
//! Every server is asked by the same clients in the same part. Most parts have libzmq's REQ sockets, as people
//! have them. 64 of those on a core of their own keep it busy before a server's core is, so the rate is theirs;
//! what a server can do at most is measured with clients that speak ZMTP themselves and take half a core (`most`).
//!
//! The machine should be idle: other load slows fast requests more than slow ones, and so INITs of the original,
//! at a tenth of the others' rate, hardly at all.

mod alone;
mod busy;
mod connections;
mod echo;
mod latency;
mod load;
mod numbers;
mod plain;
mod streams;

use std::time::Duration;

use load::{Libzmq, Subject, bare, rounds};
use numbers::Interval;
use ztl_tests::lab::Server;

/// Measurements of each, in turn.
const ROUNDS: usize = 21;
const CLIENTS: [usize; 3] = [1, 8, 64];

/// How often the servers are restarted for rates, which differ more between starts than within one.
const STARTS: usize = 7;

/// `test:echo:hi`
const INIT: &str = "/test;1;-1;dGVzdDplY2hvOmhp";

/// Something that can be measured.
type Part = fn(&Bench);

/// The available measurements, by name.
const PARTS: [(&str, Part); 11] = [
    ("rates", rates),
    ("most", alone::most),
    ("cpu", alone::cpu_per_request),
    ("core", alone::on_one_core),
    ("goal", latency::goal_to_result),
    ("end", latency::end_to_known),
    ("idle", alone::idle),
    ("streams", streams::streams),
    ("streams-abort", busy::aborts_beside_images),
    ("streams-recording", busy::recording),
    ("connections", connections::many),
];

/// All that is measured.
struct Bench {
    ours: Server,
    over_libzmq: Server,
    original: Server,
    echo: load::Bare,
    rep: load::Bare,
    router: load::Bare,
    /// How long one measurement takes.
    slice: Duration,
}

impl Bench {
    fn start(slice: Duration) -> Self {
        Self {
            ours: Server::ours(),
            over_libzmq: Server::ours_over("libzmq"),
            original: Server::original(),
            echo: bare("epoll"),
            rep: bare("rep"),
            router: bare("router"),
            slice,
        }
    }

    /// Their rates, each start of them with its share of the rounds.
    fn rates<const N: usize>(&self, of: fn(&Self) -> [Subject; N], clients: usize) -> [Subject; N] {
        let measure = |_| {
            let bench = Self::start(self.slice);
            let mut subjects = of(&bench);
            rounds::<Libzmq>(&mut subjects, clients, bench.slice, ROUNDS / STARTS);
            subjects
        };
        let join = |mut all: [Subject; N], more: [Subject; N]| {
            for (subject, more) in all.iter_mut().zip(more) {
                subject.seen.extend(more.seen);
            }
            all
        };
        (0..STARTS).map(measure).reduce(join).expect("a start")
    }

    /// STATUS of a task that has completed, so that all carry as many bytes.
    fn statuses(&self) -> [Subject; 5] {
        // Of a task that is new: INITs make a server forget it.
        let status = |server: &Server| {
            let mut client = server.original_client();
            let id = client.start("test", "echo", "hi");
            assert_eq!(client.end(id).text, "hi");
            format!("/test;2;{id};status update")
        };
        let (ours, original) = (status(&self.ours), status(&self.original));
        let over_libzmq = status(&self.over_libzmq);
        [
            self.echo.subject("echo", &ours),
            self.router.subject("bare ROUTER", &ours),
            Subject::new("ours", &self.ours, ours, "/test;5;"),
            Subject::new("over libzmq", &self.over_libzmq, over_libzmq, "/test;5;"),
            Subject::new("the original", &self.original, original, "/test;5;"),
        ]
    }

    /// INITs of a trivial task.
    fn inits(&self) -> [Subject; 3] {
        let libzmq = &self.over_libzmq;
        [
            Subject::new("over libzmq", libzmq, INIT.to_owned(), "/test;1;"),
            Subject::new("the original", &self.original, INIT.to_owned(), "/test;1;"),
            Subject::new("ours", &self.ours, INIT.to_owned(), "/test;1;"),
        ]
    }
}

/// With libzmq's clients, which share the cores with the server.
fn rates(bench: &Bench) {
    for clients in CLIENTS {
        println!("STATUS, {clients} clients:");
        let statuses = bench.rates(Bench::statuses, clients);
        show(&statuses, "bare ROUTER");
        println!("INIT of a trivial task, {clients} clients:");
        let inits = bench.rates(Bench::inits, clients);
        show(&inits, "the original");
    }
}

fn find<'s>(subjects: &'s [Subject], name: &str) -> &'s Subject {
    let found = subjects.iter().find(|subject| subject.name == name);
    found.expect("a subject")
}

/// The ratio of the rates.
fn ratio(subjects: &[Subject], one: &str, other: &str) -> Interval {
    let pairs = find(subjects, one)
        .seen
        .iter()
        .zip(&find(subjects, other).seen);
    Interval::of(pairs.map(|(one, other)| one.rate / other.rate))
}

fn show(subjects: &[Subject], base: &str) {
    for subject in subjects {
        let median =
            |value: fn(&load::Seen) -> f64| Interval::of(subject.seen.iter().map(value)).median;
        let of_base = ratio(subjects, subject.name, base);
        println!(
            "  {:<14}{:>9.0}/s  p50 {:>7.0} µs  p99 {:>7.0} µs  {of_base} of {base}",
            subject.name,
            median(|seen| seen.rate),
            median(|seen| seen.p50),
            median(|seen| seen.p99),
        );
    }
}

fn main() {
    if let Ok(kind) = std::env::var("ZTL_BENCH_ECHO") {
        return match kind.as_str() {
            "epoll" => echo::serve(),
            "images" => busy::serve(),
            kind => load::echo(kind),
        };
    }
    // The parts named on the command line, otherwise all; Cargo adds its own arguments.
    let words: Vec<String> = std::env::args().skip(1).collect();
    let named = |name: &str| {
        let is_it = |word: &String| name.strip_prefix(word.as_str());
        let rests = words.iter().filter_map(is_it);
        rests
            .into_iter()
            .any(|rest| rest.is_empty() || rest.starts_with('-'))
    };
    let all = !PARTS.iter().any(|(name, _)| named(name));
    let slice = std::env::var("ZTL_BENCH_SLICE_MS").ok();
    let slice = slice.map_or(100, |text| text.parse().expect("a whole number"));
    let bench = Bench::start(Duration::from_millis(slice));
    println!("{}", numbers::machine());
    for (name, measure) in PARTS {
        if all || named(name) {
            measure(&bench);
        }
    }
    println!("{}", numbers::machine());
}
