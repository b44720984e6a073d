//! What the link costs beyond its wire: a client, `ztl gateway`, `ztl line` at a UART's rate and
//! `ztl device`, all as processes of their own, against the time that the bytes themselves take at ten
//! bits each. `cargo xtask bench` runs it.

use std::time::{Duration, Instant};

use ztl_core::link::{ADDR_ONLY_NODE, Body, Frame, LinkId, encode};
use ztl_std::{RemoteId, RemoteTask, State};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, until, ztl};

const BAUDS: [u32; 2] = [115_200, 921_600];
/// Tasks whose INIT is measured.
const TASKS: usize = 200;
/// For how long readings are counted.
const READINGS: Duration = Duration::from_secs(3);
/// Length of a reading of `sim:sensor`.
const READING: f64 = 100.0;
/// Questions in a round, and rounds in turn; the quickest round counts, since a machine that is busy
/// with other things has no typical one.
const QUESTIONS: u32 = 500;
const ROUNDS: usize = 30;

/// A simulated device, a line of this rate (or none at all), and a gateway.
struct Rig {
    gateway: Server,
    _processes: Vec<Process>,
    _scratch: Scratch,
}

impl Rig {
    fn new(kind: &str, baud: Option<u32>) -> Self {
        let scratch = Scratch::new();
        let path = |name: &str| scratch.path(name).display().to_string();
        let mut device = ztl();
        device.args(["device", &format!("sim:{kind}"), "--on"]);
        device.arg(format!("pty:{}", path("device")));
        let mut processes = Vec::new();
        let mut end = path("device");
        if let Some(baud) = baud {
            device.args(["--baud", &baud.to_string()]);
            let mut line = ztl();
            end = path("gateway");
            line.args(["line", &format!("pty:{end}")]);
            line.arg(format!("serial:{}", path("device")));
            processes.push(start(&mut device, "Serve it with"));
            processes.push(start(line.args(["--baud", &baud.to_string()]), "Seed "));
        } else {
            processes.push(start(&mut device, "Serve it with"));
        }
        let gateway = Server::gateway(&[&format!("{kind}=serial:{end}")]);
        gateway.wait_ready(kind);
        Self {
            gateway,
            _processes: processes,
            _scratch: scratch,
        }
    }

    fn client(&self) -> RemoteTask {
        RemoteTask::connect(&self.gateway.endpoint(), SCOPE).expect("an address")
    }

    /// Frames that the gateway has received from its device.
    fn frames(&self) -> u64 {
        let mut devices = ztl();
        let port = self.gateway.port.to_string();
        let told = Process::run(devices.args(["devices", "--json", "-p", &port])).stdout;
        let told: serde_json::Value = serde_json::from_str(&told).expect("JSON");
        let device = told[SCOPE].as_object().and_then(|all| all.values().next());
        device
            .and_then(|device| device["link"]["frames"].as_u64())
            .unwrap_or_else(|| panic!("no count of frames in {told}"))
    }
}

fn start(command: &mut std::process::Command, ready: &str) -> Process {
    let process = Process::start(command);
    process.wait_for(ready);
    process
}

fn frame_len(body: Body<'_>) -> usize {
    let mut buffer = [0; 300];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq: 1,
        body,
    };
    encode(1, &frame, &mut buffer).expect("a frame")
}

/// The time that the bytes of a `Start` and its answer take.
fn floor(baud: u32) -> Duration {
    let task = LinkId(100);
    let start = Body::Start {
        task,
        component: 0,
        goal: GOALS[0],
        before_ms: 5000,
    };
    let bytes = frame_len(start) + frame_len(Body::Started { task });
    Duration::from_secs_f64(bytes as f64 * 10.0 / f64::from(baud))
}

const GOALS: [&str; 2] = ["0.1", "0.2"];

fn percentile(times: &mut [Duration], percent: usize) -> Duration {
    times.sort();
    times[(times.len() * percent / 100).min(times.len() - 1)]
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1000.0
}

