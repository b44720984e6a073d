//! Measures what the console must reach. It takes minutes and a quiet machine, so that `cargo xtask bench web` runs it, and
//! `cargo xtask test` does not.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};
use ztl_std::{ExecutableTask, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{PATIENCE, Process, Scratch, connect, port_of, serve, until};

use crate::client::Client;
use crate::console::{Console, node, port, web};
use crate::robot::Slow;

const ROBOTS: usize = 5;
const BROWSERS: usize = 20;
/// Of one robot.
const TASKS_PER_SECOND: u32 = 10;
const TIME: Duration = Duration::from_secs(20);
const STOPS: usize = 20;

/// Tasks of the run that looks at the memory: those of 8 hours at one a second.
const MANY: u32 = 28_800;

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
#[ignore = "measures: cargo xtask bench web"]
fn figures_of_changes() {
    // On machines of their own, browsers do not share its processors.
    changes_with(1);
    changes_with(BROWSERS);
}

/// Prints how long changes take until `BROWSERS` clients have them, of which so many are pages in Chromium.
fn changes_with(pages: usize) {
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
    let (files, clocks) = (Scratch::new(), (Instant::now(), SystemTime::now()));
    let mut driver = Process::start(
        node("driver.mjs")
            .args(["figures", &url])
            .arg(files.path(""))
            .arg(pages.to_string()),
    );
    driver.wait_for("do: measure");
    let over = AtomicBool::new(false);
    let next = AtomicU32::new(0);
    let busy = ztl_tests::lab::processor_time(console.id());
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
        // One client in four, and the last one, reads what it is told; the others only receive it.
        let clients: Vec<_> = (pages..BROWSERS.max(pages + 1))
            .map(|number| {
                let client = Client::open(port(&url));
                let (changes, over) = (&changes, &over);
                scope.spawn(move || match number % 4 == 0 || number >= BROWSERS {
                    true => watch(client, changes, over),
                    false => {
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
    let busy = ztl_tests::lab::processor_time(console.id()) - busy;
    driver.write_line("done");
    let told = driver.end(PATIENCE * 3);
    let told = |what: &str| {
        let mut lines = told.stdout.lines();
        let line = lines.find_map(|line| line.strip_prefix(what));
        serde_json::from_str::<Value>(line.unwrap_or_else(|| panic!("no {what}: {told:?}")))
            .expect("JSON")
    };
    let changed_ms = |change: &(String, bool)| {
        let changed = *changes.lock().expect("no panic").get(change)?;
        let at = clocks.1 + changed.duration_since(clocks.0);
        Some(at.duration_since(UNIX_EPOCH).expect("a time").as_secs_f64() * 1e3)
    };
    println!(
        "{pages} pages beside {} clients without a page:",
        BROWSERS - pages
    );
    let print = |what: &str, delays: Vec<Duration>| {
        let count = delays.len();
        let [half, most, all] = percentiles(delays);
        println!(
            "  change to {what}: {half:.0} ms, 99% {most:.0} ms, at most {all:.0} ms, of {count}"
        );
    };
    print("message of a client without a page", delays);
    for (name, what) in [
        ("heard", "message in a page"),
        ("shown", "document of the page"),
        ("painted", "screen"),
    ] {
        let seen = told(&format!("{name}: "));
        let seen = seen.as_object().expect("times").iter();
        let delays = seen.filter_map(|(change, at)| {
            let (goal, runs) = change.split_once(' ')?;
            let changed = changed_ms(&(goal.to_owned(), runs == "true"))?;
            let delay = (at.as_f64()? - changed).max(0.0) / 1e3;
            Some(Duration::from_secs_f64(delay))
        });
        print(what, delays.collect());
    }
    println!("  processor time of the console in {TIME:?}: {busy:?}");
    println!("  first paint over Fast 3G, in ms: {}", told("paints: "));
}

#[test]
#[ignore = "measures: cargo xtask bench web"]
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

#[test]
#[ignore = "measures: cargo xtask bench web"]
fn figures_of_returns() {
    let mut console = Console::new();
    let directory = console.files.path("");
    let mut driver = Process::start(
        node("driver.mjs")
            .args(["returns_in_time", &console.url])
            .arg(directory),
    );
    for what in ["console", "server"] {
        let mut times = Vec::new();
        for round in 1..=5 {
            let asked = |driver: &Process, verb: &str| {
                until("the page", PATIENCE, || {
                    let said = format!("do: {verb} the {what}\n");
                    (driver.stdout().matches(&said).count() == round).then_some(())
                });
            };
            asked(&driver, "kill");
            match what {
                "console" => console.process.kill(),
                _ => console.robot.process.kill(),
            }
            driver.write_line("done");
            asked(&driver, "start");
            // As long as a person needs, so that the pauses between attempts have become long.
            std::thread::sleep(Duration::from_secs(3));
            match what {
                "console" => console.start_again(),
                _ => console.start_robot_again(),
            }
            let back = SystemTime::now()
                .duration_since(UNIX_EPOCH)
                .expect("a time");
            driver.write_line("done");
            let told = until("the page to be back", PATIENCE, || {
                let stdout = driver.stdout();
                let mut told = stdout
                    .lines()
                    .filter_map(|line| line.strip_prefix(what)?.strip_prefix(": "));
                told.nth(round - 1)?.parse::<f64>().ok()
            });
            times.push(Duration::from_secs_f64(
                (told / 1e3 - back.as_secs_f64()).max(0.0),
            ));
        }
        let [half, _, all] = percentiles(times);
        println!("return of the {what} until the page shows it: {half:.0} ms, at most {all:.0} ms");
    }
}

#[test]
#[ignore = "measures: cargo xtask bench web"]
fn figures_of_memory() {
    let files = Scratch::new();
    let configuration = "scopes: {/test: {arm: {left: {built-in: echo, at-once: 200}}}}\n";
    let robot = crate::console::robot(&files, configuration, ztl_tests::lab::reserve_port());
    let (console, url) = web(0, &[("ours", robot.port)], &[]);
    let mut remote = connect(&format!("tcp://127.0.0.1:{}", robot.port));
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::SeqCst) {
                let mut browser = Client::open(port(&url));
                browser.subscribe("/ztl/robots");
                browser.drain(&over);
            }
        });
        for number in 0..MANY {
            if number % (MANY / 8) == 0 {
                println!(
                    "{number} tasks: the console has {} KiB",
                    console.resident_kib()
                );
            }
            // Each minute of the 8 hours, a page comes, starts a task by the console, and goes.
            if number % 60 == 0 {
                let mut page = Client::open(port(&url));
                let name = format!("the name of page {number}");
                page.call("/ztl/resume", &json!({ "client": name }));
                page.call("/ztl/operate", &json!({}));
                page.goal("g", "/test/arm/left", &json!({ "goal": "x" }));
                page.result("g");
            }
            remote
                .trigger("arm", "left", &number.to_string())
                .expect("it is accepted");
        }
        println!(
            "{MANY} tasks: the console has {} KiB",
            console.resident_kib()
        );
        over.store(true, Ordering::SeqCst);
    });
}
