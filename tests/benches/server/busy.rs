//! A server that publishes large images beside its tasks, and the recorder of many messages.

use std::io::BufRead as _;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ztl_pickle::Pickle;
use ztl_record::{Content, Reader};
use ztl_std::{
    ExecutableTask, Publisher, TaskContext, TaskController, TaskError, TaskRequest, TaskServer,
};
use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, process_status, processor_time, until, ztl,
};

use crate::numbers::{Interval, percentile, verdict};
use crate::{Bench, ROUNDS};

/// Bytes of an image, and images a second, beside tasks.
const IMAGE: usize = 1_000_000;
const IMAGES: u32 = 30;
/// How long ABORTs are measured at a time: long enough for many images.
const SLICE: Duration = Duration::from_secs(1);
/// Between two tasks.
const PAUSE: Duration = Duration::from_millis(1);
/// The goal is wanted at most so many times slower.
const ABORT: f64 = 1.2;

/// Tasks that run until they are aborted.
struct Endless;

impl TaskController for Endless {
    fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        Ok(Box::new(|context: &TaskContext| {
            context.sleep(Duration::from_secs(3600))?;
            Ok(String::new())
        }))
    }
}

/// A server of endless tasks, as a process. It prints the addresses of its tasks and images; a line of stdin starts or
/// stops the images.
pub(crate) fn serve() {
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    server.register(SCOPE, Endless);
    let server = server.spawn().expect("a thread");
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/camera").expect("a port");
    println!("{}\n{}", server.endpoint(), publisher.endpoint());
    let publishes = AtomicBool::new(false);
    let image = vec![7; IMAGE];
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut next = Instant::now();
            loop {
                if publishes.load(Ordering::Relaxed) {
                    assert!(publisher.publish_bytes("/", &image, false));
                }
                next += Duration::from_secs(1) / IMAGES;
                std::thread::sleep(next.saturating_duration_since(Instant::now()));
            }
        });
        for line in std::io::stdin().lock().lines() {
            publishes.store(line.is_ok_and(|line| line == "on"), Ordering::Relaxed);
        }
        std::process::exit(0);
    });
}

/// Aborts tasks for a while; microseconds until each ABORT was answered, with the task's end.
fn aborts(socket: &zmq::Socket) -> Vec<f64> {
    let ask = |request: &str| {
        socket.send(request, 0).expect("to send");
        let answer = socket.recv_string(0).expect("an answer");
        answer.expect("UTF-8")
    };
    let (start, mut times) = (Instant::now(), Vec::new());
    while start.elapsed() < SLICE {
        let begun = ask(&format!("{SCOPE};1;-1;dGVzdDpzbGVlcDo2MA=="));
        let id = begun.split(';').nth(2).expect("an id").to_owned();
        let asked = Instant::now();
        let ended = ask(&format!("{SCOPE};3;{id};abort command"));
        times.push(asked.elapsed().as_secs_f64() * 1e6);
        assert!(ended.starts_with(&format!("{SCOPE};4;")), "{ended}");
        std::thread::sleep(PAUSE);
    }
    times.sort_by(f64::total_cmp);
    times
}

/// A server whose images are heard by another process.
struct Images {
    server: Process,
    tasks: String,
    subscriber: Process,
}

impl Images {
    fn start() -> Self {
        let program = std::env::current_exe().expect("this program");
        let mut server = Process::start(Command::new(program).env("ZTL_BENCH_ECHO", "images"));
        let (tasks, images) = (server.next_line(PATIENCE), server.next_line(PATIENCE));
        let subscriber = Process::start(ztl().args(["subscribe", &images, "--rate"]));
        Self {
            server,
            tasks,
            subscriber,
        }
    }

    /// Publishes during `act`.
    fn during<T>(&mut self, act: impl FnOnce() -> T) -> T {
        self.server.write_line("on");
        let done = act();
        self.server.write_line("off");
        done
    }
}

