//! From a goal to its result, and from the end of a task until its client knows.

use std::process::Command;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, RemoteTask, State, TaskContext, TaskController, TaskError, TaskRequest,
    TaskServer, Transport,
};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, python};

use crate::load::{Clients, Libzmq, measure};
use crate::numbers::{Interval, percentile, verdict};
use crate::{Bench, INIT, ROUNDS};

/// The original's client. It prints microseconds, as the median of the given number of
/// rounds: from a goal to its result, or from the end of a longer task until the client knows it, because
/// it runs its own server.
const ORIGINAL: &str = r#"
import sys, time, threading, random, logging
logging.disable(logging.CRITICAL)
from ztl.core.client import RemoteTask
from ztl.core.server import TaskServer
from ztl.core.task import TaskController, ExecutableTask
from ztl.core.protocol import Task

ended = [0.0]
class Sleep(ExecutableTask):
    def __init__(self, goal): self.goal = goal
    def execute(self):
        time.sleep(float(self.goal))
        ended[0] = time.perf_counter()
        return "done"
class Controller(TaskController):
    def assign(self, handler, component, goal): return Sleep, goal

own = TaskServer(int(sys.argv[2]))
own.register("/test", Controller())
threading.Thread(target=own.listen, daemon=True).start()
quick = RemoteTask("127.0.0.1", int(sys.argv[1]), "/test")
slow = RemoteTask("127.0.0.1", int(sys.argv[2]), "/test")
print("ready", flush=True)
for line in sys.stdin:
    what, count = line.split()
    times = []
    for _ in range(int(count)):
        if what == "goal":
            begin = time.perf_counter()
            id, _ = quick.trigger(Task.encode("test", "echo", "hi"))
            quick.wait(id, timeout=5)
        else:
            id, _ = slow.trigger(Task.encode("test", "sleep", str(0.03 + random.random() / 10)))
            slow.wait(id, timeout=5)
            begin = ended[0]
        times.append((time.perf_counter() - begin) * 1e6)
    times.sort()
    print(times[len(times) // 2], times[len(times) * 99 // 100], flush=True)
"#;

struct Original(Process);

impl Original {
    fn start(bench: &Bench) -> Self {
        let mut command = Command::new(python());
        command.args(["-c", ORIGINAL, &bench.original.port.to_string()]);
        let mut process = Process::start(command.arg(ztl_tests::lab::reserve_port().to_string()));
        assert_eq!(process.next_line(PATIENCE), "ready");
        Self(process)
    }

    /// Median and 99th percentile, in microseconds.
    fn measure(&mut self, what: &str, count: usize) -> [f64; 2] {
        self.0.write_line(&format!("{what} {count}"));
        let line = self.0.next_line(PATIENCE * 4);
        let mut numbers = line.split(' ').map(|word| word.parse().expect("a number"));
        [(); 2].map(|()| numbers.next().expect("two numbers"))
    }
}

/// Microseconds for a thread to hand over to another, by a lock and a condition: half of there and
/// back.
fn hand_over(slice: Duration) -> f64 {
    let ball = Arc::new((Mutex::new(0u8), Condvar::new()));
    // Waits for the ball, and passes it on as this number; 9 ends the game.
    let play = |ball: &(Mutex<u8>, Condvar), mine: u8, next: u8| {
        let here = ball.0.lock().expect("no panic");
        let mut here = ball
            .1
            .wait_while(here, |here| *here != mine && *here != 9)
            .expect("no panic");
        let over = *here == 9;
        if !over {
            *here = next;
            ball.1.notify_one();
        }
        over
    };
    let other = Arc::clone(&ball);
    let partner = std::thread::spawn(move || while !play(&other, 1, 0) {});
    let (start, mut times) = (Instant::now(), Vec::new());
    while start.elapsed() < slice {
        let begin = Instant::now();
        play(&ball, 0, 1);
        drop(
            ball.1
                .wait_while(ball.0.lock().expect("no panic"), |here| *here != 0),
        );
        times.push(begin.elapsed().as_secs_f64() * 1e6 / 2.0);
    }
    *ball.0.lock().expect("no panic") = 9;
    ball.1.notify_all();
    partner.join().expect("no panic");
    times.sort_by(f64::total_cmp);
    percentile(&times, 50)
}

/// `run`, beside one bare round trip, two hand-overs between threads, and the original.
pub(crate) fn goal_to_result(bench: &Bench) {
    let mut remote = RemoteTask::connect(&bench.ours.endpoint(), SCOPE).expect("an address");
    let bare = bench.rep.subject("bare REP", INIT);
    let mut client = Libzmq::connect(&bare, 1);
    let mut original = Original::start(bench);
    original.measure("goal", 50);
    let libzmq = RemoteTask::connect(&bench.over_libzmq.endpoint(), SCOPE).expect("an address");
    let mut libzmq = libzmq.with_transport(Transport::Libzmq).expect("a socket");
    let run = |remote: &mut RemoteTask| {
        let (start, mut times) = (Instant::now(), Vec::new());
        while start.elapsed() < bench.slice {
            let asked = Instant::now();
            let end = remote.run("test", "echo", "hi", Some(PATIENCE));
            times.push(asked.elapsed().as_secs_f64() * 1e6);
            let end = end.expect("its end");
            assert_eq!(end.state, State::Completed);
        }
        times.sort_by(f64::total_cmp);
        percentile(&times, 50)
    };
    let mut seen: Vec<[f64; 5]> = Vec::new();
    for _ in 0..ROUNDS {
        let ours = run(&mut remote);
        let over_libzmq = run(&mut libzmq);
        let trip = measure(&bare, &mut client, bench.slice);
        let [theirs, _] = original.measure("goal", 100);
        seen.push([ours, trip.p50, hand_over(bench.slice), theirs, over_libzmq]);
    }
    let column = |place: usize| Interval::of(seen.iter().map(|row| row[place])).median;
    println!("From a goal to its result, 1 client (p50):");
    println!(
        "  run {:.0} µs, over libzmq at both ends {:.0} µs; a bare round trip {:.0} µs, a hand-over {:.0} µs; the original {:.0} µs",
        column(0),
        column(4),
        column(1),
        column(2),
        column(3)
    );
    let allowed = Interval::of(seen.iter().map(|row| row[0] / (row[1] + 2.0 * row[2])));
    println!(
        "  run of a round trip and two hand-overs: {allowed}; wanted at most 1: {}",
        verdict(allowed.stays_below(1.0))
    );
    let before = Interval::of(seen.iter().map(|row| row[0] / row[4]));
    println!(
        "  run of the one over libzmq: {before}; wanted at most 0.6: {}",
        verdict(before.stays_below(0.6))
    );
    let theirs = Interval::of(seen.iter().map(|row| row[0] / row[3]));
    println!(
        "  run of the original: {theirs}; C++ actionlib was 0.46 to 0.5 of it: {}",
        verdict(theirs.stays_below(0.46))
    );
}

/// Runs for as many milliseconds as its goal says, and reports when it ended.
struct Lasting(Mutex<Sender<Instant>>);

impl TaskController for Lasting {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let time = request.goal.parse().map(Duration::from_millis);
        let time = time.map_err(|error| error.to_string())?;
        let ended = self.0.lock().expect("no panic").clone();
        Ok(Box::new(move |context: &TaskContext| {
            context.sleep(time)?;
            let _ = ended.send(Instant::now());
            Ok("done".to_owned())
        }))
    }
}

/// From the end of a longer task until a client that waits for it knows.
pub(crate) fn end_to_known(bench: &Bench) {
    let (ended, ends) = channel();
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    server.register(SCOPE, Lasting(Mutex::new(ended)));
    let server = server.spawn().expect("a thread");
    let mut remote = RemoteTask::connect(server.endpoint(), SCOPE).expect("an address");
    let mut times: Vec<f64> = (0..300)
        .map(|number| {
            let goal = (10 + number * 7 % 40).to_string();
            let end = remote.run("h", "c", &goal, Some(PATIENCE));
            let known = Instant::now();
            assert_eq!(end.expect("its end").state, State::Completed);
            let ended = ends.recv().expect("it has ended");
            known.duration_since(ended).as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    let (p50, p99) = (percentile(&times, 50), percentile(&times, 99));
    let [theirs, _] = Original::start(bench).measure("end", 40);
    println!("From the end of a longer task until its client knows:");
    println!(
        "  ours p50 {p50:.3} ms, p99 {p99:.3} ms; wanted 0.3 and 1: {}, {}; the original p50 {:.0} ms",
        verdict(p50 <= 0.3),
        verdict(p99 <= 1.0),
        theirs / 1000.0
    );
}
