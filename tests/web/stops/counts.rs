//! Goals whose final state cannot be learnt, servers that change or hang, and what a Stop counts.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use ztl_tests::lab::{PATIENCE, SCOPE, Scratch, until};

use super::{console, sends_aborts, told};
use crate::client::Client;
use crate::console::{port, web};
use crate::robot::{Scripted, listed, probed};
use crate::show::{asked, command};

/// The answer of a server of the original to any question about itself.
fn of_the_original() -> Option<String> {
    Some("$ztl;2;-1;No controller for scope: $ztl".to_owned())
}

/// A server of the original that answers no INIT.
fn robot_that_answers_no_init() -> Scripted {
    Scripted::start(|request| match request {
        init if init.starts_with("/test;1;") => None,
        _ => of_the_original(),
    })
}

/// The tasks and a Stop say that one goal got no answer.
#[track_caller]
fn is_told_by_a_stop(client: &mut Client) {
    let text = "1 goal got no answer: it may run and cannot be aborted";
    client.topic("/ztl/tasks", |list| {
        let gaps = list["gaps"].as_array().expect("gaps");
        gaps.iter().any(|gap| gap["text"] == text)
    });
    let told = told(&client.call("/ztl/stop", &json!({})));
    assert!(!told[0].0 && told[0].1.ends_with(text), "{told:?}");
}

/// Starts task 5 of a robot that does not tell its state.
fn lose_a_goal(client: &mut Client) {
    client.goal("g", "/test/nap/for", &json!({ "goal": "mute" }));
    let result = client.result("g");
    assert_eq!(result["values"]["state"], "UNKNOWN", "{result}");
}

#[test]
fn a_lost_goal_is_aborted_when_its_server_answers_again() {
    let started = AtomicBool::new(false);
    let [is_back, is_aborted] = [(); 2].map(|()| Arc::new(AtomicBool::new(false)));
    let (answers, aborted) = (Arc::clone(&is_back), Arc::clone(&is_aborted));
    let robot = Scripted::start(move |request| match request {
        init if init.starts_with("/test;1;") => {
            started.store(true, Ordering::SeqCst);
            Some("/test;1;5;moving".to_owned())
        }
        status if status.starts_with("/test;2;") => {
            Some("/test;2;-1;Controller threw exception: no sensor".to_owned())
        }
        // It hangs before it has listed the task.
        _ if started.load(Ordering::SeqCst) && !answers.load(Ordering::SeqCst) => None,
        "$ztl;2;-1;probe" if started.load(Ordering::SeqCst) => Some(probed(&[5])),
        "$ztl;2;-1;probe" => Some(probed(&[])),
        "$ztl;2;-1;tasks" => Some(listed()),
        _ => {
            aborted.store(true, Ordering::SeqCst);
            Some("/test;4;5;True".to_owned())
        }
    });
    let (_console, mut client) = console(robot.port);
    lose_a_goal(&mut client);
    let pressed = Instant::now();
    let stop = client.call("/ztl/stop", &json!({}));
    assert!(!told(&stop)[0].0, "{stop}");
    // Longer than an ABORT that a client waits for is repeated.
    std::thread::sleep(Duration::from_millis(7500).saturating_sub(pressed.elapsed()));
    is_back.store(true, Ordering::SeqCst);
    until("an ABORT", PATIENCE, || {
        is_aborted.load(Ordering::SeqCst).then_some(())
    });
}

#[test]
fn a_lost_goal_that_is_listed_as_ended_is_forgotten() {
    let started = AtomicBool::new(false);
    let robot = Scripted::start(move |request| match request {
        init if init.starts_with("/test;1;") => {
            started.store(true, Ordering::SeqCst);
            Some("/test;1;5;moving".to_owned())
        }
        "$ztl;2;-1;probe" => Some(probed(&[])),
        "$ztl;2;-1;tasks" if started.load(Ordering::SeqCst) => {
            let task = json!({
                "id": 5, "scope": SCOPE, "task": "nap:for:mute", "state": 5, "text": "", "age_ms": 9, "ended_ms": 1,
            });
            Some(format!(
                "$ztl;5;0;{}",
                json!({ "tasks": [task], "more": 0 })
            ))
        }
        "$ztl;2;-1;tasks" => Some(listed()),
        _ => Some("/test;2;-1;Controller threw exception: no sensor".to_owned()),
    });
    let (_console, mut client) = console(robot.port);
    lose_a_goal(&mut client);
    client.task(|task| task["id"] == 5 && task["runs"] == false);
    // A list that was asked for after the goal was lost.
    until("that it is forgotten", PATIENCE, || {
        let stop = client.call("/ztl/stop", &json!({}));
        (told(&stop) == [(true, "nothing ran".to_owned())]).then_some(())
    });
}

#[test]
fn a_stop_looks_whether_a_server_of_the_original_was_replaced() {
    let is_ours = Arc::new(AtomicBool::new(false));
    let is_replaced = Arc::clone(&is_ours);
    let aborted = AtomicBool::new(false);
    let robot = Scripted::start(move |request| match request {
        _ if !is_replaced.load(Ordering::SeqCst) => of_the_original(),
        "$ztl;2;-1;probe" if aborted.load(Ordering::SeqCst) => Some(probed(&[])),
        "$ztl;2;-1;probe" => Some(probed(&[7])),
        "$ztl;2;-1;tasks" => Some(listed()),
        _ => {
            aborted.store(true, Ordering::SeqCst);
            Some("/test;4;7;True".to_owned())
        }
    });
    let (_console, mut client) = console(robot.port);
    let is_original = |robots: &Value| {
        let text = robots["robots"][0]["text"].as_str();
        text.is_some_and(|text| text.contains("original"))
    };
    client.subscribe("/ztl/robots");
    client.topic("/ztl/robots", is_original);
    is_ours.store(true, Ordering::SeqCst);
    let stop = client.call("/ztl/stop", &json!({}));
    assert_eq!(told(&stop), [(true, "1 task has ended".to_owned())]);
}

