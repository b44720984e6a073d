//! Many tasks through one server: none is lost, and the server's memory is bounded.
//!
//! `cargo xtask soak` runs it with a million tasks; the figure is printed.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, Limits, State, TaskContext, TaskController, TaskError, TaskRequest, TaskServer,
    TaskSpec,
};
use ztl_tests::lab::{
    ACCEPTED, OriginalClient, PATIENCE, SCOPE, Server, busy, connect, number, port_of, serve, until,
};

use crate::gate::Gate;

/// Concurrent clients.
const CLIENTS: u32 = 8;
/// As many tasks as a server keeps: until then it grows.
const REMEMBERED: u32 = 10_000;

/// How often the test measures the server's memory.
const PARTS: u32 = 10;

/// Runs this many tasks, shared by all clients; each must complete with its own goal.
fn run(server: &Server, tasks: u32) {
    let remote = connect(&server.endpoint());
    let threads: Vec<_> = (0..CLIENTS)
        .map(|client| {
            let mut remote = remote.clone();
            std::thread::spawn(move || {
                for round in 0..tasks.div_ceil(CLIENTS) {
                    let goal = format!("{client}.{round}");
                    let end = remote.run("test", "echo", &goal, Some(PATIENCE));
                    let end = end.expect("its end");
                    assert_eq!((end.state, end.text), (State::Completed, goal));
                }
            })
        })
        .collect();
    for thread in threads {
        thread.join().expect("every task completes");
    }
}

#[test]
fn a_server_with_a_full_task_table_does_not_grow() {
    let _busy = busy();
    let tasks = u32::try_from(number("ZTL_MANY_TASKS", 5_000)).expect("a small number");
    let server = Server::ours();
    let at_start = server.process.resident_kib();
    run(&server, REMEMBERED.min(tasks));
    let full = server.process.resident_kib();
    let start = Instant::now();
    let parts: Vec<u64> = (0..PARTS)
        .map(|_| {
            run(&server, tasks.div_ceil(PARTS));
            server.process.resident_kib()
        })
        .collect();
    let (took, end) = (start.elapsed(), parts.last().copied().unwrap_or(full));
    println!(
        "{tasks} tasks by {CLIENTS} clients in {took:.1?} ({:.0} a second); resident {at_start} KiB at the start, {full} with {} tasks, then {parts:?}",
        f64::from(tasks) / took.as_secs_f64(),
        REMEMBERED.min(tasks),
    );
    // Threads come and go, and the allocator keeps some memory; a task takes 0.4 KiB or more.
    let room = 4 << 10;
    if tasks >= REMEMBERED {
        assert!(end < full + room, "{full} KiB became {end}");
    }
    assert!(took < Duration::from_secs(3600));
}

/// Goals of running tasks count, too: new tasks are rejected when they fill the memory, and none is dropped.
#[test]
fn running_tasks_goals_that_fill_the_memory_are_rejected() {
    let gate = Gate::default();
    let mut limits = Limits::default();
    limits.memory = 800 << 10;
    let server = TaskServer::builder()
        .limits(limits)
        .bind("tcp://127.0.0.1:*");
    let mut server = server.expect("a port");
    server.register(SCOPE, gate.clone());
    let server = server.spawn().expect("a thread");
    let mut remote = connect(server.endpoint());
    let goal = "x".repeat(50_000);
    let mut taken = Vec::new();
    let rejected = loop {
        match remote.trigger("h", "c", &goal) {
            Ok(task) => taken.push(task.id),
            Err(error) => break error.to_string(),
        }
        assert!(taken.len() < 20, "no goal was rejected");
    };
    assert!(
        rejected.contains("too many tasks are running"),
        "{rejected}"
    );
    assert!(taken.len() >= 5, "{taken:?}");
    for id in &taken {
        assert_eq!(remote.status(id).expect("known").state, State::Accepted);
    }
    gate.open();
    for id in &taken {
        let end = remote.wait(id, Some(PATIENCE)).expect("its end");
        assert_eq!(end.state, State::Completed);
    }
}

/// All its tasks run until the gate is opened.
impl TaskController for Gate {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let (gate, goal) = (self.clone(), request.goal.clone());
        Ok(Box::new(move |_: &TaskContext| {
            gate.wait();
            Ok(goal)
        }))
    }
}

/// Connections of plain libzmq, which send without waiting for replies.
struct Crowd {
    sockets: Vec<zmq::Socket>,
}

/// A server's reply, and how long it took.
struct Said {
    state: i64,
    id: i64,
    text: String,
    after: Duration,
}

impl Crowd {
    fn of(connections: usize, endpoint: &str) -> Self {
        let context = zmq::Context::new();
        let open = |_| {
            let socket = context.socket(zmq::DEALER).expect("a socket");
            socket.set_linger(0).expect("an option");
            socket.connect(endpoint).expect("an address");
            let patience = i32::try_from(PATIENCE.as_millis()).expect("a short time");
            socket.set_rcvtimeo(patience).expect("an option");
            socket
        };
        Self {
            sockets: (0..connections).map(open).collect(),
        }
    }

