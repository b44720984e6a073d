//! Stopping a scene, or everything, while the run continues.

use std::sync::atomic::Ordering;

use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server, Terminal, reserve_port, until, ztl};

use super::robot::{Robot, playing_second_scene};
use super::stage::{Stage, start_scene};

#[test]
fn c_stops_the_scene_and_the_run_continues() {
    let (robot, stage, mut terminal) = playing_second_scene();
    let screen = terminal.screen();
    for key in ["c  stop this scene", "x  stop everything"] {
        assert!(screen.contains(key), "{key}:\n{screen}");
    }
    terminal.type_in("c");
    terminal.shows("STOPPED THE SCENE: 1 of 1 confirmed");
    let screen = terminal.shows(" Next: second");
    assert!(screen.contains("✓ test:sleep:200: aborted"), "{screen}");
    assert!(screen.contains(" ■ 2 second"), "{screen}");
    assert!(screen.contains("in the background: 1"), "{screen}");
    let tasks = robot.running();
    assert!(
        tasks.contains("sleep:100") && !tasks.contains("sleep:200"),
        "{tasks}"
    );
    // The run continues with the next scene.
    terminal.type_in("s");
    terminal.shows(" Next: third");
    start_scene(&mut terminal, &stage);
    terminal.shows("The last scene is over.");
    terminal.type_in("q");
    assert_eq!(terminal.end().code(), Some(1), "not all went well");
    assert_eq!(
        stage.decided(),
        [
            "start operator",
            "start operator",
            "stop_scene operator",
            "skip operator",
            "start operator",
            "leave operator",
        ]
    );
    let record = stage.record();
    assert_eq!(record.last().unwrap()["outcome"], "failures");
    let bow = record.iter().any(|line| line["text"] == "test:echo:bow");
    assert!(!bow, "nothing more of it was started");
}

#[test]
fn x_stops_everything_including_foreign_tasks_and_the_run_continues() {
    let (robot, stage, mut terminal) = playing_second_scene();
    let port = robot.port.to_string();
    let at = ["-r", "localhost", "-p", &port, "-s", SCOPE];
    let other = Process::start(ztl().arg("task-client").args(at).arg("test:sleep:300"));
    until("the task of another client", PATIENCE, || {
        robot.running().contains("sleep:300").then_some(())
    });
    terminal.type_in("x");
    terminal.shows("STOPPED EVERYTHING: 3 of 3 confirmed");
    let screen = terminal.shows(" Next: second");
    for task in ["sleep:100", "sleep:200", "sleep:300"] {
        assert!(
            screen.contains(&format!("✓ test:{task}: aborted")),
            "{screen}"
        );
    }
    assert_eq!(robot.running(), "No task is running.\n");
    other.end(PATIENCE);
    start_scene(&mut terminal, &stage);
    terminal.shows("▶ test:sleep:200  accepted");
    terminal.type_in("\x03");
    terminal.end();
    terminal.shows("Over: everything was stopped.");
    assert_eq!(stage.decided().last().unwrap(), "stop operator");
}

