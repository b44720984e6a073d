//! How long an ABORT takes, in a quiet `ztl serve` and in one that publishes large images.

use std::time::{Duration, Instant};

use ztl_std::{RemoteTask, State, Subscriber};
use ztl_tests::lab::{PATIENCE, SCOPE, Scratch, Server, start, ztl};

use crate::numbers::{Interval, percentile, verdict};
use crate::{Bench, ROUNDS};

/// Bytes of an image.
const IMAGE: usize = 1_000_000;
/// ABORTs of one measurement, spread over some images.
const ABORTS: usize = 200;
const PAUSE: Duration = Duration::from_millis(5);

/// Writes 30 images a second.
const CAMERA: &str = "\
import sys, time
image = b'\\7' * 1000000
due = time.monotonic()
while True:
    sys.stdout.buffer.write(image)
    sys.stdout.buffer.flush()
    due += 1 / 30
    time.sleep(max(0, due - time.monotonic()))
";

/// `ztl serve` with a task that lasts and can be aborted.
fn server(streams: &str) -> Server {
    let scratch = Scratch::new();
    std::fs::write(scratch.path("camera.py"), CAMERA).expect("a file");
    let file = scratch.path("robot.yaml");
    let text = format!("port: 0\n{streams}scopes: {{{SCOPE}: {{nap: {{for: sleep}}}}}}\n");
    std::fs::write(&file, text).expect("a file");
    Server::start(ztl().arg("serve").arg(file))
}

/// The 99th percentile of ABORTs, in milliseconds.
fn aborts(remote: &mut RemoteTask) -> f64 {
    let mut times: Vec<f64> = (0..ABORTS)
        .map(|_| {
            let id = start(remote, "nap", "for", "60");
            std::thread::sleep(PAUSE);
            let asked = Instant::now();
            let status = remote.abort(id).expect("an answer");
            let time = asked.elapsed().as_secs_f64() * 1e3;
            assert_eq!(status.state, State::Aborted);
            time
        })
        .collect();
    times.sort_by(f64::total_cmp);
    percentile(&times, 99)
}
