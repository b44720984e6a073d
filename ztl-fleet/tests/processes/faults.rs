//! Many tasks while routers and agents are killed, and connections are cut, silenced and delayed at random: each task acts at
//! most once, and each client is told its true final state or *unknown*.
//!
//! `cargo xtask soak` runs it with 10,000 tasks; the figures are printed.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ztl_std::{
    ExecutableTask, RunningServer, State, TaskContext, TaskController, TaskError, TaskRequest,
    TriggerError,
};
use ztl_tests::lab::{
    LIMIT, PATIENCE, Process, Random, Scratch, number, reserve_port, seed, serve, until,
};

use crate::fleet;
use crate::line::{Line, Mode};
use crate::requests::client;

const ROUTERS: usize = 3;
const ROBOTS: usize = 8;
const CLIENTS: usize = 32;
/// How long a task takes at most, in milliseconds.
const LONGEST: usize = 300;

/// What a robot did for each goal: how often it began, and how it ended.
type Done = Arc<Mutex<BTreeMap<String, (u32, Option<(State, String)>)>>>;

struct Robot(Done);

impl TaskController for Robot {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let (done, goal) = (Arc::clone(&self.0), request.goal.clone());
        Ok(Box::new(move |context: &TaskContext| {
            done.lock().unwrap().entry(goal.clone()).or_default().0 += 1;
            let mut random = Random::new(goal.parse().expect("a number"));
            let time = Duration::from_millis(random.below(LONGEST) as u64);
            context.sleep(time).expect("nobody aborts it");
            let text = format!("result of {goal}");
            let end = match random.once_in(4) {
                true => (State::Failed, Err(TaskError::from(text.clone()))),
                false => (State::Completed, Ok(text.clone())),
            };
            done.lock().unwrap().entry(goal).or_default().1 = Some((end.0, text));
            end.1
        }))
    }
}

/// What a client was told about its task.
#[derive(Debug)]
enum Told {
    /// Its final state and result.
    Ended(State, String),
    /// It may have run.
    Unknown,
}

/// Lines and processes that can fail.
struct Fleet {
    scratch: Scratch,
    routers: Vec<Option<Process>>,
    agents: Vec<Option<Process>>,
    lines: Vec<Line>,
    endpoint: Process,
    _servers: Vec<RunningServer>,
}

impl Fleet {
    fn new(done: &Done) -> Self {
        let scratch = Scratch::new();
        let write = |name: String, text: String| std::fs::write(scratch.path(name), text).unwrap();
        let at: Vec<String> = (0..ROUTERS)
            .map(|_| format!("tcp/127.0.0.1:{}", reserve_port()))
            .collect();
        let mut lines = Vec::new();
        let mut line = |router: usize| {
            lines.push(Line::to(&at[router % ROUTERS]));
            lines.last().expect("a line").address.clone()
        };
        for (router, address) in at.iter().enumerate() {
            let others: Vec<String> = (0..router).map(&mut line).collect();
            let text = format!("listen: {address}\nrouters: [{}]\n", others.join(", "));
            write(format!("router-{router}.yaml"), text);
        }
        let mut servers = Vec::new();
        for robot in 0..ROBOTS {
            let server = serve(Robot(Arc::clone(done)));
            let (near, far) = (line(robot), line(robot + 1));
            let text = format!(
                "name: arm-{robot}\nserver: {}\nrouters: [{near}, {far}]\nstate: arm-{robot}\n",
                server.endpoint()
            );
            write(format!("agent-{robot}.yaml"), text);
            servers.push(server);
        }
        let text = format!("port: 0\nrouters: [{}, {}]\n", line(0), line(1));
        write("endpoint.yaml".to_owned(), text);
        let endpoint = fleet(&["endpoint"], &scratch.path("endpoint.yaml"));
        let mut all = Self {
            routers: (0..ROUTERS).map(|_| None).collect(),
            agents: (0..ROBOTS).map(|_| None).collect(),
            lines,
            endpoint: Process::start(&mut { endpoint }),
            _servers: servers,
            scratch,
        };
        all.mend();
        all
    }

    fn start(&self, what: &str, command: &str, number: usize) -> Process {
        let file = self.scratch.path(format!("{what}-{number}.yaml"));
        Process::start(&mut fleet(&[command], &file))
    }

    /// Starts what was killed, and opens all lines.
    fn mend(&mut self) {
        for line in &self.lines {
            line.set(Mode::Open);
        }
        for router in 0..ROUTERS {
            if self.routers[router].is_none() {
                self.routers[router] = Some(self.start("router", "router", router));
            }
        }
        for robot in 0..ROBOTS {
            if self.agents[robot].is_none() {
                self.agents[robot] = Some(self.start("agent", "join", robot));
            }
        }
    }

