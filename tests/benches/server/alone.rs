//! The cost of a server: CPU time per request, on one core with its client, and while idle.

use std::process::Command;
use std::time::{Duration, Instant};

use ztl_std::RemoteTask;
use ztl_tests::lab::SCOPE;

use crate::load::{Clients, Libzmq, Subject, measure, rounds};
use crate::numbers::{Interval, percentile, verdict};
use crate::plain::Plain;
use crate::{Bench, INIT, ROUNDS, find, ratio, show};

/// How long an idle server is watched.
const IDLE: Duration = Duration::from_secs(10);

/// Keeps a process, with its threads, on these cores.
fn pin(process: u32, cores: &str) {
    let done = Command::new("taskset")
        .args(["--all-tasks", "--cpu-list", "--pid", cores])
        .arg(process.to_string())
        .output();
    let done = done.expect("`taskset` of util-linux");
    assert!(done.status.success(), "{done:?}");
}

/// The cores that this process may use: `0-1`.
fn cores() -> String {
    let status = std::fs::read_to_string("/proc/self/status").expect("its status");
    let allowed = status
        .lines()
        .find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
    allowed.expect("its cores").trim().to_owned()
}

/// Whether server and load can have separate cores; otherwise prints that this part is skipped.
fn has_two_cores(part: &str) -> bool {
    let enough = std::thread::available_parallelism().is_ok_and(|cores| cores.get() > 1);
    if !enough {
        println!("{part}: LEFT OUT, there is one core only");
    }
    enough
}

fn with_pinned(bench: &Bench, servers: &str, load: &str, measure: impl FnOnce(&Bench)) {
    let processes: Vec<u32> = bench.statuses().iter().map(|subject| subject.id).collect();
    let pin_all = |servers: &str, load: &str| {
        for process in &processes {
            pin(*process, servers);
        }
        pin(std::process::id(), load);
    };
    let everywhere = cores();
    pin_all(servers, load);
    measure(bench);
    pin_all(&everywhere, &everywhere);
}

/// STATUS, 64 clients, server and load on cores of their own.
pub(crate) fn cpu_per_request(bench: &Bench) {
    if !has_two_cores("CPU per request") {
        return;
    }
    with_pinned(bench, "1", "0", |bench| {
        println!("CPU time of the server for a STATUS, 64 plain clients, load on another core:");
        let mut statuses = bench.statuses();
        rounds::<Plain>(&mut statuses, 64, bench.slice, ROUNDS);
        for subject in &statuses {
            let cpu = Interval::of(subject.seen.iter().map(|seen| seen.cpu));
            println!("  {:<14}{cpu} µs", subject.name);
        }
        let (ours, echo) = (find(&statuses, "ours"), find(&statuses, "echo"));
        let pairs = ours.seen.iter().zip(&echo.seen);
        let ratio = Interval::of(pairs.map(|(ours, echo)| ours.cpu / echo.cpu));
        let reached = verdict(ratio.stays_below(1.25));
        println!("  ours of echo: {ratio}; wanted at most 1.25: {reached}");
    });
}

/// 64 clients that cost less than the server, which has its own core: the maximum rate.
pub(crate) fn most(bench: &Bench) {
    if !has_two_cores("The most that a server answers") {
        return;
    }
    with_pinned(bench, "1", "0", |bench| {
        println!(
            "The most that a server answers on a core of its own, 64 clients without libzmq on another:"
        );
        println!("STATUS:");
        let mut statuses = bench.statuses();
        rounds::<Plain>(&mut statuses, 64, bench.slice, ROUNDS);
        show(&statuses, "echo");
        for (base, wanted) in [("echo", 0.85), ("bare ROUTER", 1.3)] {
            let level = ratio(&statuses, "ours", base);
            let reached = verdict(level.reaches(wanted));
            println!("  ours of {base}: {level}; wanted {wanted}: {reached}");
        }
        println!("INIT of a trivial task:");
        let bare = [
            bench.rep.subject("bare REP", INIT),
            bench.router.subject("bare ROUTER", INIT),
        ];
        let mut inits: Vec<_> = bare.into_iter().chain(bench.inits()).collect();
        rounds::<Plain>(&mut inits, 64, bench.slice, ROUNDS);
        show(&inits, "the original");
        let times = ratio(&inits, "ours", "the original");
        let reached = verdict(times.reaches(12.0));
        println!("  ours of the original: {times}; wanted 12: {reached}");
        let all = statuses.iter().chain(&inits);
        let load = all.flat_map(|subject| &subject.seen).map(|seen| seen.load);
        let load = load.fold(0.0, f64::max) * 100.0;
        println!("The clients never took more than {load:.0} % of their core.");
    });
}

