//! The live view of `ztl run-script` on a pty, with a real gateway, a simulated gripper and the record of the
//! run.

mod choose;
mod cues;
mod keys;
mod preflight;
mod robot;
mod stage;
mod stop;
mod vanished;

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Terminal, until};

use stage::{SCRIPT, Stage, start_scene};

/// The lines of scenes, steps and tasks, without times.
fn without_times(screen: &str) -> Vec<String> {
    let body = screen
        .lines()
        .skip(2)
        .take_while(|line| !line.starts_with('─'));
    let words = body.map(|line| {
        let end = line.trim_end();
        let time = end
            .rsplit_once("  ")
            .filter(|(_, time)| time.ends_with(" s"));
        time.map_or(end, |(rest, _)| rest.trim_end()).to_owned()
    });
    words.filter(|line| !line.is_empty()).collect()
}

#[test]
fn single_keys_play_a_script() {
    let stage = Stage::new(SCRIPT);
    // The first scene takes 6.4 s, so that its task is seen.
    stage.set_speed(0.25);
    let mut terminal = stage.play();
    let screen = terminal.shows(" Next: open");
    assert!(terminal.is_full_screen() && !terminal.has_cursor());
    assert_eq!(
        without_times(&screen),
        [
            " · 1 open",
            "     · wide",
            "         gripper [finger] -> 80",
            " · 2 shake",
            " · 3 close",
        ]
    );
    assert!(screen.contains(" Next: open"), "{screen}");
    for key in [
        "Enter  start",
        "s  skip",
        "j  jump to a scene",
        "x  stop everything",
    ] {
        assert!(screen.contains(key), "{key} in\n{screen}");
    }
    assert!(!screen.contains("replay"), "nothing to replay:\n{screen}");

    terminal.type_in("\r");
    terminal.shows("▶ gripper:finger:80  accepted");
    let screen = terminal.shows(" Next: shake");
    assert!(
        screen.contains(" ✓ 1 open") && screen.contains("gripper ✓"),
        "{screen}"
    );

    // A step fails, and so does its retry.
    terminal.type_in("\r");
    let screen = terminal.shows("WAITING: ");
    assert!(screen.contains("✗ gripper:thumb:1  rejected"), "{screen}");
    assert!(
        screen.contains("t  retry what failed") && screen.contains("g  go on anyway"),
        "{screen}"
    );
    terminal.type_in("t");
    terminal.shows("✗ ↻ gripper:thumb:1");
    terminal.shows("g  go on anyway");
    // The next step takes 8 s, so that the keys are pressed while it runs.
    stage.set_speed(0.1);
    terminal.type_in("g");
    terminal.shows("▶ gripper:finger:40");
    let pressed = Instant::now();
    terminal.type_in("p");
    terminal.shows("There will be a pause after this step.");
    // Pressed again at once, the key counts as held. After 2 s it may take the pause back instead.
    terminal.type_in("pp");
    terminal.type_in("\x1b[C");
    terminal.shows("Right has no effect now");
    let at_once = pressed.elapsed() < Duration::from_secs(2);
    let pauses = stage.decided().last().unwrap() == "pause operator";
    assert!(pauses || !at_once, "{:?}", stage.decided());
    if pauses {
        terminal.type_in("p");
    }
    terminal.shows("p  pause after this step");
    terminal.shows(" Next: close");
    stage.set_speed(4.0);
    terminal.type_in("r");
    terminal.shows(", take 2");
    terminal.shows("WAITING: ");
    terminal.type_in("g");
    terminal.shows(" Next: close");
    terminal.type_in("s");
    terminal.shows("The last scene is over.");
    terminal.type_in("j");
    let screen = terminal.shows("Esc  do not jump");
    assert!(screen.contains("  3  close"), "{screen}");
    terminal.type_in("3");
    terminal.shows("Jump to: 3  ▶ 3 close");
    terminal.type_in("\r");
    terminal.shows(" Next: close");
    start_scene(&mut terminal, &stage);
    terminal.shows("The last scene is over.");
    terminal.type_in("q");
    let status = terminal.end();
    terminal.waits_until_as_before();
    assert_eq!(status.code(), Some(1), "not all went well");
    let screen = terminal.shows("Over: ");
    assert!(
        screen.contains(" ✗ 2 shake") && screen.contains(" ✓ 3 close"),
        "{screen}"
    );
    assert_eq!(
        stage.decided(),
        [
            "start operator",
            "start operator",
            "retry operator",
            "go_on operator",
            "pause operator",
            "resume operator",
            "replay operator",
            "go_on operator",
            "skip operator",
            "jump operator",
            "start operator",
            "leave operator",
        ]
    );
}

