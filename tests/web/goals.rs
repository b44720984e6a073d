//! Goals that come late, whose answer is lost, or whose client comes back: each starts once and in time, or not at all.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::{Value, json};
use ztl_tests::lab::{PATIENCE, Server, port_of, reserve_port, serve, until};

use crate::client::Client;
use crate::console::{Console, port, web};
use crate::robot::{Scripted, Slow, listed, probed};

const NAME: &str = "a secret name of a client";

/// Why a goal was not sent.
fn refused(result: &Value) -> &str {
    assert_eq!(result["result"], false, "{result}");
    result["values"].as_str().expect("a reason")
}

#[test]
fn a_goal_that_arrives_after_its_time_is_not_sent() {
    let console = Console::of_one();
    let mut client = Client::open(port(&console.url));
    let now = client.now_ms();
    let wall_clock = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .expect("a time");
    let difference = wall_clock.as_secs().abs_diff(now / 1000);
    assert!(difference < 60, "{difference} s");
    client.goal(
        "late",
        "/test/test/mark",
        &json!({ "goal": "x", "not_after_ms": now - 1 }),
    );
    let result = client.result("late");
    assert!(
        refused(&result).starts_with("too late, not sent"),
        "{result}"
    );
    client.goal(
        "soon",
        "/test/test/echo",
        &json!({ "goal": "x", "not_after_ms": now + 60_000 }),
    );
    assert_eq!(client.result("soon")["values"]["state"], "COMPLETED");
    console.has_marks(0);
}

#[test]
fn a_goal_that_waited_while_the_console_stood_still_is_not_sent() {
    let console = Console::of_one();
    let mut client = Client::open(port(&console.url));
    let now = client.now_ms();
    console.process.signal("STOP");
    client.goal(
        "g",
        "/test/test/mark",
        &json!({ "goal": "x", "not_after_ms": now + 300 }),
    );
    std::thread::sleep(Duration::from_millis(400));
    console.process.signal("CONT");
    let result = client.result("g");
    assert!(
        refused(&result).starts_with("too late, not sent"),
        "{result}"
    );
    console.has_marks(0);
}

#[test]
fn a_goal_for_a_robot_that_is_not_reached_in_time_is_not_sent_later() {
    let gone = reserve_port();
    let (_console, url) = web(0, &[("ours", gone)], &[]);
    let mut client = Client::open(port(&url));
    let now = client.now_ms();
    client.goal(
        "g",
        "/test/arm/left",
        &json!({ "goal": "x", "not_after_ms": now + 200 }),
    );
    let result = client.result("g");
    let values = &result["values"];
    assert_eq!(values["state"], "NOT_STARTED", "{result}");
    assert!(
        values["text"]
            .as_str()
            .expect("why")
            .starts_with("too late, not sent"),
        "{result}"
    );
}

/// A scripted robot that accepts an INIT, but whose answer about it does not arrive while it is `lost`.
fn forgetful(lost: &Arc<AtomicBool>, requests: &Arc<Mutex<Vec<String>>>) -> Scripted {
    let (lost, requests) = (Arc::clone(lost), Arc::clone(requests));
    Scripted::start(move |request| {
        let is_lost = lost.load(Ordering::SeqCst);
        let aborted = || {
            requests
                .lock()
                .expect("no panic")
                .iter()
                .any(|request| request.contains(";3;5;"))
        };
        let answer = match request {
            "$ztl;2;-1;probe" => return Some(probed(if aborted() { &[] } else { &[5] })),
            "$ztl;2;-1;tasks" => return Some(listed()),
            outcome if outcome.starts_with("$ztl;2;-1;outcome") => "$ztl;1;5;moving".to_owned(),
            init if init.starts_with("/test;1;") => "/test;1;5;moving".to_owned(),
            _ if aborted() => "/test;4;5;True".to_owned(),
            abort if abort.contains(";3;5;") => "/test;4;5;True".to_owned(),
            _ => "/test;1;5;None".to_owned(),
        };
        requests.lock().expect("no panic").push(request.to_owned());
        (!is_lost).then_some(answer)
    })
}