/// From an INIT to its answer ACCEPTED.
fn inits(rig: &Rig) -> Vec<Duration> {
    let mut remote = rig.client();
    let mut times = Vec::new();
    for turn in 0..TASKS + 5 {
        let asked = Instant::now();
        let task = remote
            .trigger("gripper", "finger", GOALS[turn % 2])
            .expect("it is taken");
        times.push(asked.elapsed());
        let end = remote.wait(task.id, Some(PATIENCE)).expect("it ends");
        assert_eq!(end.state, State::Completed);
        // Its end is acknowledged, and the line is quiet; not always at the same time after a ping.
        let pause = Duration::from_millis(20 + turn as u64 % 17);
        std::thread::sleep(pause);
    }
    times.split_off(5)
}

fn bench_init() {
    println!("INIT to ACCEPTED, {TASKS} tasks (aim: p50 at most 1.15 times the floor plus 1 ms):");
    let mut bare = inits(&Rig::new("gripper", None));
    let (p50, p95) = (percentile(&mut bare, 50), percentile(&mut bare, 95));
    println!(
        "  without a line       p50 {:>6.3} ms  p95 {:>6.3} ms",
        ms(p50),
        ms(p95)
    );
    for baud in BAUDS {
        let mut times = inits(&Rig::new("gripper", Some(baud)));
        let (p50, p95) = (percentile(&mut times, 50), percentile(&mut times, 95));
        let floor = floor(baud);
        let aim = floor.mul_f64(1.15) + Duration::from_millis(1);
        println!(
            "  {baud:>6} baud          p50 {:>6.3} ms  p95 {:>6.3} ms  floor {:>6.3} ms, aim {:>6.3} ms: {}",
            ms(p50),
            ms(p95),
            ms(floor),
            ms(aim),
            met(p50 <= aim)
        );
    }
}

const fn met(yes: bool) -> &'static str {
    if yes { "met" } else { "missed" }
}

fn bench_readings() {
    println!("readings of 100 bytes, payload of what the wire carries (aim: 85 %):");
    for baud in BAUDS {
        let rig = Rig::new("sensor", Some(baud));
        until("readings come", PATIENCE, || {
            (rig.frames() > 20).then_some(())
        });
        let (first, start) = (rig.frames(), Instant::now());
        std::thread::sleep(READINGS);
        let (last, took) = (rig.frames(), start.elapsed().as_secs_f64());
        // Four of them each second answer a ping.
        let readings = (last - first) as f64 - 4.0 * took;
        let share = readings * READING / took / (f64::from(baud) / 10.0);
        println!(
            "  {baud:>6} baud          {:>7.0} bytes/s  {:.1} %: {}",
            readings * READING / took,
            share * 100.0,
            met(share >= 0.85)
        );
    }
}

/// Seconds for a STATUS and its answer.
fn status(remote: &mut RemoteTask, id: &RemoteId) -> f64 {
    let start = Instant::now();
    for _ in 0..QUESTIONS {
        remote.status(id).expect("an answer");
    }
    start.elapsed().as_secs_f64() / f64::from(QUESTIONS)
}

fn bench_status() {
    println!(
        "a STATUS through the gateway of a device at 115200 baud, beside a server without devices:"
    );
    let plain = Server::ours();
    let mut alone = RemoteTask::connect(&plain.endpoint(), SCOPE).expect("an address");
    let echo = alone
        .trigger("test", "echo", "0.1")
        .expect("it is taken")
        .id;
    let rig = Rig::new("gripper", Some(115_200));
    let mut served = rig.client();
    let run = |remote: &mut RemoteTask, goal: &str| {
        let task = remote.trigger("gripper", "finger", goal);
        task.expect("it is taken").id
    };
    let done = run(&mut served, "0.1");
    served.wait(&done, Some(PATIENCE)).expect("it ends");
    let mut quickest = [f64::MAX; 3];
    for round in 0..ROUNDS {
        let there = run(&mut served, ["99", "1"][round % 2]);
        let moving = status(&mut served, &there);
        served.abort(&there).expect("an answer");
        let ended = status(&mut served, &done);
        let without = status(&mut alone, &echo);
        for (best, time) in quickest.iter_mut().zip([without, ended, moving]) {
            *best = best.min(time);
        }
    }
    let [without, ended, moving] = quickest;
    println!("  without               {:>5.1} us", without * 1e6);
    for (what, time) in [
        ("of a task that ended", ended),
        ("of one that moves", moving),
    ] {
        println!(
            "  {what:<21} {:>5.1} us, {:.2} times as long",
            time * 1e6,
            time / without
        );
    }
}

fn main() {
    bench_init();
    bench_readings();
    bench_status();
}
