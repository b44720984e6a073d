//! Ten thousand connections that ask once a second each.

use std::io::{Read, Write};
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, SCOPE, Server, shake_hands, ztl};

use crate::Bench;
use crate::numbers::{percentile, verdict};

/// Bytes before a request's body: delimiter, flags and length.
const BEFORE: [u8; 3] = [1, 0, 0];

/// How long, unless `ZTL_BENCH_SECONDS` says otherwise.
const SECONDS: u64 = 60;

/// Files besides the connections.
const OTHER_FILES: u64 = 200;

pub(crate) fn many(_: &Bench) {
    let most = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let files = most.maximum.unwrap_or(u64::MAX);
    let count = files.saturating_sub(OTHER_FILES).min(10_000);
    let both = rustix::process::Rlimit {
        current: most.maximum,
        ..most
    };
    rustix::process::setrlimit(rustix::process::Resource::Nofile, both).expect("a higher limit");
    let limit = format!("connections={}", count + 10);
    let mut command = ztl();
    command.args(["task-server", "-p", "0", "-s", SCOPE, "--limit", &limit]);
    let server = Server::start_test_server(command);
    let resident = || server.process.resident_kib() * 1024;
    let before = resident();
    let mut streams: Vec<_> = (0..count).map(|_| shake_hands(server.port)).collect();
    let idle = (resident().saturating_sub(before)) as f64 / count as f64;
    let reached = verdict(idle <= 4000.0);
    println!(
        "{count} connections: {idle:.0} bytes each while idle; wanted at most 4000: {reached}"
    );

    let request = format!("{SCOPE};2;99;x");
    let length = u8::try_from(request.len()).expect("a short request");
    let request = [&BEFORE[..], &[length], request.as_bytes()].concat();
    let seconds = std::env::var("ZTL_BENCH_SECONDS").ok();
    let seconds: u64 = seconds.map_or(SECONDS, |text| text.parse().expect("a number"));
    let (mut times, mut sizes) = (Vec::new(), Vec::new());
    let begin = Instant::now();
    let pause = Duration::from_secs(1).div_f64(count as f64);
    let mut answer = vec![0; 256];
    for round in 0..seconds {
        for (number, stream) in streams.iter_mut().enumerate() {
            let due = Duration::from_secs(round) + pause * u32::try_from(number).expect("few");
            if let Some(early) = due.checked_sub(begin.elapsed()) {
                std::thread::sleep(early);
            }
            let asked = Instant::now();
            stream.set_read_timeout(Some(PATIENCE)).expect("a time");
            stream.write_all(&request).expect("room");
            let read = stream.read(&mut answer).expect("an answer");
            assert!(read > 4, "{read} bytes");
            times.push(asked.elapsed().as_secs_f64() * 1e3);
        }
        sizes.push(resident());
    }
    times.sort_by(f64::total_cmp);
    let (p50, p99) = (percentile(&times, 50), percentile(&times, 99));
    let rate = times.len() as f64 / begin.elapsed().as_secs_f64();
    println!(
        "  {rate:.0} requests a second for {seconds} s: p50 {p50:.2} ms, p99 {p99:.2} ms; wanted below 20: {}",
        verdict(p99 < 20.0)
    );
    let (first, last) = (sizes[sizes.len() / 10], sizes[sizes.len() - 1]);
    println!(
        "  memory {} KiB after a tenth of the time, {} KiB at the end",
        first / 1024,
        last / 1024
    );
}
