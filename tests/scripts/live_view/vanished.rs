//! A terminal that vanishes while a script plays: its window was closed, or its connection was lost.

use std::process::Command;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Terminal, processor_time, until};

use super::robot::{Robot, playing_second_scene};
use super::stage::Stage;

/// A shell that runs this script; `"$0" "$@"` in it is the command.
fn in_a_shell(script: &str, command: &Command) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", script]);
    shell.arg(command.get_program()).args(command.get_args());
    for (name, value) in command.get_envs() {
        match value {
            Some(value) => shell.env(name, value),
            None => shell.env_remove(name),
        };
    }
    shell.current_dir(command.get_current_dir().unwrap());
    shell
}

/// Checks that the run ends as after SIGTERM, with the code of SIGHUP.
#[track_caller]
fn assert_stopped(robot: &Robot, stage: &Stage, terminal: &mut Terminal) {
    assert_eq!(terminal.end().code(), Some(129));
    assert_eq!(robot.running(), "No task is running.\n");
    assert_eq!(stage.record().last().unwrap()["outcome"], "stopped");
    let decided = stage.decided();
    let stops = decided.iter().filter(|it| it.ends_with(" signal"));
    assert_eq!(stops.collect::<Vec<_>>(), ["stop signal"], "{decided:?}");
}

#[test]
fn a_terminal_that_vanishes_stops_the_scene_and_background_tasks() {
    let (robot, stage, mut terminal) = playing_second_scene();
    terminal.vanish();
    assert_stopped(&robot, &stage, &mut terminal);
}

#[test]
fn a_terminal_that_vanishes_without_a_signal_stops_the_run_at_a_question() {
    for (view, question) in [(None, " Next: "), (Some("--plain"), "PRESS <ENTER>")] {
        let robot = Robot::start();
        let script = "one: {a (wait=no): {test: {sleep: 1}}}\ntwo: {b: {test: {echo: 1}}}\n";
        let stage = Stage::with(script, &[("test", robot.port)]);
        let mut command = stage.command();
        command.args(view);
        // Only this shell gets the signal, and it goes on.
        let script = r#"trap : HUP; "$0" "$@"; exit $?"#;
        let mut terminal = Terminal::start(&in_a_shell(script, &command), (80, 24));
        terminal.shows(question);
        terminal.type_in("\r");
        until("the background task", PATIENCE, || {
            robot.running().contains("sleep:1").then_some(())
        });
        terminal.vanish();
        assert_stopped(&robot, &stage, &mut terminal);
    }
}

#[test]
fn an_ignored_hang_up_ends_a_run_that_asks_and_no_other() {
    let robot = Robot::start();
    let stage = Stage::with("one: {a: {test: {held: 1}}}\n", &[("test", robot.port)]);
    let ignoring = |command: &Command| in_a_shell(r#"trap '' HUP; exec "$0" "$@""#, command);
    let mut asks = Terminal::start(&ignoring(&stage.command()), (80, 24));
    asks.shows(" Next: one");
    asks.vanish();
    assert_stopped(&robot, &stage, &mut asks);

    let stage = Stage::with("one: {a: {test: {held: 1}}}\n", &[("test", robot.port)]);
    let mut command = stage.command();
    command.arg("--yes");
    let mut unattended = Terminal::start(&ignoring(&command), (80, 24));
    unattended.shows("▶ test:held:1  accepted");
    unattended.vanish();
    let (start, before) = (Instant::now(), processor_time(unattended.id()));
    until("a second without a terminal", PATIENCE, || {
        (start.elapsed() > Duration::from_secs(1)).then_some(())
    });
    let used = processor_time(unattended.id()) - before;
    assert!(used < start.elapsed() / 2, "it spins: {used:?}");
    robot.released.store(true, Ordering::Relaxed);
    assert_eq!(unattended.end().code(), Some(0));
    assert_eq!(stage.record().last().unwrap()["outcome"], "completed");
}

#[test]
fn a_second_hang_up_does_not_leave_without_waiting() {
    let robot = Robot::start();
    let stage = Stage::with("one: {a: {test: {stubborn: 1}}}\n", &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: one");
    terminal.type_in("\r");
    terminal.shows("▶ test:stubborn:1  accepted");
    // A shell sends one, and the system another one when the shell ends.
    terminal.signal("HUP");
    until("the stop", PATIENCE, || {
        (stage.decided().last()? == "stop signal").then_some(())
    });
    terminal.signal("HUP");
    terminal.signal("HUP");
    robot.released.store(true, Ordering::Relaxed);
    assert_stopped(&robot, &stage, &mut terminal);
}