#[test]
fn a_task_of_which_nobody_heard_in_time_is_aborted() {
    let (lost, requests) = (Arc::new(AtomicBool::new(true)), Arc::default());
    let robot = forgetful(&lost, &requests);
    let (_console, url) = web(0, &[("ours", robot.port)], &[]);
    let mut client = Client::open(port(&url));
    let now = client.now_ms();
    client.goal(
        "g",
        "/test/arm/left",
        &json!({ "goal": "x", "not_after_ms": now + 1000 }),
    );
    let told = |message: &Value| {
        let progress = message["values"]["progress"].as_str();
        progress.is_some_and(|text| text.contains("asking what became of it"))
    };
    client.next(told);
    lost.store(false, Ordering::SeqCst);
    let result = client.result("g");
    assert_eq!(result["values"]["state"], "ABORTED", "{result}");
    let requests = requests.lock().expect("no panic");
    let inits = requests
        .iter()
        .filter(|request| request.starts_with("/test;1;"));
    assert_eq!(inits.count(), 1, "{requests:?}");
    assert!(
        requests.contains(&"/test;3;5;abort command".to_owned()),
        "{requests:?}"
    );
}

#[test]
fn a_stop_does_not_confirm_while_a_goal_has_no_answer() {
    let (lost, requests) = (Arc::new(AtomicBool::new(true)), Arc::default());
    let robot = forgetful(&lost, &requests);
    let (_console, url) = web(0, &[("ours", robot.port)], &[]);
    let mut client = Client::open(port(&url));
    client.goal("g", "/test/arm/left", &json!({ "goal": "x" }));
    until("an INIT", PATIENCE, || {
        let requests = requests.lock().expect("no panic");
        requests
            .iter()
            .any(|request| request.starts_with("/test;1;"))
            .then_some(())
    });
    let stop = client.call("/ztl/stop", &json!({}));
    let told = &stop["robots"][0];
    assert_eq!(told["confirmed"], false, "{stop}");
    let why = told["text"].as_str().expect("why");
    assert!(why.contains("has no answer: it may still start"), "{why}");
    lost.store(false, Ordering::SeqCst);
    assert_eq!(client.result("g")["values"]["state"], "ABORTED");
    let stop = client.call("/ztl/stop", &json!({}));
    assert_eq!(stop["robots"][0]["confirmed"], true, "{stop}");
}

#[test]
fn a_client_that_comes_back_learns_what_became_of_its_goals_and_starts_none_twice() {
    let robot = Slow::default();
    let server = serve(robot.clone());
    let (_console, url) = web(0, &[("ours", port_of(server.endpoint()))], &[]);
    let name = json!({ "client": NAME });
    let mut client = Client::open(port(&url));
    assert_eq!(client.call("/ztl/resume", &name), json!({ "goals": [] }));
    for id in ["ends", "runs"] {
        client.goal(id, "/test/arm/left", &json!({ "goal": id }));
        client.next(|message| message["op"] == "action_feedback" && message["id"] == id);
    }
    client.send(&json!({ "op": "cancel_action_goal", "id": "ends", "action": "/test/arm/left" }));
    client.result("ends");
    drop(client);
    let mut client = Client::open(port(&url));
    let goals = client.call("/ztl/resume", &name);
    let states: Vec<_> = goals["goals"].as_array().expect("goals").iter().collect();
    let states = states
        .iter()
        .map(|goal| (goal["id"].as_str(), goal["values"]["state"].as_str()));
    let expected = [
        (Some("runs"), Some("OPEN")),
        (Some("ends"), Some("ABORTED")),
    ];
    assert_eq!(states.collect::<Vec<_>>(), expected, "{goals}");
    for id in ["ends", "runs"] {
        client.goal(id, "/test/arm/left", &json!({ "goal": id }));
        let result = client.result(id);
        assert!(refused(&result).contains("not sent again"), "{result}");
    }
    client.send(&json!({ "op": "cancel_action_goal", "id": "runs", "action": "/test/arm/left" }));
    assert_eq!(client.result("runs")["values"]["state"], "ABORTED");
    assert_eq!(robot.given.load(Ordering::SeqCst), 2);
    // A goal that the console refused has an answer, too.
    client.goal("wrong", "/nowhere/arm/left", &json!({ "goal": "x" }));
    client.result("wrong");
    drop(client);
    let mut client = Client::open(port(&url));
    let goals = client.call("/ztl/resume", &name);
    let goals = goals["goals"].as_array().expect("goals");
    let wrong = goals.iter().find(|goal| goal["id"] == "wrong");
    let wrong = &wrong.expect("it is told")["values"];
    assert_eq!(wrong["state"], "NOT_STARTED", "{wrong}");
    assert!(
        wrong["text"]
            .as_str()
            .expect("why")
            .starts_with("no action"),
        "{wrong}"
    );
    // Another client has its own ids, and no name is too easy to guess.
    let mut other = Client::open(port(&url));
    other.call("/ztl/operate", &json!({}));
    other.goal("runs", "/test/arm/left", &json!({ "goal": "x" }));
    other.next(|message| message["op"] == "action_feedback" && message["id"] == "runs");
    let mut other = Client::open(port(&url));
    let told = other.call("/ztl/resume", &json!({ "client": "short" }));
    assert!(
        told.as_str().expect("why").contains("16 to 128 bytes"),
        "{told}"
    );
}

