//! Measures what the console must reach, on a quiet machine:
//! `cargo test -p ztl-tests --test web -- --ignored --nocapture figures`.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{connect, port_of, serve};

use crate::client::Client;
use crate::console::{port, web};
use crate::robot::Slow;

const ROBOTS: usize = 5;
const BROWSERS: usize = 20;
/// Of one robot.
const TASKS_PER_SECOND: u32 = 10;
const TIME: Duration = Duration::from_secs(20);
const STOPS: usize = 20;

/// When each goal began and ended.
type Changes = Arc<Mutex<HashMap<(String, bool), Instant>>>;

/// Tasks of a tenth of a second.
struct Short(Changes);

impl TaskController for Short {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let (changes, goal) = (Arc::clone(&self.0), request.goal.clone());
        let note = move |runs| {
            let mut changes = changes.lock().expect("no panic");
            changes.insert((goal.clone(), runs), Instant::now());
        };
        Ok(Box::new(move |context: &TaskContext| {
            note(true);
            context.sleep(Duration::from_millis(100))?;
            note(false);
            Ok::<_, TaskError>(String::new())
        }))
    }
}

/// The 50th, the 99th and the 100th percentile in ms.
fn percentiles(mut times: Vec<Duration>) -> [f64; 3] {
    times.sort();
    let at = |percent: usize| times[(times.len() - 1) * percent / 100].as_secs_f64() * 1e3;
    [at(50), at(99), at(100)]
}

/// How long each change took until a message told it to this client.
fn watch(mut client: Client, changes: &Changes, over: &AtomicBool) -> Vec<Duration> {
    let (mut seen, mut delays) = (HashMap::new(), Vec::new());
    client.subscribe("/ztl/tasks");
    while !over.load(Ordering::SeqCst) {
        let list = client.topic("/ztl/tasks", |_| true);
        let now = Instant::now();
        let changes = changes.lock().expect("no panic");
        for task in list["tasks"].as_array().expect("a list") {
            let goal = task["task"].as_str().expect("a name").rsplit(':').next();
            let change = (goal.expect("a goal").to_owned(), task["runs"] == true);
            if let Some(changed) = changes.get(&change)
                && seen.insert(change, ()).is_none()
            {
                delays.push(now - *changed);
            }
        }
    }
    delays
}

#[test]
#[ignore = "measures on a quiet machine"]
fn figures_of_changes() {
    let changes = Changes::default();
    let servers: Vec<_> = (0..ROBOTS)
        .map(|_| serve(Short(Arc::clone(&changes))))
        .collect();
    let names: Vec<String> = (0..ROBOTS).map(|number| format!("r{number}")).collect();
    let robots = names.iter().zip(&servers);
    let robots: Vec<_> = robots
        .map(|(name, server)| (name.as_str(), port_of(server.endpoint())))
        .collect();
    let (console, url) = web(0, &robots, &[]);
    let over = AtomicBool::new(false);
    let next = AtomicU32::new(0);
    let delays = std::thread::scope(|scope| {
        for server in &servers {
            let (over, next) = (&over, &next);
            scope.spawn(move || {
                let mut remote = connect(server.endpoint());
                while !over.load(Ordering::SeqCst) {
                    let goal = next.fetch_add(1, Ordering::SeqCst).to_string();
                    remote
                        .trigger("arm", "left", &goal)
                        .expect("it is accepted");
                    std::thread::sleep(Duration::from_secs(1) / TASKS_PER_SECOND);
                }
            });
        }
        // One client in four reads what it is told; the others only receive it.
        let clients: Vec<_> = (0..BROWSERS)
            .map(|number| {
                let client = Client::open(port(&url));
                let (changes, over) = (&changes, &over);
                scope.spawn(move || match number % 4 {
                    0 => watch(client, changes, over),
                    _ => {
                        client.drain(over);
                        Vec::new()
                    }
                })
            })
            .collect();
        std::thread::sleep(TIME);
        over.store(true, Ordering::SeqCst);
        clients
            .into_iter()
            .flat_map(|client| client.join().expect("no panic"))
            .collect::<Vec<_>>()
    });
    let cpu = ztl_tests::lab::processor_time(console.id());
    let count = delays.len();
    let [half, most, all] = percentiles(delays);
    println!(
        "change to message: {half:.0} ms, 99% {most:.0} ms, at most {all:.0} ms, of {count}; processor {cpu:?}"
    );
}

#[test]
#[ignore = "measures on a quiet machine"]
fn figures_of_stops() {
    let robot = Slow::default();
    let servers: Vec<_> = (0..ROBOTS).map(|_| serve(robot.clone())).collect();
    let names: Vec<String> = (0..ROBOTS).map(|number| format!("r{number}")).collect();
    let robots = names.iter().zip(&servers);
    let robots: Vec<_> = robots
        .map(|(name, server)| (name.as_str(), port_of(server.endpoint())))
        .collect();
    let (_console, url) = web(0, &robots, &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/tasks");
    let (mut aborts, mut ends) = (Vec::new(), Vec::new());
    for round in 0..STOPS {
        for (number, server) in servers.iter().enumerate() {
            let goal = format!("{round}-{number}");
            connect(server.endpoint())
                .trigger("arm", "left", &goal)
                .expect("it is accepted");
        }
        let all_run = |list: &Value| {
            let tasks = list["tasks"].as_array().expect("a list");
            tasks.iter().filter(|task| task["runs"] == true).count() == ROBOTS
        };
        client.topic("/ztl/tasks", all_run);
        robot.heard.lock().expect("no panic").clear();
        let pressed = Instant::now();
        client.call("/ztl/stop", &json!({}));
        ends.push(pressed.elapsed());
        let heard = robot.heard.lock().expect("no panic");
        assert_eq!(heard.len(), ROBOTS);
        aborts.extend(heard.iter().map(|heard| *heard - pressed));
    }
    let [half, most, all] = percentiles(aborts);
    println!("Stop until a task hears it: {half:.1} ms, 99% {most:.1} ms, at most {all:.1} ms");
    let [half, most, all] = percentiles(ends);
    println!(
        "Stop until {ROBOTS} robots have confirmed: {half:.1} ms, 99% {most:.1} ms, at most {all:.1} ms"
    );
}