#[test]
fn keys_read_together_decide_once() {
    let stage = Stage::new(SCRIPT);
    // The scene takes 6.4 s, so that keys are typed while it plays.
    stage.set_speed(0.25);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // An arrow key has three bytes and decides nothing.
    terminal.type_in("\x1b[C");
    terminal.shows("Right has no effect now");
    terminal.type_in("\r\r\rss");
    terminal.shows("▶ gripper:finger:80");
    // They have no effect while the scene plays, nor later.
    terminal.type_in("\r");
    terminal.type_in("s");
    terminal.shows(" Next: shake");
    until("the record of all keys", PATIENCE, || {
        let keys = stage
            .record()
            .iter()
            .filter(|line| line["event"] == "key")
            .count();
        (keys == 8).then_some(())
    });
    assert_eq!(stage.decided(), ["start operator"]);
    let screen = terminal.screen();
    assert!(
        screen.contains(" · 2 shake") && screen.contains(" · 3 close"),
        "{screen}"
    );
    // Stop keys work after any other keys.
    terminal.type_in("s\x03");
    terminal.end();
    assert_eq!(stage.decided().last().unwrap(), "stop operator");
}

#[test]
fn a_held_key_decides_once() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // Repeats as a keyboard does, past the end of the scene into the next question. A busy machine may
    // deliver the repeats so late that they look like new presses.
    let mut asked = None;
    let mut last = Instant::now();
    let mut steady = true;
    until("a while at the next question", PATIENCE, || {
        steady &= last.elapsed() < Duration::from_millis(120);
        last = Instant::now();
        terminal.type_in("\r");
        std::thread::sleep(Duration::from_millis(30));
        if terminal.screen().contains(" Next: shake") {
            asked.get_or_insert_with(Instant::now);
        }
        let done = |asked: Instant| asked.elapsed() > Duration::from_millis(400);
        (!steady || asked.is_some_and(done)).then_some(())
    });
    if steady {
        assert_eq!(stage.decided(), ["start operator"]);
        assert!(terminal.screen().contains(" Next: shake"));
    }
    // Released and pressed again.
    until("the next scene", PATIENCE, || {
        std::thread::sleep(Duration::from_millis(300));
        terminal.type_in("\r");
        (stage.decided().len() > 1).then_some(())
    });
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_key_counts_as_held_before_its_first_repeat_and_stop_keys_work_in_the_chooser() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // Most keyboards wait half a second before they repeat a key.
    terminal.type_in("s");
    terminal.shows(" Next: shake");
    std::thread::sleep(Duration::from_millis(400));
    for _ in 0..3 {
        terminal.type_in("s");
        std::thread::sleep(Duration::from_millis(30));
    }
    let pressed = until("the record of all keys", PATIENCE, || {
        let record = stage.record();
        let keys = record.iter().filter(|line| line["event"] == "key");
        let at: Vec<f64> = keys.filter_map(|line| line["at_ms"].as_f64()).collect();
        (at.len() == 4).then_some(at)
    });
    // A busy machine may deliver them so late that they look like new presses.
    if pressed[1] - pressed[0] < 650.0 && pressed[3] - pressed[1] < 200.0 {
        assert_eq!(stage.decided(), ["skip operator"]);
    }
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    // In the chooser a letter searches.
    terminal.type_in("x");
    terminal.shows("Jump to: x");
    terminal.type_in("\x18");
    terminal.shows("STOPPED EVERYTHING");
    assert_eq!(stage.decided().last().unwrap(), "stop_all operator");
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("\x03");
    terminal.end();
    assert_eq!(stage.decided().last().unwrap(), "stop operator");
}

#[test]
fn ctrl_c_stops_background_tasks_and_shows_it() {
    let stage = Stage::new(&SCRIPT.replace("wide:", "wide (wait=no):"));
    // The task must still run at Ctrl-C.
    stage.set_speed(0.1);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    terminal.type_in("\r");
    // The task runs in the background during the next question.
    terminal.shows(" Next: shake");
    let screen = terminal.shows("in the background: 1");
    assert!(screen.contains("▶ gripper:finger:80  accepted"), "{screen}");
    terminal.type_in("\x03");
    let status = terminal.end();
    assert_eq!(status.code(), Some(1));
    terminal.waits_until_as_before();
    let screen = terminal.shows("Over: everything was stopped.");
    assert!(screen.contains("■ gripper:finger:80  aborted"), "{screen}");
    let record = stage.record();
    let answer = record
        .iter()
        .find(|line| line["event"] == "stop_answered")
        .unwrap();
    assert_eq!(answer["confirmed"], true, "{answer}");
    let last = record.last().unwrap();
    assert_eq!(
        (&last["event"], &last["outcome"]),
        (&"run_ended".into(), &"stopped".into())
    );
}