#[test]
fn a_cancel_does_not_wait_behind_goals_of_a_robot_that_hangs() {
    let robot = Slow::default();
    let server = serve(robot.clone());
    let hanging = Server::ours();
    hanging.process.signal("STOP");
    let robots = [
        ("ours", port_of(server.endpoint())),
        ("hangs", hanging.port),
    ];
    let (_console, url) = web(0, &robots, &[]);
    let mut client = Client::open(port(&url));
    client.goal("g", "ours:/test/arm/left", &json!({ "goal": "up" }));
    client.next(|message| message["op"] == "action_feedback" && message["id"] == "g");
    for number in 0..10 {
        client.goal(
            &number.to_string(),
            "hangs:/test/test/sleep",
            &json!({ "goal": "1" }),
        );
    }
    client.send(&json!({ "op": "cancel_action_goal", "id": "g", "action": "ours:/test/arm/left" }));
    let first = client.next(|message| message["op"] == "action_result");
    assert_eq!(
        (&first["id"], &first["values"]["state"]),
        (&json!("g"), &json!("ABORTED"))
    );
}

#[test]
fn what_a_hostile_robot_says_is_cut() {
    let long = "<b>".repeat(30_000);
    let said = long.clone();
    let robot = Scripted::start(move |request| {
        let long = &said;
        Some(match request {
            "$ztl;2;-1;probe" => {
                let names: Vec<String> = (0..5000).map(|number| format!("n{number}")).collect();
                let names = names.join(", ");
                // YAML knows no longer key.
                let name = &long[..1000];
                format!(
                    "$ztl;5;0;{{ztl: 1, version: '{long}', boot: 7, \
                     scopes: {{\"/test\": {{\"{name}\": [], \"arm\": [left, {names}, \"{long}\"]}}}}, running: {{}}}}"
                )
            }
            "$ztl;2;-1;tasks" => {
                let task = |id: u32, scope: &str| {
                    json!({
                        "id": id, "scope": scope, "task": long, "state": 1, "text": long, "age_ms": 1, "ended_ms": null,
                    })
                };
                let list = json!({ "tasks": [task(5, "/test"), task(6, long)], "more": 0 });
                format!("$ztl;5;0;{list}")
            }
            init if init.starts_with("/test;1;") => "/test;1;5;moving".to_owned(),
            _ => format!("/test;5;5;{long}"),
        })
    });
    let (_console, url) = web(0, &[("ours", robot.port)], &[]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/tasks");
    let mut tasks = client.topic("/ztl/tasks", |list| list["tasks"][0]["id"] == 5);
    assert_eq!(tasks["tasks"].as_array().map(Vec::len), Some(1));
    assert!(
        tasks.to_string().len() < 2000,
        "{}",
        tasks.to_string().len()
    );
    let gaps = tasks["gaps"].take().to_string();
    assert!(gaps.contains("too long to be shown"), "{gaps}");
    let robots = client.call("/ztl/robots", &json!({}));
    assert!(
        robots.to_string().len() < 20_000,
        "{}",
        robots.to_string().len()
    );
    let offered = &robots["robots"][0]["scopes"][0]["handlers"];
    assert_eq!(offered["arm"][0], "left");
    assert_eq!(offered.as_object().map(serde_json::Map::len), Some(1));
    client.goal("g", "/test/arm/left", &json!({ "goal": "x" }));
    let result = client.result("g");
    let text = result["values"]["text"].as_str().expect("a text");
    assert!(text.len() < 70_000 && text.ends_with('…'), "{}", text.len());
    // Its tasks run on.
    let stop = client.call("/ztl/stop", &json!({}));
    assert!(
        stop["robots"][0]["confirmed"] == false && stop.to_string().len() < 5000,
        "{}",
        stop.to_string().len()
    );
}
