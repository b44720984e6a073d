//! The cost of decoding, dispatching and answering a STATUS: our server and the original's own
//! code, in turn, in one run. `cargo xtask bench` runs it.
//!
//! Both answer the same bytes about a task that has completed. The original runs its real
//! `TaskServer.listen` with a socket that hands it the request again and again. Since it has no core
//! apart from its socket, its server is measured through that too: what one client sees.

use std::hint::black_box;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use std::time::Instant as Clock;

use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::sink::{Sink, SliceSink};
use ztl_core::{Instant, TaskId};
use ztl_tests::lab::python;

/// Measured this often, the two in turn.
const ROUNDS: usize = 21;
const OURS: u32 = 1_000_000;
const THEIRS: u32 = 20_000;
const ROUND_TRIPS: u32 = 1_000;

const ORIGINAL: &str = r#"
import sys, time, logging
logging.disable(logging.CRITICAL)
from ztl.core.server import TaskServer
from ztl.core.task import TaskController, ExecutableTask
from ztl.core.protocol import Task

class Echo(ExecutableTask):
    def __init__(self, goal): self.goal = goal
    def execute(self): return self.goal

class Controller(TaskController):
    def assign(self, handler, component, goal): return Echo, goal

class Done(BaseException): pass

class Socket:
    def recv(self):
        if self.left == 0: raise Done
        self.left -= 1
        return self.request
    def send(self, answer): self.answer = answer

controller = Controller()
controller.init(Task.encode("test", "echo", "hello world"))
while controller.status(1, "")[0] < 2: time.sleep(0.01)
server = TaskServer.__new__(TaskServer)
server.logger = logging.getLogger("bench")
server.controllers = {"/test": controller}
server.socket = Socket()
server.socket.request = b"/test;2;1;status update"
import threading, zmq
real = TaskServer.__new__(TaskServer)
real.logger, real.controllers = server.logger, server.controllers
real.socket = zmq.Context().socket(zmq.REP)
print(real.socket.bind_to_random_port("tcp://127.0.0.1"), flush=True)
threading.Thread(target=real.listen, daemon=True).start()
for line in sys.stdin:
    server.socket.left = count = int(line)
    start = time.perf_counter_ns()
    try: server.listen()
    except Done: pass
    taken = time.perf_counter_ns() - start
    print(taken / count, server.socket.answer.decode(), flush=True)
"#;

struct Original {
    process: Child,
    /// To its server's real socket.
    client: zmq::Socket,
    answers: BufReader<std::process::ChildStdout>,
}

impl Original {
    fn start() -> Self {
        let mut process = Command::new(python())
            .args(["-c", ORIGINAL])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the original's Python");
        let mut answers = BufReader::new(process.stdout.take().unwrap());
        let mut port = String::new();
        answers.read_line(&mut port).unwrap();
        let client = zmq::Context::new().socket(zmq::REQ).unwrap();
        client
            .connect(&format!("tcp://127.0.0.1:{}", port.trim()))
            .unwrap();
        client.set_rcvtimeo(10_000).unwrap();
        client.set_linger(0).unwrap();
        Self {
            process,
            client,
            answers,
        }
    }

    /// Nanoseconds from a request to its answer, through the socket.
    fn measure_socket(&self) -> f64 {
        let start = Clock::now();
        for _ in 0..ROUND_TRIPS {
            self.client.send("/test;2;1;status update", 0).unwrap();
            self.client.recv_bytes(0).expect("the original answers");
        }
        start.elapsed().as_nanos() as f64 / f64::from(ROUND_TRIPS)
    }

    /// Nanoseconds per answer, and the answer.
    fn measure(&mut self) -> (f64, String) {
        let stdin = self.process.stdin.as_mut().unwrap();
        writeln!(stdin, "{THEIRS}").unwrap();
        let mut line = String::new();
        self.answers.read_line(&mut line).unwrap();
        let (time, answer) = line.trim_end().split_once(' ').unwrap();
        (time.parse().unwrap(), answer.to_owned())
    }
}

type Server = Dispatcher<Fixed<u32, 2, 8, 64, 4>>;

/// A server that knows a completed task, number 1.
fn ours() -> Server {
    let memory = Fixed::new(["/other", "/test"]);
    let mut server = Dispatcher::new(memory, Config::new(TaskId::new(1).unwrap(), 1));
    let now = Instant::from_millis(1);
    let mut out = |_, _: &Reply<'_>| {};
    let init = Body::One(b"/test;1;-1;x");
    let action = server.handle_request(now, 0, None, init, &mut out);
    let Some(Action::Start { id, .. }) = action else {
        panic!("it takes the task");
    };
    server.handle_event(
        now,
        id,
        TaskEvent::Completed {
            result: "hello world",
        },
        &mut out,
    );
    server
}

fn measure(server: &mut Server) -> (f64, String) {
    let mut buffer = [0; 128];
    let mut length = 0;
    let start = Clock::now();
    for turn in 0..OURS {
        let now = Instant::from_micros(u64::from(turn));
        let request = Body::One(black_box(b"/test;2;1;status update"));
        server.handle_request(now, turn, None, request, &mut |_, reply| {
            let mut sink = SliceSink::new(&mut buffer);
            let sink: &mut dyn Sink = &mut sink;
            let mut count = 0;
            reply.put(&mut |bytes: &[u8]| {
                count += bytes.len();
                sink.put(bytes);
            });
            length = count;
        });
        black_box(&buffer);
    }
    let time = start.elapsed().as_nanos() as f64 / f64::from(OURS);
    (time, String::from_utf8(buffer[..length].to_vec()).unwrap())
}

fn median(times: &mut [f64]) -> f64 {
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

fn main() {
    let mut original = Original::start();
    let mut server = ours();
    let (mut times, mut theirs, mut through) = (Vec::new(), Vec::new(), Vec::new());
    let (mut ratios, mut socket_ratios) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let (their_time, their_answer) = original.measure();
        let (our_time, our_answer) = measure(&mut server);
        let socket_time = original.measure_socket();
        assert_eq!(our_answer, their_answer, "both answer the same");
        times.push(our_time);
        theirs.push(their_time);
        through.push(socket_time);
        ratios.push(their_time / our_time);
        socket_ratios.push(socket_time / our_time);
    }
    let _ = original.process.kill();
    let _ = original.process.wait();
    println!("decode, dispatch and answer a STATUS, medians of {ROUNDS} rounds in turn:");
    println!(
        "  ztl-core                        {:>8.0} ns  (aim: below 250)",
        median(&mut times)
    );
    show("the original, without a socket", &mut theirs, &mut ratios);
    show(
        "the original, as a client sees it",
        &mut through,
        &mut socket_ratios,
    );
}

fn show(what: &str, times: &mut [f64], ratios: &mut [f64]) {
    let (time, ratio) = (median(times), median(ratios));
    let (low, high) = (ratios[ROUNDS / 4], ratios[ROUNDS * 3 / 4]);
    println!("  {what:<34}{time:>6.0} ns  {ratio:.0} times (middle half {low:.0} to {high:.0})");
}