/// One client, and all of it on one core, so that no core has to be woken up.
pub(crate) fn on_one_core(bench: &Bench) {
    with_pinned(bench, "0", "0", |bench| {
        println!("STATUS, 1 plain client, on one core:");
        let mut statuses = bench.statuses();
        rounds::<Plain>(&mut statuses, 1, bench.slice, ROUNDS);
        show(&statuses, "echo");
        let times = times(&statuses, "ours", "echo");
        let reached = verdict(times.stays_below(1.3));
        println!("  p50 of ours, of echo's: {times}; wanted at most 1.3: {reached}");
        our_client(bench, find(&statuses, "echo"));
        println!("STATUS, 1 client of libzmq, on one core:");
        let mut statuses = bench.statuses();
        rounds::<Libzmq>(&mut statuses, 1, bench.slice, ROUNDS);
        show(&statuses, "bare ROUTER");
        println!("INIT of a trivial task, 1 client, on one core:");
        let mut inits = bench.inits();
        rounds::<Libzmq>(&mut inits, 1, bench.slice, ROUNDS);
        show(&inits, "the original");
    });
}

/// The ratio of the median times until an answer.
fn times(subjects: &[Subject], one: &str, other: &str) -> Interval {
    let pairs = find(subjects, one)
        .seen
        .iter()
        .zip(&find(subjects, other).seen);
    Interval::of(pairs.map(|(one, other)| one.p50 / other.p50))
}

/// STATUS by our client at our server, of what a plain client's echo took.
fn our_client(bench: &Bench, echo: &Subject) {
    let mut remote = RemoteTask::connect(&bench.ours.endpoint(), SCOPE).expect("an address");
    let task = remote.trigger("test", "echo", "hi").expect("a task");
    remote.wait(&task.id, None).expect("its end");
    let mut measure = || {
        let (start, mut times) = (Instant::now(), Vec::new());
        while start.elapsed() < bench.slice {
            let asked = Instant::now();
            remote.status(&task.id).expect("its state");
            times.push(asked.elapsed().as_secs_f64() * 1e6);
        }
        times.sort_by(f64::total_cmp);
        percentile(&times, 50)
    };
    let ours = Interval::of(echo.seen.iter().map(|echo| measure() / echo.p50));
    let reached = verdict(ours.stays_below(1.6));
    println!("  p50 of our client at ours, of echo's: {ours}; wanted at most 1.6: {reached}");
}

/// How often the threads of a process have been put on a core, and how long they were there.
fn turns(process: u32) -> (u64, u64) {
    let threads = std::fs::read_dir(format!("/proc/{process}/task")).expect("its threads");
    let each = threads.flatten().filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        let numbers: Vec<u64> = text.split_whitespace().flat_map(str::parse).collect();
        Some((*numbers.get(2)?, *numbers.first()?))
    });
    each.fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
}

/// Sixty-four clients are connected, have had tasks done, and ask nothing.
pub(crate) fn idle(bench: &Bench) {
    println!("Idle for {IDLE:?}, 64 clients connected:");
    for subject in bench.inits() {
        let mut clients = Libzmq::connect(&subject, 64);
        measure(&subject, &mut clients, bench.slice);
        // Until threads that wait for more tasks have given up.
        std::thread::sleep(Duration::from_secs(12));
        let before = turns(subject.id);
        std::thread::sleep(IDLE);
        let after = turns(subject.id);
        let (wakes, time) = (after.0 - before.0, (after.1 - before.1) / 1000);
        println!(
            "  {:<14}{wakes} wake-ups, {time} µs of CPU time",
            subject.name
        );
        drop(clients);
    }
}
