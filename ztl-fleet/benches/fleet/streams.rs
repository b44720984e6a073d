//! Streams: what routing adds to a message, how many messages and bytes pass, how many are missed, and how long an ABORT takes
//! beside them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_std::{Publisher, RemoteTask, State, Subscriber};
use ztl_tests::lab::{LIMIT, PATIENCE, Scratch, Server, connect, start, until};

use crate::hall::Pair;
use crate::{ms, quantile};

/// Messages whose latency is measured, and the pause between two.
const MESSAGES: usize = 2000;
const PAUSE: Duration = Duration::from_millis(2);
/// How long a flood lasts, and the pause after which nothing more of it comes: longer than lost messages hold up others.
const FLOOD: Duration = Duration::from_secs(5);
const QUIET: Duration = Duration::from_secs(4);
/// Sizes of messages in bytes.
const SIZES: [usize; 3] = [100, 10_000, 300_000];
/// ABORTs of each kind.
const ABORTS: usize = 200;

/// A fleet whose robot has a publisher in this process.
struct Flow {
    name: &'static str,
    pair: Pair,
    publisher: Publisher,
    server: Server,
}

impl Flow {
    fn start(scratch: &Scratch, name: &'static str, routers: usize, keys: bool) -> Self {
        let publisher = Publisher::bind("tcp://127.0.0.1:*", "/test").expect("a port");
        let server = Server::naps();
        let at = Some(publisher.endpoint());
        Self {
            name,
            pair: Pair::start(scratch, name, &server, at, routers, keys),
            publisher,
            server,
        }
    }

    /// Subscribers at the endpoint and at the robot's publisher, that hear it.
    fn subscribers(&self) -> [Subscriber; 2] {
        let port = self.pair.publishes.expect("it publishes");
        let far = Subscriber::connect(&format!("tcp://127.0.0.1:{port}"), "/arm/test");
        let near = Subscriber::connect(self.publisher.endpoint(), "/test");
        [far, near].map(|subscriber| {
            let mut subscriber = subscriber.expect("a subscriber");
            until("it hears the robot", PATIENCE, || {
                self.publisher.publish_bytes("/begin", b"", false);
                subscriber.next_within(PAUSE).expect("no fault")
            });
            // What was published meanwhile has come.
            while subscriber
                .next_within(PAUSE * 50)
                .expect("no fault")
                .is_some()
            {}
            subscriber
        })
    }

    /// Publishes as fast as the publisher takes it, until it ends. Returns how many messages.
    fn flood(&self, size: usize, ends: &AtomicBool) -> u64 {
        let body = vec![7; size];
        let mut published = 0;
        while !ends.load(Ordering::Relaxed) {
            match self.publisher.has_room() {
                true => {
                    published += u64::from(self.publisher.publish_bytes("/flood", &body, false))
                }
                false => std::thread::sleep(Duration::from_micros(100)),
            }
        }
        published
    }
}

pub(crate) fn measure() {
    let scratch = Scratch::new();
    let flows = [
        ("one-router-streams", 1, false),
        ("two-routers-streams", 2, false),
        ("sealed-streams", 2, true),
    ];
    let flows = flows.map(|(name, routers, keys)| Flow::start(&scratch, name, routers, keys));
    for flow in &flows {
        latency(flow);
    }
    for flow in &flows {
        for size in SIZES {
            rate(flow, size);
        }
        for flood in std::iter::once(None).chain(SIZES.map(Some)) {
            aborts(flow, flood);
        }
    }
}

/// Ends a flood, also after a panic.
struct Ends<'a>(&'a AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// When each numbered message came.
fn arrivals(subscriber: &mut Subscriber) -> Vec<Option<Instant>> {
    let mut all = vec![None; MESSAGES];
    while all[MESSAGES - 1].is_none() {
        let heard = subscriber.next_within(PATIENCE).expect("no fault");
        let (heard, now) = (heard.expect("a message"), Instant::now());
        if let Ok(number) = heard.body.try_into().map(u64::from_be_bytes) {
            all[usize::try_from(number).expect("a small number")] = Some(now);
        }
    }
    all
}