    /// Sends all requests at once; returns exactly one reply for each, in order.
    #[track_caller]
    fn ask(&self, bodies: &[String]) -> Vec<Said> {
        let start = Instant::now();
        for ((number, body), socket) in (0u32..).zip(bodies).zip(self.sockets.iter().cycle()) {
            let frames: [&[u8]; 3] = [&number.to_le_bytes(), b"", body.as_bytes()];
            socket.send_multipart(frames, 0).expect("to send");
        }
        let mut said: Vec<Option<Said>> = bodies.iter().map(|_| None).collect();
        for socket in self.sockets.iter().cycle().take(bodies.len()) {
            let frames = socket.recv_multipart(0).expect("an answer to each");
            let [number, _, body] = frames.as_slice() else {
                panic!("{frames:?}")
            };
            let number = u32::from_le_bytes(number.as_slice().try_into().expect("a number"));
            let body = std::str::from_utf8(body).expect("a text");
            let fields: Vec<&str> = body.splitn(4, ';').collect();
            let answer = Said {
                state: fields[1].parse().expect("a number"),
                id: fields[2].parse().expect("a number"),
                text: fields[3].to_owned(),
                after: start.elapsed(),
            };
            let place = &mut said[number as usize];
            assert!(place.replace(answer).is_none(), "answered twice: {body}");
        }
        for socket in &self.sockets {
            assert!(socket.recv_bytes(zmq::DONTWAIT).is_err(), "one answer more");
        }
        said.into_iter()
            .map(|said| said.expect("an answer"))
            .collect()
    }
}

fn payload(goal: &str) -> String {
    let spec = TaskSpec {
        handler: "h",
        component: "c",
        goal,
    };
    let mut payload = vec![0; spec.encoded_len()];
    spec.encode_into(&mut payload).expect("it fits").to_owned()
}

/// The default maximum of tasks at once, requested concurrently over plain libzmq:
/// each is answered once and in time and reaches its final state, and those beyond the limit are rejected.
#[test]
fn ten_thousand_concurrent_tasks_are_each_answered_once() {
    let _busy = busy();
    let gate = Gate::default();
    let server = serve(gate.clone());
    let crowd = Crowd::of(100, server.endpoint());
    let (most, beyond) = (Limits::default().running, 50);

    let goals: Vec<String> = (0..most + beyond).map(|n| format!("goal {n}")).collect();
    let inits = goals
        .iter()
        .map(|goal| format!("{SCOPE};1;-1;{}", payload(goal)));
    let said = crowd.ask(&inits.collect::<Vec<_>>());
    let slowest = said.iter().map(|said| said.after).max();
    let mut taken = BTreeMap::new();
    for (said, goal) in said.into_iter().zip(&goals) {
        if said.state == 1 {
            assert!(
                taken.insert(said.id, goal).is_none(),
                "an id twice: {}",
                said.id
            );
        } else {
            assert_eq!(said.text, "too many tasks are running, wait for one to end");
        }
    }
    assert_eq!(taken.len(), most);

    // A client of the original among them.
    let mut original = OriginalClient::connect(port_of(server.endpoint()), SCOPE);
    let one = *taken.keys().next().expect("a task");
    assert_eq!(original.status(one).number, ACCEPTED);

    // A task that has no thread yet would be aborted at once.
    until("a thread for each task", 6 * PATIENCE, || {
        (gate.waiting() >= most).then_some(())
    });
    // The tasks ignore an ABORT; its sender gets a reply before the original's client times out.
    let aborts = taken.keys().take(2000).map(|id| format!("{SCOPE};3;{id};"));
    let aborts: Vec<String> = aborts.collect();
    // After 1.5 s, plus the time that a busy machine takes for so many, as measured with their INITs.
    let limit = Duration::from_millis(2500) + slowest.unwrap_or_default();
    until("an answer to each ABORT in time", 2 * PATIENCE, || {
        let answers = crowd.ask(&aborts);
        let last = answers.iter().map(|said| said.after).max();
        println!("{most} taken within {slowest:?}, 2000 aborts answered within {last:?}");
        for said in answers {
            assert_eq!((said.state, said.text.as_str()), (1, "aborting"));
            let time = said.after;
            assert!(time > Duration::from_millis(1400), "{time:?}");
        }
        (last < Some(limit)).then_some(())
    });

    gate.open();
    until("the end of each", PATIENCE, || {
        let questions = taken.keys().map(|id| format!("{SCOPE};2;{id};"));
        let said = crowd.ask(&questions.collect::<Vec<_>>());
        let all = said.iter().all(|said| said.state == 5);
        for said in said.iter().filter(|said| said.state == 5) {
            assert_eq!(said.text, *taken[&said.id]);
        }
        all.then_some(())
    });
}