/// ABORTs of a server that is quiet, of the same while it publishes images, and while another process does so: what the
/// machine does to it, and not the server. In turn.
pub(crate) fn aborts_beside_images(_: &Bench) {
    let (mut own, mut other) = (Images::start(), Images::start());
    let socket = zmq::Context::new().socket(zmq::REQ).expect("a socket");
    socket.connect(&own.tasks).expect("an address");
    aborts(&socket);
    let mut seen: Vec<[(f64, f64); 3]> = Vec::new();
    for _ in 0..ROUNDS {
        let quiet = aborts(&socket);
        let busy = own.during(|| aborts(&socket));
        let beside = other.during(|| aborts(&socket));
        seen.push(
            [quiet, busy, beside].map(|times| (percentile(&times, 50), percentile(&times, 99))),
        );
    }
    let rates = own.subscriber.stdout();
    let rates = rates.lines().filter_map(|line| line.split(' ').next());
    let heard = rates.flat_map(str::parse).fold(0.0, f64::max);
    println!(
        "ABORT of a running task, until it has ended (µs); {IMAGES} images of {IMAGE} bytes a second, of which {heard:.0} were heard:"
    );
    let names = ["quiet", "the server publishes them", "another process does"];
    for (place, name) in names.into_iter().enumerate() {
        let p50 = Interval::of(seen.iter().map(|row| row[place].0));
        let p99 = Interval::of(seen.iter().map(|row| row[place].1));
        println!("  {name}: p50 {p50}, p99 {p99}");
    }
    let ratio = |base: usize| Interval::of(seen.iter().map(|row| row[1].1 / row[base].1));
    let quiet = ratio(0);
    println!(
        "  p99, of a quiet server's: {quiet}; wanted at most {ABORT}: {}",
        verdict(quiet.stays_below(ABORT))
    );
    println!("  p99, of the one beside another publisher: {}", ratio(2));
}

/// Images and values that are recorded, each second.
const FRAME: usize = 200_000;
const FRAMES: u32 = 30;
const VALUES: u32 = 10_000;
/// Values that are published at a time.
const BATCH: u32 = 10;

/// A recorder of images and values, for `ZTL_RECORD_SECONDS`.
pub(crate) fn recording(_: &Bench) {
    let seconds = std::env::var("ZTL_RECORD_SECONDS").ok();
    let seconds: u32 = seconds.map_or(20, |text| text.parse().expect("a whole number"));
    let scratch = Scratch::new();
    let file = scratch.path("run.mcap");
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/robot").expect("a port");
    let mut command = ztl();
    command.arg("record").arg(&file).arg(publisher.endpoint());
    let recorder = Process::start(&mut command);
    until("the recorder", PATIENCE, || {
        (publisher.subscribers() == 1).then_some(())
    });
    let image = [b"\xff\xd8\xff\xe0".as_slice(), &vec![7; FRAME]].concat();
    let image = Pickle::bytes(&image).expect("bytes").to_bytes();
    let (start, before) = (Instant::now(), processor_time(recorder.id()));
    let mut memory = Vec::new();
    let (mut published, mut dropped) = (0_u64, 0_u64);
    let mut publish = |path: &str, body: &[u8]| match publisher.publish_bytes(path, body, false) {
        true => published += 1,
        false => dropped += 1,
    };
    for turn in 0..seconds * VALUES / BATCH {
        let due = start + Duration::from_secs(1) * BATCH * turn / VALUES;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        for value in 0..BATCH {
            let number = f64::from(turn) + f64::from(value) / 16.0;
            publish(&format!("/joint/{value}"), &Pickle::from(number).to_bytes());
        }
        let turns = VALUES / BATCH;
        if turn * FRAMES / turns != (turn + 1) * FRAMES / turns {
            publish("/camera", &image);
        }
        if turn % turns == 0 {
            memory.push(process_status(recorder.id(), "VmRSS:"));
        }
    }
    let took = start.elapsed().as_secs_f64();
    let spent = (processor_time(recorder.id()) - before).as_secs_f64();
    // What waits is recorded before the end.
    std::thread::sleep(Duration::from_secs(2));
    recorder.signal("INT");
    let ended = recorder.end(PATIENCE);
    let recorded = Reader::open(&file).expect("a file");
    let recorded =
        recorded.filter(|read| matches!(read.content, Content::Value(_) | Content::Image(_)));
    let missing = published - recorded.count() as u64;
    let early = memory.iter().take(memory.len() / 4 + 1).max().copied();
    let late = memory.iter().max().copied();
    let (early, late) = (early.unwrap_or_default(), late.unwrap_or_default());
    println!(
        "Recording {FRAMES} images of {FRAME} bytes and {VALUES} values a second for {took:.0} s:"
    );
    println!(
        "  {published} messages, {missing} missing, {dropped} not published for lack of room; wanted none: {}",
        verdict(missing + dropped == 0)
    );
    println!(
        "  {:.2} of a core; wanted at most 0.5: {}",
        spent / took,
        verdict(spent / took <= 0.5)
    );
    println!(
        "  memory: at most {early} KiB in the first quarter, {late} KiB in all; wanted flat: {}",
        verdict(late <= early + early / 10 + 1024)
    );
    println!("  {}", ended.stdout.trim());
}