fn latency(flow: &Flow) {
    let [mut far, mut near] = flow.subscribers();
    let (sent, far, near) = std::thread::scope(|threads| {
        let far = threads.spawn(|| arrivals(&mut far));
        let near = threads.spawn(|| arrivals(&mut near));
        let sent: Vec<Instant> = (0..MESSAGES as u64)
            .map(|number| {
                // The rate is a part of the measurement.
                std::thread::sleep(PAUSE);
                let sent = Instant::now();
                let body = number.to_be_bytes();
                assert!(flow.publisher.publish_bytes("/tick", &body, false));
                sent
            })
            .collect();
        (sent, far.join().unwrap(), near.join().unwrap())
    });
    let after = |arrived: &[Option<Instant>]| -> Vec<Duration> {
        let pairs = arrived.iter().zip(&sent);
        pairs
            .filter_map(|(at, sent)| Some(at.as_ref()?.duration_since(*sent)))
            .collect()
    };
    let (mut far, mut near) = (after(&far), after(&near));
    let mut told = |share| {
        (
            ms(quantile(&mut near, share)),
            ms(quantile(&mut far, share)),
        )
    };
    let (half, most) = (told(0.5), told(0.99));
    println!(
        "{:20} a message every {PAUSE:?}: p50 {:.2} ms directly, {:.2} at the endpoint, {:.2} more; p99 {:.2}, {:.2}, {:.2} more; {} missed",
        flow.name,
        half.0,
        half.1,
        half.1 - half.0,
        most.0,
        most.1,
        most.1 - most.0,
        MESSAGES - far.len(),
    );
}

/// How much of a flood arrives.
fn rate(flow: &Flow, size: usize) {
    let [mut far, _] = flow.subscribers();
    let before = far.missed();
    let ends = AtomicBool::new(false);
    let (published, heard, took) = std::thread::scope(|threads| {
        let hears = threads.spawn(|| {
            let (begun, mut heard, mut last) = (Instant::now(), 0_u64, Instant::now());
            while last.elapsed() < QUIET {
                let next = far
                    .next_within(Duration::from_millis(100))
                    .expect("no fault");
                if next.is_some_and(|next| next.topic == "/arm/test/flood") {
                    (heard, last) = (heard + 1, Instant::now());
                }
            }
            (heard, last - begun)
        });
        let floods = threads.spawn(|| flow.flood(size, &ends));
        // The time is a part of the measurement.
        std::thread::sleep(FLOOD);
        ends.store(true, Ordering::Relaxed);
        let published = floods.join().unwrap();
        let (heard, took) = hears.join().unwrap();
        (published, heard, took)
    });
    let seconds = took.as_secs_f64();
    println!(
        "{:20} a flood of {size} bytes: {:.0} messages and {:.1} MB a second arrive of {:.0} a second that were published; {heard} of {published}, {} told as missed",
        flow.name,
        heard as f64 / seconds,
        heard as f64 * size as f64 / seconds / 1e6,
        published as f64 / FLOOD.as_secs_f64(),
        far.missed() - before,
    );
}

/// How long an ABORT takes until it is answered, and until its task is told to have ended.
fn abort(remote: &mut RemoteTask) -> [Duration; 2] {
    let id = start(remote, "nap", "for", "60");
    let begun = Instant::now();
    remote.abort(id).expect("an answer");
    let answered = begun.elapsed();
    let end = remote.wait(id, LIMIT).expect("its end");
    assert_eq!(end.state, State::Aborted);
    [answered, begun.elapsed()]
}

fn aborts(flow: &Flow, flood: Option<usize>) {
    let [mut far, _] = flow.subscribers();
    let mut ways = [
        ("directly", connect(&flow.server.endpoint())),
        ("routed", flow.pair.client()),
    ];
    let ends = AtomicBool::new(false);
    let mut times: [[Vec<Duration>; 2]; 2] = Default::default();
    std::thread::scope(|threads| {
        let _ends = Ends(&ends);
        if let Some(size) = flood {
            let (flow, ends) = (&flow, &ends);
            threads.spawn(move || flow.flood(size, ends));
            threads.spawn(|| {
                while !ends.load(Ordering::Relaxed) {
                    far.next_within(Duration::from_millis(100))
                        .expect("no fault");
                }
            });
        }
        for _ in 0..ABORTS {
            for ((_, remote), times) in ways.iter_mut().zip(&mut times) {
                for (all, time) in times.iter_mut().zip(abort(remote)) {
                    all.push(time);
                }
            }
        }
    });
    let beside = flood.map_or("beside nothing".to_owned(), |size| {
        format!("beside a flood of {size} bytes")
    });
    for ((way, _), [answered, ended]) in ways.iter().zip(&mut times) {
        println!(
            "{:20} an ABORT {beside}, {way}: answered p50 {:.1} ms, p99 {:.1}, most {:.1}; the task has ended p50 {:.1}, p99 {:.1}, most {:.1}",
            flow.name,
            ms(quantile(answered, 0.5)),
            ms(quantile(answered, 0.99)),
            ms(quantile(answered, 1.0)),
            ms(quantile(ended, 0.5)),
            ms(quantile(ended, 0.99)),
            ms(quantile(ended, 1.0)),
        );
    }
}