    /// Breaks something; returns what.
    fn fault(&mut self, random: &mut Random) -> &'static str {
        match random.below(10) {
            0 => {
                self.routers[random.below(ROUTERS)] = None;
                "routers killed"
            }
            1 | 2 => {
                self.agents[random.below(ROBOTS)] = None;
                "agents killed"
            }
            kind => {
                let (mode, told) = match kind {
                    3 | 4 => (Mode::Cut, "lines cut"),
                    5 | 6 => (Mode::Silent, "lines silent"),
                    _ => {
                        let delay = Duration::from_millis(random.below(400) as u64);
                        (Mode::Slow(delay), "lines delayed")
                    }
                };
                self.lines[random.below(self.lines.len())].set(mode);
                told
            }
        }
    }
}

/// A task of a client, until it is told something. An INIT that was rejected is sent again as another one.
fn task(port: u16, robot: usize, goal: &str, rejected: &AtomicUsize) -> Told {
    let scope = format!("/arm-{robot}/test");
    let mut remote = client(port, &scope);
    let start = Instant::now();
    let mut started = remote.trigger("do", "it", goal);
    let id = loop {
        started = match started {
            Ok(started) => break started.id,
            // Nothing was done, so that it may be sent again.
            Err(TriggerError::Rejected { .. } | TriggerError::NeverCame) => {
                rejected.fetch_add(1, Ordering::Relaxed);
                assert!(
                    start.elapsed() < PATIENCE,
                    "rejected again and again: {goal}"
                );
                // No wait for a condition: a client does not know when the robot is back.
                std::thread::sleep(Duration::from_millis(100));
                remote.trigger("do", "it", goal)
            }
            Err(TriggerError::Request(error)) if error.nothing_was_sent() => {
                remote.trigger("do", "it", goal)
            }
            Err(_) => match remote.ask_outcome() {
                Some(outcome) if start.elapsed() < PATIENCE => outcome,
                _ => return Told::Unknown,
            },
        };
    };
    match remote.wait(id, LIMIT) {
        Ok(end) => Told::Ended(end.state, end.text),
        Err(_) => Told::Unknown,
    }
}

#[test]
fn each_task_acts_at_most_once_and_is_told_truly_while_routers_agents_and_lines_fail() {
    let tasks = usize::try_from(number("ZTL_FLEET_TASKS", 200)).expect("a small number");
    let mut random = Random::new(seed());
    let done = Done::default();
    let mut fleet = Fleet::new(&done);
    let port = fleet.endpoint.wait_for_port("Serving ");
    let mut remote = client(port, "/arm-0/test");
    until("all robots are served", PATIENCE, || {
        let told = remote.describe().ok()??;
        (told.scopes.len() == ROBOTS).then_some(())
    });
    let (next, rejected) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let told: Mutex<BTreeMap<String, Told>> = Mutex::default();
    let is_over = AtomicBool::new(false);
    let mut faults = BTreeMap::<&str, u32>::new();
    let start = Instant::now();
    std::thread::scope(|threads| {
        let clients: Vec<_> = (0..CLIENTS)
            .map(|_| {
                threads.spawn(|| {
                    loop {
                        let goal = next.fetch_add(1, Ordering::Relaxed);
                        if goal >= tasks {
                            return;
                        }
                        let heard = task(port, goal % ROBOTS, &goal.to_string(), &rejected);
                        told.lock().unwrap().insert(goal.to_string(), heard);
                    }
                })
            })
            .collect();
        let breaker = threads.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                *faults.entry(fleet.fault(&mut random)).or_default() += 1;
                // Faults last for a while: some longer than the lease of a connection.
                std::thread::sleep(Duration::from_millis(random.below(800) as u64));
                if random.once_in(4) || next.load(Ordering::Relaxed) >= tasks {
                    fleet.mend();
                }
            }
        });
        let ended: Vec<_> = clients.into_iter().map(|client| client.join()).collect();
        is_over.store(true, Ordering::Relaxed);
        breaker.join().expect("it ends");
        for client in ended {
            client.expect("its tasks end");
        }
    });
    let (told, done) = (told.into_inner().unwrap(), done.lock().unwrap());
    let mut ends = BTreeMap::<String, u32>::new();
    for (goal, told) in &told {
        let (begun, ended) = done.get(goal).cloned().unwrap_or_default();
        assert!(begun <= 1, "task {goal} acted {begun} times");
        let end = match told {
            Told::Ended(state, text) => {
                assert_eq!(ended, Some((*state, text.clone())), "task {goal}");
                state.to_string()
            }
            Told::Unknown => "unknown".to_owned(),
        };
        *ends.entry(end).or_default() += 1;
    }
    assert_eq!(told.len(), tasks);
    println!(
        "{tasks} tasks in {:.0?}: {ends:?}; {} INITs rejected and sent again; {faults:?}",
        start.elapsed(),
        rejected.into_inner()
    );
}
