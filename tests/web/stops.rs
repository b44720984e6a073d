//! What a Stop reaches, and what it may confirm.

mod counts;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use ztl_std::{Access, RemoteTask, TaskServer};
use ztl_tests::lab::{
    Keys, PATIENCE, Process, SCOPE, Scratch, Server, connect, port_of, process_status,
    reserve_port, serve, until, ztl,
};

use crate::client::Client;
use crate::console::{port, web};
use crate::robot::{Scripted, Slow, listed, probed};

/// What a Stop has confirmed, and the reason, of each robot.
fn told(stop: &Value) -> Vec<(bool, String)> {
    let robots = stop["robots"].as_array().expect("robots");
    let told = robots.iter().map(|robot| {
        let confirmed = robot["confirmed"].as_bool().expect("decided");
        (
            confirmed,
            robot["text"].as_str().expect("a text").to_owned(),
        )
    });
    told.collect()
}

/// A console for one robot at this port, and a client of it that hears of the tasks.
fn console(robot: u16) -> (Process, Client) {
    let (process, url) = web(0, &[("ours", robot)], &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/tasks");
    (process, client)
}

/// Repeats an attempt until it sends exactly so many ABORTs. One is sent again after 1.7 s, so a busy machine sends more.
#[track_caller]
fn sends_aborts(count: usize, mut attempt: impl FnMut() -> Option<usize>) {
    until(&format!("{count} ABORTs"), PATIENCE, || {
        let sent = attempt()?;
        assert!(sent >= count, "{sent}");
        (sent == count).then_some(())
    });
}

#[test]
fn five_tasks_that_are_slow_to_stop_hear_of_it_within_100_ms() {
    let robot = Slow {
        stopping: Duration::from_secs(1),
        ..Slow::default()
    };
    let server = serve(robot.clone());
    let (_console, mut client) = console(port_of(server.endpoint()));
    let started = Instant::now();
    // A busy machine delays some attempts, a defect delays all.
    let mut slowest = Duration::MAX;
    while slowest > Duration::from_millis(100) {
        assert!(
            started.elapsed() < 2 * PATIENCE,
            "the slowest heard after {slowest:?}"
        );
        for number in 0..5 {
            let id = format!("{:?}-{number}", started.elapsed());
            client.goal(&id, "/test/arm/left", &json!({ "goal": "up" }));
        }
        let five = |list: &Value| {
            let tasks = list["tasks"].as_array().expect("a list");
            tasks.iter().filter(|task| task["runs"] == true).count() == 5
        };
        client.topic("/ztl/tasks", five);
        robot.heard.lock().expect("no panic").clear();
        let pressed = Instant::now();
        let stop = client.call("/ztl/stop", &json!({}));
        assert_eq!(told(&stop), [(true, "5 tasks have ended".to_owned())]);
        let heard = robot.heard.lock().expect("no panic");
        assert_eq!(heard.len(), 5);
        slowest = heard
            .iter()
            .map(|heard| *heard - pressed)
            .max()
            .expect("five");
    }
}

#[test]
fn a_lost_abort_is_sent_again() {
    sends_aborts(2, || {
        let aborts = Arc::new(AtomicUsize::new(0));
        let seen = Arc::clone(&aborts);
        let robot = Scripted::start(move |request| {
            let running: &[u32] = if seen.load(Ordering::SeqCst) < 2 {
                &[5]
            } else {
                &[]
            };
            match request {
                "$ztl;2;-1;probe" => Some(probed(running)),
                "$ztl;2;-1;tasks" => Some(listed()),
                "/test;3;5;abort command" if seen.fetch_add(1, Ordering::SeqCst) == 0 => None,
                _ => Some("/test;4;5;True".to_owned()),
            }
        });
        let (_console, mut client) = console(robot.port);
        client.task(|task| task["id"] == 5);
        let stop = client.call("/ztl/stop", &json!({}));
        // On a busy machine the second ABORT may have ended the task after the 4 s of a Stop.
        let is_told = told(&stop) == [(true, "1 task has ended".to_owned())];
        is_told.then(|| aborts.load(Ordering::SeqCst))
    });
}

#[test]
fn a_server_without_an_answer_is_named_in_time_and_delays_no_other() {
    let robot = Slow::default();
    let server = serve(robot.clone());
    let (ours, silent) = (port_of(server.endpoint()), Scripted::start(|_| None));
    let (_console, url) = web(0, &[("ours", ours), ("silent", silent.port)], &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/tasks");
    client.goal("g", "ours:/test/arm/left", &json!({ "goal": "up" }));
    client.task(|task| task["runs"] == true);
    // A busy machine delays some attempts, a defect delays all.
    until("a Stop in time", PATIENCE, || {
        let mut client = Client::open(port(&url));
        client.subscribe("/ztl/stop");
        let pressed = Instant::now();
        client.ask("stop", "/ztl/stop", &json!({}));
        client.topic("/ztl/stop", |stop| {
            stop["robots"][0]["confirmed"] == true && stop["robots"][1]["confirmed"].is_null()
        });
        let confirmed = pressed.elapsed();
        let stop = told(&client.answer("stop")["values"]);
        assert!(!stop[1].0 && stop[1].1.contains("no answer"), "{stop:?}");
        let [soon, late] = [3, 6].map(Duration::from_secs);
        (confirmed < soon && pressed.elapsed() < late).then_some(())
    });
    assert_eq!(robot.running.load(Ordering::SeqCst), 0);
}

#[test]
fn a_task_that_starts_during_a_stop_is_aborted_before_that_confirms() {
    let robot = Slow {
        accepting: Duration::from_secs(1),
        ..Slow::default()
    };
    let server = serve(robot.clone());
    let (_console, mut client) = console(port_of(server.endpoint()));
    client.goal("g", "/test/arm/left", &json!({ "goal": "up" }));
    until("the INIT", PATIENCE, || {
        (robot.given.load(Ordering::SeqCst) == 1).then_some(())
    });
    let stop = client.call("/ztl/stop", &json!({}));
    assert_eq!(told(&stop), [(true, "1 task has ended".to_owned())]);
    assert_eq!(robot.running.load(Ordering::SeqCst), 0);
    let result = client.result("g");
    assert_eq!(result["values"]["state"], "ABORTED", "{result}");
    client.goal("h", "/test/arm/left", &json!({ "goal": "up" }));
    until("the next task", PATIENCE, || {
        (robot.given.load(Ordering::SeqCst) == 2).then_some(())
    });
}

#[test]
fn a_goal_during_a_stop_is_refused() {
    let silent = Scripted::start(|_| None);
    let (_console, mut client) = console(silent.port);
    client.ask("stop", "/ztl/stop", &json!({}));
    client.goal("g", "/test/arm/left", &json!({ "goal": "up" }));
    let result = client.result("g");
    assert!(
        result["values"]
            .as_str()
            .expect("why")
            .contains("a Stop is under way"),
        "{result}"
    );
    assert!(!told(&client.answer("stop")["values"])[0].0);
}

#[test]
fn a_second_press_reaches_what_started_after_the_first_one() {
    let robot = Slow::default();
    let server = serve(robot.clone());
    let (ours, silent) = (port_of(server.endpoint()), Scripted::start(|_| None));
    let (_console, url) = web(0, &[("ours", ours), ("silent", silent.port)], &[]);
    let [mut one, mut two] = [(); 2].map(|()| Client::open(port(&url)));
    one.subscribe("/ztl/stop");
    one.ask("first", "/ztl/stop", &json!({}));
    one.topic("/ztl/stop", |stop| stop["robots"][0]["confirmed"] == true);
    // Somebody else starts a task while the first Stop waits for the other robot.
    let mut remote = connect(server.endpoint());
    remote.trigger("arm", "left", "up").expect("it is accepted");
    let stop = two.call("/ztl/stop", &json!({}));
    assert_eq!(told(&stop)[0], (true, "1 task has ended".to_owned()));
    assert_eq!(robot.running.load(Ordering::SeqCst), 0);
    assert!(told(&one.answer("first")["values"])[0].0);
}

#[test]
fn a_thousand_presses_and_aborts_need_no_thread_and_delay_no_other() {
    let silent = Scripted::start(|_| None);
    let (console, mut client) = console(silent.port);
    for number in 0..1000 {
        client.ask(&number.to_string(), "/ztl/stop", &json!({}));
    }
    let refused = client.answer("999");
    assert!(
        refused["values"]
            .as_str()
            .expect("why")
            .contains("answers are awaited"),
        "{refused}"
    );
    let task = |number: u32| json!({ "robot": "ours", "scope": SCOPE, "id": number });
    for number in 1..=1000 {
        client.ask(&format!("a{number}"), "/ztl/abort", &task(number));
    }
    let refused = client.answer("a1000");
    let why = refused["values"].as_str().expect("why");
    assert!(why.contains("not sent: 64 aborts are under way"), "{why}");
    let threads = process_status(console.id(), "Threads:");
    assert!(threads < 10, "{threads}");
    assert!(!told(&client.answer("0")["values"])[0].0);
    assert!(client.call("/ztl/robots", &json!({}))["robots"].is_array());
}

#[test]
fn a_task_in_a_scope_that_the_key_may_not_use_is_not_called_stopped() {
    let keys = Keys::make(&["robot", "all", "some"]);
    let access = Access::everybody().with_keys(keys.pair("robot"));
    let access = access.allow(keys.pair("all").public());
    let access = access.allow_scope(SCOPE, keys.pair("some").public());
    let robot = Slow::default();
    let mut server = TaskServer::builder()
        .access(access)
        .bind("tcp://127.0.0.1:*")
        .expect("a port");
    for scope in [SCOPE, "/other"] {
        server.register(scope, robot.clone());
    }
    let server = server.spawn().expect("a thread");
    let files = Scratch::new();
    let file = files.path("remotes.yaml");
    let entry = |scope: &str, key: &str| {
        let (port, key) = (
            port_of(server.endpoint()),
            keys.path(&format!("{key}.key_secret")),
        );
        let own = keys.path("robot.key");
        format!("{{host: 127.0.0.1, port: {port}, scope: {scope}, key: {key}, server-key: {own}}}")
    };
    let text = format!("remotes:\n  some: {}\n", entry(SCOPE, "some"));
    std::fs::write(&file, text).expect("a file");
    let start = || {
        let process = Process::start(ztl().args(["web", "-p", "0", "-c"]).arg(&file));
        let url = process.wait_for("http://");
        (Client::open(port(&url)), process)
    };
    let (mut client, console) = start();
    let other = RemoteTask::connect(server.endpoint(), "/other").expect("an address");
    let other = other.with_keys(keys.pair("all"), keys.pair("robot").public());
    other
        .expect("encryption")
        .with_timeout(PATIENCE)
        .trigger("arm", "left", "up")
        .expect("it is accepted");
    let stop = client.call("/ztl/stop", &json!({}));
    let why = "1 more run in scopes that this client may not use".to_owned();
    assert_eq!(told(&stop), [(false, why)]);
    assert_eq!(robot.running.load(Ordering::SeqCst), 1);
    drop(console);
    // The same server with another key is another one: the key that may see the task stops it.
    let both = format!(
        "remotes:\n  all: {}\n  some: {}\n",
        entry("/other", "all"),
        entry(SCOPE, "some")
    );
    std::fs::write(&file, both).expect("a file");
    let (mut client, _console) = start();
    let stop = client.call("/ztl/stop", &json!({}));
    assert!(
        told(&stop).iter().all(|(confirmed, _)| *confirmed),
        "{stop}"
    );
    assert_eq!(robot.running.load(Ordering::SeqCst), 0);
}

#[test]
fn a_scope_that_the_server_does_not_show_is_not_called_stopped() {
    let server = serve(Slow::default());
    let port_there = port_of(server.endpoint()).to_string();
    let mut command = ztl();
    command.args(["web", "-c", "/dev/null", "-p", "0"]);
    let process =
        Process::start(command.args(["--task", "x", "127.0.0.1", &port_there, "/elsewhere"]));
    let url = process.wait_for("http://");
    let stop = Client::open(port(&url)).call("/ztl/stop", &json!({}));
    let told = told(&stop);
    assert!(
        !told[0].0 && told[0].1.contains("does not serve /elsewhere"),
        "{told:?}"
    );
}

#[test]
fn an_abort_is_answered_with_what_became_of_it_and_never_waits_behind_goals() {
    let robot = Slow::default();
    let server = serve(robot.clone());
    let (_console, mut client) = console(port_of(server.endpoint()));
    client.goal("long", "/test/arm/left", &json!({ "goal": "up" }));
    let task = client.task(|task| task["runs"] == true);
    for number in 0..300 {
        client.goal(
            &format!("n{number}"),
            "/test/nothing",
            &json!({ "goal": "x" }),
        );
    }
    let refused = client.result("n299");
    assert!(
        refused["values"]
            .as_str()
            .expect("why")
            .contains("too many"),
        "{refused}"
    );
    let named = json!({ "robot": task["robot"], "scope": task["scope"], "id": task["id"] });
    let told = client.call("/ztl/abort", &named);
    assert_eq!(told["state"], "ABORTED", "{told}");
    assert_eq!(robot.running.load(Ordering::SeqCst), 0);
    let unknown = json!({ "robot": "ours", "scope": SCOPE, "id": 1 });
    client.ask("unknown", "/ztl/abort", &unknown);
    let told = client.answer("unknown");
    assert_eq!(told["result"], false);
    assert!(
        told["values"]
            .as_str()
            .expect("why")
            .contains("may still run"),
        "{told}"
    );
    // Of a robot that cannot be reached.
    let (_console, url) = web(0, &[("gone", reserve_port())], &[]);
    let mut client = Client::open(port(&url));
    let told = client.call(
        "/ztl/abort",
        &json!({ "robot": "gone", "scope": SCOPE, "id": 1 }),
    );
    assert!(
        told.as_str().expect("why").contains("may still run"),
        "{told}"
    );
}

#[test]
fn a_cancel_is_repeated_until_it_is_answered() {
    sends_aborts(2, || {
        let aborts = Arc::new(AtomicUsize::new(0));
        let seen = Arc::clone(&aborts);
        let robot = Scripted::start(move |request| match request {
            "$ztl;2;-1;probe" => Some(probed(&[5])),
            "$ztl;2;-1;tasks" => Some(listed()),
            "/test;3;5;abort command" => {
                (seen.fetch_add(1, Ordering::SeqCst) >= 1).then(|| "/test;4;5;True".to_owned())
            }
            init if init.starts_with("/test;1;") => Some("/test;1;5;moving".to_owned()),
            _ if seen.load(Ordering::SeqCst) >= 2 => Some("/test;4;5;stopped".to_owned()),
            _ => Some("/test;1;5;None".to_owned()),
        });
        let (_console, mut client) = console(robot.port);
        client.goal("g", "/test/arm/left", &json!({ "goal": "up" }));
        client.next(|message| message["op"] == "action_feedback");
        client.send(&json!({ "op": "cancel_action_goal", "id": "g", "action": "/test/arm/left" }));
        let result = client.result("g");
        assert_eq!(result["values"]["state"], "ABORTED", "{result}");
        Some(aborts.load(Ordering::SeqCst))
    });
}

#[test]
fn a_server_of_the_original_is_told_to_stop_each_goal_of_this_console() {
    let robot = Server::original_with_patient_tasks();
    let (_console, mut client) = console(robot.port);
    for id in ["a", "b"] {
        client.goal(id, "/test/nap/for", &json!({ "goal": id }));
        client.task(|task| task["task"] == format!("nap:for:{id}"));
    }
    let stop = client.call("/ztl/stop", &json!({}));
    for id in ["a", "b"] {
        robot.process.wait_for(&format!("abort {id}"));
    }
    let told = told(&stop);
    assert!(
        !told[0].0 && told[0].1.contains("2 of this console were asked to stop"),
        "{told:?}"
    );
}

#[test]
fn a_task_of_the_original_whose_state_cannot_be_learnt_is_shown_and_stopped() {
    let robot = Server::original_with_patient_tasks();
    let (_console, mut client) = console(robot.port);
    client.goal("g", "/test/nap/for", &json!({ "goal": "mute" }));
    let result = client.result("g");
    assert_eq!(result["values"]["state"], "UNKNOWN", "{result}");
    let task = client.task(|task| task["state"] == "UNKNOWN");
    assert_eq!(task["task"], "nap:for:mute");
    let stop = client.call("/ztl/stop", &json!({}));
    robot.process.wait_for("abort mute");
    let told = told(&stop);
    assert!(
        !told[0].0
            && told[0]
                .1
                .contains("1 of this console were asked to stop, 1 of them have ended"),
        "{told:?}"
    );
    client.topic("/ztl/tasks", |list| list["tasks"] == json!([]));
}

#[test]
fn a_task_whose_state_cannot_be_learnt_is_stopped_before_its_server_is_known_to_list_none() {
    sends_aborts(1, || {
        let lists = Arc::new(AtomicBool::new(false));
        let answers = Arc::clone(&lists);
        let aborts = Arc::new(AtomicUsize::new(0));
        let seen = Arc::clone(&aborts);
        let robot = Scripted::start(move |request| match request {
            "$ztl;2;-1;tasks" if !answers.load(Ordering::SeqCst) => None,
            "/test;3;5;abort command" => {
                seen.fetch_add(1, Ordering::SeqCst);
                Some("/test;4;5;True".to_owned())
            }
            _ if request.starts_with("/test;1;") => Some("/test;1;5;Initiated task '5'".to_owned()),
            _ if request.starts_with("/test;2;") => {
                Some("/test;2;-1;Controller threw exception: no sensor".to_owned())
            }
            _ => Some("$ztl;2;-1;No controller for scope: $ztl".to_owned()),
        });
        let (_console, mut client) = console(robot.port);
        client.subscribe("/ztl/stop");
        client.goal("g", "/test/nap/for", &json!({ "goal": "mute" }));
        let result = client.result("g");
        assert_eq!(result["values"]["state"], "UNKNOWN", "{result}");
        client.ask("stop", "/ztl/stop", &json!({}));
        client.topic("/ztl/stop", |stop| stop["robots"][0]["confirmed"].is_null());
        lists.store(true, Ordering::SeqCst);
        let told = told(&client.answer("stop")["values"]);
        let asked = "1 of this console were asked to stop, 1 of them have ended";
        assert!(!told[0].0 && told[0].1.contains(asked), "{told:?}");
        Some(aborts.load(Ordering::SeqCst))
    });
}