#[test]
fn a_missing_server_of_the_original_is_told_as_missing() {
    let hangs = Arc::new(AtomicBool::new(false));
    let is_silent = Arc::clone(&hangs);
    let robot = Scripted::start(move |_| match is_silent.load(Ordering::SeqCst) {
        true => None,
        false => of_the_original(),
    });
    let (_console, mut client) = console(robot.port);
    let is_there = |robots: &Value| robots["robots"][0]["health"] == "there";
    client.subscribe("/ztl/robots");
    client.topic("/ztl/robots", is_there);
    hangs.store(true, Ordering::SeqCst);
    let told = told(&client.call("/ztl/stop", &json!({})));
    let counts = "0 of this console were asked to stop, 0 of them have ended";
    assert!(
        !told[0].0 && told[0].1.contains("no answer") && told[0].1.ends_with(counts),
        "{told:?}"
    );
}

#[test]
fn a_task_that_answers_two_aborts_counts_once() {
    let (mut last, mut aborts_of_b, mut aborted) = (4, 0, Vec::new());
    let a_is_aborted = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&a_is_aborted);
    let robot = Scripted::start(move |request| match request {
        _ if request.starts_with("$ztl") => of_the_original(),
        init if init.starts_with("/test;1;") => {
            last += 1;
            Some(format!("/test;1;{last};moving"))
        }
        // Is sent again after 1.7 s.
        "/test;3;6;abort command" if aborts_of_b == 0 => {
            aborts_of_b += 1;
            None
        }
        _ => {
            let id = if request.contains(";5;") { 5 } else { 6 };
            if request.starts_with("/test;3;") {
                aborted.push(id);
                seen.fetch_or(id == 5, Ordering::SeqCst);
            }
            let state = if aborted.contains(&id) { 4 } else { 1 };
            Some(format!("/test;{state};{id};None"))
        }
    });
    let (_console, mut client) = console(robot.port);
    for id in ["a", "b"] {
        client.goal(id, "/test/nap/for", &json!({ "goal": id }));
        client.task(|task| task["task"] == format!("nap:for:{id}"));
    }
    client.ask("stop", "/ztl/stop", &json!({}));
    until("the first ABORT of a", PATIENCE, || {
        a_is_aborted.load(Ordering::SeqCst).then_some(())
    });
    let again = json!({ "robot": "ours", "scope": SCOPE, "id": 5 });
    client.call("/ztl/abort", &again);
    let told = told(&client.answer("stop")["values"]);
    let counts = "2 of this console were asked to stop, 2 of them have ended";
    assert!(told[0].1.contains(counts), "{told:?}");
}

#[test]
fn a_goal_without_an_answer_from_the_original_is_told_by_a_stop() {
    let robot = robot_that_answers_no_init();
    let (_console, mut client) = console(robot.port);
    lose_a_goal(&mut client);
    is_told_by_a_stop(&mut client);
}

#[test]
fn a_task_of_a_show_without_an_answer_is_told_by_a_stop() {
    let robot = robot_that_answers_no_init();
    let files = Scratch::new();
    let script = files.path("show.yaml");
    fs::write(&script, "one: {a: {test(remote=ours): {nap: 1}}}\n").expect("a file");
    let script = script.display().to_string();
    let (_console, url) = web(0, &[("ours", robot.port)], &["--script", &script]);
    let mut client = Client::open(port(&url));
    client.subscribe("/ztl/show");
    client.subscribe("/ztl/tasks");
    let question = asked(&mut client, 0);
    assert!(command(&mut client, "start", &question).0);
    is_told_by_a_stop(&mut client);
}

#[test]
fn a_goal_without_an_answer_is_forgotten_when_its_server_lists_its_tasks() {
    let is_ours = Arc::new(AtomicBool::new(false));
    let is_replaced = Arc::clone(&is_ours);
    let robot = Scripted::start(move |request| match request {
        init if init.starts_with("/test;1;") => None,
        _ if !is_replaced.load(Ordering::SeqCst) => of_the_original(),
        "$ztl;2;-1;probe" => Some(probed(&[])),
        _ => Some(listed()),
    });
    let (_console, mut client) = console(robot.port);
    lose_a_goal(&mut client);
    is_ours.store(true, Ordering::SeqCst);
    let stop = client.call("/ztl/stop", &json!({}));
    assert_eq!(told(&stop), [(true, "nothing ran".to_owned())]);
}

#[test]
fn a_task_that_its_server_does_not_know_is_not_counted_as_ended() {
    sends_aborts(1, || {
        let aborts = Arc::new(AtomicUsize::new(0));
        let seen = Arc::clone(&aborts);
        let robot = Scripted::start(move |request| match request {
            "$ztl;2;-1;probe" if seen.load(Ordering::SeqCst) == 0 => Some(probed(&[5])),
            "$ztl;2;-1;probe" => Some(probed(&[])),
            "$ztl;2;-1;tasks" => Some(listed()),
            // It was restarted.
            _ => {
                seen.fetch_add(1, Ordering::SeqCst);
                Some("/test;2;5;Invalid ID '5'".to_owned())
            }
        });
        let (_console, mut client) = console(robot.port);
        client.task(|task| task["id"] == 5);
        let stop = client.call("/ztl/stop", &json!({}));
        let counts = "nothing runs; 0 of 1 tasks are known to have ended";
        assert_eq!(told(&stop), [(true, counts.to_owned())]);
        Some(aborts.load(Ordering::SeqCst))
    });
}