#[test]
fn x_stops_everything_at_once_although_a_server_sent_a_huge_text() {
    let robot = Robot::start();
    let script = "\
first:
  light (wait=no): {test: {sleep: 100}}
  talk (on_failure=ask): {test: {babble: 600000}}
";
    let stage = Stage::with(script, &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: first");
    terminal.type_in("\r");
    let screen = terminal.shows("failed: no no no");
    assert!(screen.contains("WAITING: something failed."), "{screen}");
    assert!(robot.running().contains("sleep:100"));
    terminal.type_in("x");
    until("the end of the background task", PATIENCE, || {
        (!robot.running().contains("sleep:100")).then_some(())
    });
    terminal.shows("STOPPED EVERYTHING: 1 of 1 confirmed");
    // The page of details cuts the text too.
    terminal.type_in("d");
    terminal.type_in("\x1b[F");
    terminal.shows("… (600000 bytes)");
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn unconfirmed_stops_are_reported_and_stay_visible() {
    let server = Server::original();
    let port = server.port;
    let script = "one: {a: {test: {sleep: 30}}}\ntwo: {b: {test: {echo: 1}}}\n";
    let stage = Stage::with(script, &[("test", port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: one");
    terminal.type_in("\r");
    terminal.shows("▶ test:sleep:30  accepted");
    terminal.type_in("c");
    // The original's test task cannot be aborted.
    terminal.shows("STOPPED ONLY 0 OF 1: the others may still move");
    let screen = terminal.shows(" Next: one");
    assert!(
        screen.contains("✗ test:sleep:30: it cannot be stopped"),
        "{screen}"
    );
    assert!(screen.contains("in the background: 1"), "{screen}");
    terminal.type_in("x");
    terminal.shows("tasks that others started on 'test' may still run");
    terminal.shows(" Next: one");
    terminal.type_in("\x03");
    assert_eq!(terminal.end().code(), Some(1));
    let screen = terminal.shows("Over: stopping was not confirmed for 1 task; it may still run");
    assert!(!screen.contains("everything was stopped"), "{screen}");
    let record = stage.record();
    assert_eq!(record.last().unwrap()["outcome"], "not_confirmed");
}

#[test]
fn all_is_confirmed_only_when_each_server_answered_and_each_task_ended() {
    // Its sleep cannot be aborted.
    let server = Server::ours();
    let gone = reserve_port();
    let script = "move: {a: {test: {sleep: 25}}}\nother: {b: {gone: {echo: 1}}}\n";
    let stage = Stage::with(script, &[("test", server.port), ("gone", gone)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: move");
    // Nothing runs yet, and 'gone' cannot be asked.
    terminal.type_in("x");
    let screen =
        terminal.shows("FOUND NOTHING TO STOP: what others started on 'gone' may still run");
    assert!(!screen.contains("confirmed"), "{screen}");
    start_scene(&mut terminal, &stage);
    terminal.shows("▶ test:sleep:25  accepted");
    terminal.type_in("x");
    let screen = terminal.shows("✗ test:sleep:25: it cannot be stopped");
    assert!(!screen.contains("all confirmed"), "{screen}");
    terminal.shows("STOPPED ONLY 0 OF 1: the others may still move");
    let report = stage.report();
    assert!(
        report.contains("<b>stop not confirmed</b>: it cannot be stopped"),
        "{report}"
    );
}

#[test]
fn a_step_that_asked_the_operator_is_not_retried_automatically() {
    let robot = Robot::start();
    let script = "one: {a (timeout=1; on_failure=retry 2): {test: {stubborn: 1}}}\n";
    let stage = Stage::with(script, &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: one");
    terminal.type_in("\r");
    terminal.shows("WAITING: a task takes longer than its limit. Decide.");
    robot.released.store(true, Ordering::Relaxed);
    terminal.shows("WAITING: something failed. Decide.");
    let screen = terminal.shows("t  retry what failed");
    assert!(screen.contains("■ test:stubborn:1  aborted"), "{screen}");
    terminal.type_in("g");
    terminal.shows("The last scene is over.");
    terminal.type_in("q");
    assert_eq!(terminal.end().code(), Some(1));
    let record = stage.record();
    let starts = record
        .iter()
        .filter(|line| line["event"] == "task_starting");
    assert_eq!(starts.count(), 1, "no other was started");
}

#[test]
fn x_ends_an_unattended_run() {
    let robot = Robot::start();
    let stage = Stage::with("one: {a: {test: {sleep: 100}}}\n", &[("test", robot.port)]);
    let mut command = stage.command();
    command.arg("--yes");
    let mut terminal = Terminal::start(&command, (80, 24));
    let screen = terminal.shows("▶ test:sleep:100  accepted");
    assert!(!screen.contains("stop this scene"), "{screen}");
    terminal.type_in("x");
    terminal.end();
    terminal.shows("Over: everything was stopped.");
    assert_eq!(robot.running(), "No task is running.\n");
}
