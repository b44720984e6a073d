//! Actions of ROS 1: our client beside the C++ client of actionlib, with one server in C++. `cargo xtask bench ros1` runs it.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::time::{ClockId, clock_gettime};
use ztl_ros1::{ActionClient, ActionTypes, Config, GoalEvent, Node, WireType};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, process_status, processor_time, reserve_port, until,
};

/// Goals that are measured, and as many cancels.
const GOALS: usize = 2000;
/// Feedbacks, one a millisecond.
const FEEDBACKS: i32 = 5000;
/// Goals after which the memory is looked at, and how often.
const MANY: u32 = 20_000;
const LOOKS: u32 = 5;

fn main() {
    let scratch = Scratch::new();
    let (server, client) = (compile(&scratch, "server"), compile(&scratch, "client"));
    let port = reserve_port();
    let master = format!("http://127.0.0.1:{port}");
    let run = |program: &Path, argument: &str| {
        let mut command = Command::new(program);
        command.env("ROS_MASTER_URI", &master);
        command.env("ROS_HOSTNAME", "127.0.0.1");
        command.env("ROS_LOG_DIR", scratch.path(""));
        Process::start(command.arg(argument))
    };
    let mut command = Command::new("rosmaster");
    command.env("ROS_LOG_DIR", scratch.path(""));
    let _master = Process::start(command.args(["--core", "-p", &port.to_string()]));
    until("the master listens", PATIENCE, || {
        std::net::TcpStream::connect(("127.0.0.1", port)).ok()
    });
    let mut served = run(&server, "");
    served.wait_for("ready");
    served.next_line(PATIENCE);

    println!(
        "{GOALS} goals, in microseconds:      goal to accepted    goal to result    cancel to callback"
    );
    let ended = run(&client, &GOALS.to_string()).end(PATIENCE * 30);
    let lines = ended.stdout.lines().map(str::to_owned);
    report("actionlib in C++", lines.collect(), &mut served);

    let node = Node::start(&Config {
        master: master.clone(),
        host: Some("127.0.0.1".to_owned()),
        name: "bench".to_owned(),
    });
    let node = node.expect("a node");
    let action = node.action("/bench", types()).expect("the action");
    report("ztl-ros1", ours(&action), &mut served);

    let feed = Running::send(&action, FEEDBACKS);
    let own = std::process::id();
    let (start, before) = (Instant::now(), processor_time(own));
    let count = feed.wait(|event| matches!(event, GoalEvent::Ended(_)));
    let (took, used) = (start.elapsed(), processor_time(own) - before);
    let share = 100.0 * used.as_secs_f64() / took.as_secs_f64();
    println!(
        "{} feedbacks in {took:.1?}: {share:.1} % of a core",
        count - 2
    );

    let start = Instant::now();
    let goals: Vec<_> = (0..50).map(|_| Running::send(&action, 1)).collect();
    for goal in goals {
        goal.wait(|event| matches!(event, GoalEvent::Ended(_)));
    }
    println!("50 goals at once: {:.1?}", start.elapsed());

    for look in 0..=LOOKS {
        println!(
            "after {} goals: {} KiB",
            look * MANY,
            process_status(own, "VmRSS:")
        );
        for _ in 0..if look < LOOKS { MANY } else { 0 } {
            Running::send(&action, 1).wait(|event| matches!(event, GoalEvent::Ended(_)));
        }
    }
    node.stop();
}

/// Compiles a program beside this file.
fn compile(scratch: &Scratch, name: &str) -> PathBuf {
    let source = format!("{}/benches/ros1/{name}.cpp", env!("CARGO_MANIFEST_DIR"));
    let program = scratch.path(name);
    let script = "c++ -O2 -o $0 $1 $(pkg-config --cflags --libs actionlib) -lpthread";
    let status = Command::new("sh")
        .args(["-c", script])
        .arg(&program)
        .arg(source)
        .status();
    assert!(
        status.expect("`sh`").success(),
        "{name}: install libactionlib-dev"
    );
    program
}

/// The same as `client.cpp`.
fn ours(action: &ActionClient) -> Vec<String> {
    let mut lines = Vec::new();
    for round in 0..2 * GOALS {
        let cancels = round >= GOALS;
        let start = Instant::now();
        let running = Running::send(action, if cancels { 4 } else { 1 });
        running.wait(|event| *event == GoalEvent::Accepted);
        let accepted = start.elapsed();
        if cancels {
            let now = clock_gettime(ClockId::Monotonic);
            lines.push((now.tv_sec * 1_000_000_000 + now.tv_nsec).to_string());
            running.goal.cancel();
        }
        running.wait(|event| matches!(event, GoalEvent::Ended(_)));
        if !cancels {
            let ended = start.elapsed();
            lines.push(format!("{} {}", accepted.as_nanos(), ended.as_nanos()));
        }
    }
    lines
}

fn report(name: &str, lines: Vec<String>, server: &mut Process) {
    let number = |word: &str| word.parse::<f64>().expect("a number");
    let mut columns = [Vec::new(), Vec::new(), Vec::new()];
    for line in lines {
        match line.split_once(' ') {
            Some((accepted, ended)) => {
                columns[0].push(number(accepted));
                columns[1].push(number(ended));
            }
            None => columns[2].push(number(&server.next_line(PATIENCE)) - number(&line)),
        }
    }
    let cells = columns.map(|mut times| {
        times.sort_by(f64::total_cmp);
        let part = |percent: usize| times[(times.len() - 1) * percent / 100] / 1000.0;
        format!("{:5.0} (p99 {:5.0})", part(50), part(99))
    });
    println!("{name:30}  {}", cells.join("   "));
}

struct Running {
    goal: ztl_ros1::Goal,
    events: Receiver<GoalEvent>,
}

impl Running {
    fn send(action: &ActionClient, goal: i32) -> Self {
        let (told, events) = channel();
        let content = goal.to_le_bytes().to_vec();
        let goal = action.send_goal(content, move |event| drop(told.send(event)));
        Self { goal, events }
    }

    /// Waits for an event; returns how many there were.
    fn wait(&self, is_it: impl Fn(&GoalEvent) -> bool) -> usize {
        let mut count = 1;
        loop {
            let event = self.events.recv_timeout(Duration::from_secs(60));
            if is_it(&event.expect("an event")) {
                return count;
            }
            count += 1;
        }
    }
}

/// `actionlib/TestAction`
fn types() -> ActionTypes {
    let of = |part: &str, md5: &str| WireType {
        name: format!("actionlib/TestAction{part}"),
        md5: md5.to_owned(),
        definition: String::new(),
    };
    ActionTypes {
        goal: of("Goal", "348369c5b403676156094e8c159720bf"),
        feedback: of("Feedback", "6d3d0bf7fb3dda24779c010a9f3eb7cb"),
        result: of("Result", "3d669e3a63aa986c667ea7b0f46ce85e"),
    }
}