#[test]
fn signals_restore_the_terminal_of_the_live_view() {
    for signal in ["TERM", "HUP", "INT", "QUIT"] {
        let stage = Stage::new(SCRIPT);
        stage.set_speed(0.1);
        let mut terminal = stage.play();
        terminal.shows(" Next: open");
        terminal.type_in("\r");
        terminal.shows("▶ gripper:finger:80");
        assert!(!terminal.is_as_before());
        terminal.signal(signal);
        terminal.end();
        terminal.waits_until_as_before();
        if signal != "QUIT" {
            assert_eq!(stage.decided().last().unwrap(), "stop signal", "{signal}");
        }
    }
}

#[test]
fn signals_restore_the_terminal_of_the_plain_view() {
    for signal in ["TERM", "HUP", "INT", "QUIT"] {
        let stage = Stage::new(SCRIPT);
        let mut command = stage.command();
        command.arg("--plain");
        let mut terminal = Terminal::start(&command, (80, 24));
        terminal.shows("PRESS <ENTER> TO CONFIRM");
        assert!(!terminal.is_as_before());
        terminal.signal(signal);
        terminal.end();
        terminal.waits_until_as_before();
    }
}

#[test]
fn ctrl_z_restores_the_terminal_and_fg_takes_it_again() {
    let stage = Stage::new(SCRIPT);
    let mut shell = Command::new("bash");
    shell
        .args(["--norc", "--noprofile", "-i"])
        .env("PS1", "ready> ")
        .env("LANG", "C.UTF-8");
    shell.current_dir(stage.files.path(""));
    let mut terminal = Terminal::start(&shell, (80, 24));
    terminal.shows("ready>");
    let play = stage.command();
    let words: Vec<&str> = play.get_args().map(|word| word.to_str().unwrap()).collect();
    terminal.type_in(format!(
        "'{}' {}\n",
        play.get_program().display(),
        words.join(" ")
    ));
    terminal.shows(" Next: open");
    terminal.type_in("\x1a");
    terminal.shows("Stopped");
    assert!(!terminal.is_full_screen() && terminal.has_cursor());
    terminal.type_in("fg\n");
    terminal.shows(" Next: open");
    assert!(terminal.is_full_screen());
    // Single keys work again.
    terminal.type_in("s");
    terminal.shows(" Next: shake");
    terminal.type_in("\x03");
    terminal.shows("Over: everything was stopped.");
    // The terminal belongs to the shell again.
    assert!(!terminal.is_full_screen() && terminal.has_cursor());
    terminal.type_in("exit\n");
    terminal.end();
}

#[test]
fn the_view_fits_the_window_after_each_resize() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    for size in [(40, 12), (132, 43), (30, 9), (80, 24)] {
        terminal.resize(size);
        let width = usize::from(size.0);
        terminal.shows_that("the title with the time at its right", |screen| {
            let title = screen.lines().next().unwrap_or_default();
            let keys = screen.lines().last().unwrap_or_default();
            title.chars().count() >= width - 2 && title.ends_with('s') && keys.contains("keys")
        });
    }
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn no_color_turns_colours_off_and_a_c_locale_gets_ascii() {
    let stage = Stage::new(SCRIPT);
    stage.set_speed(0.1);
    let mut terminal = Terminal::start(
        stage.command().env("NO_COLOR", "1").env("LANG", "C"),
        (80, 24),
    );
    terminal.shows(" Next: open");
    terminal.type_in("\r");
    let screen = terminal.shows("> gripper:finger:80");
    assert!(screen.is_ascii(), "{screen}");
    assert!(!terminal.has_colour());
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn an_existing_record_is_kept_and_nothing_is_played() {
    let stage = Stage::new(SCRIPT);
    fs::write(stage.files.path("run.jsonl"), "mine").unwrap();
    let mut terminal = stage.play();
    let screen = terminal.shows("not overwritten");
    assert_eq!(terminal.end().code(), Some(1), "{screen}");
    assert_eq!(
        fs::read_to_string(stage.files.path("run.jsonl")).unwrap(),
        "mine"
    );
}
