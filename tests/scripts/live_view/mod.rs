//! `ztl run-script` on a terminal: its live view, driven by keys and looked at, on a real gateway
//! with a simulated gripper; and the record that it writes.

mod choose;
mod preflight;
mod stage;
mod stop;

use std::fs;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Terminal, until};

use stage::{SCRIPT, Stage, start_scene};

/// The lines that tell scenes, steps and tasks, without their times.
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
fn a_show_is_played_by_single_keys() {
    let stage = Stage::new(SCRIPT);
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

    // A step fails: it is tried again, in vain, and left.
    terminal.type_in("\r");
    let screen = terminal.shows("WAITING: ");
    assert!(screen.contains("✗ gripper:thumb:1  refused"), "{screen}");
    assert!(
        screen.contains("t  retry what failed") && screen.contains("g  go on anyway"),
        "{screen}"
    );
    terminal.type_in("t");
    terminal.shows("✗ ↻ gripper:thumb:1");
    terminal.shows("g  go on anyway");
    terminal.type_in("g");
    // A pause after the step that runs.
    terminal.shows("▶ gripper:finger:40");
    terminal.type_in("p");
    terminal.shows("There will be a pause after this step.");
    // At once again it would be held down.
    terminal.type_in("pp");
    terminal.type_in("\x1b[C");
    terminal.shows("Right means nothing now");
    assert_eq!(stage.decided().last().unwrap(), "pause operator");
    terminal.type_in("p");
    terminal.shows("p  pause after this step");
    terminal.shows(" Next: close");
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
    terminal.shows("▶ gripper:finger:0");
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
fn keys_that_come_at_once_decide_once() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // An arrow key has three bytes, and is no decision at all.
    terminal.type_in("\x1b[C");
    terminal.shows("Right means nothing now");
    terminal.type_in("\r\r\rss");
    terminal.shows("▶ gripper:finger:80");
    // While it plays they mean nothing, and later neither.
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
    // Whoever wants to stop is heard, whatever else is pressed.
    terminal.type_in("s\x03");
    terminal.end();
    assert_eq!(stage.decided().last().unwrap(), "stop operator");
}

#[test]
fn a_key_that_is_held_down_decides_once() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // As a keyboard repeats it: over the end of the scene, and on while the next one is asked about. On a
    // machine that is too busy it comes as if it were let go.
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
    // Let go, and pressed again.
    until("the next scene", PATIENCE, || {
        std::thread::sleep(Duration::from_millis(300));
        terminal.type_in("\r");
        (stage.decided().len() > 1).then_some(())
    });
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_key_is_held_down_before_its_keyboard_repeats_it_too_and_stopping_is_heard_while_choosing() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    // Half a second is what most keyboards wait.
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
    // On a machine that is too busy they come as if it were let go.
    if pressed[1] - pressed[0] < 650.0 && pressed[3] - pressed[1] < 200.0 {
        assert_eq!(stage.decided(), ["skip operator"]);
    }
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    // A letter searches there.
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
fn ctrl_c_stops_what_was_started_and_shows_it() {
    let stage = Stage::new(&SCRIPT.replace("wide:", "wide (wait=no):"));
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    terminal.type_in("\r");
    // It runs in the background, and the next scene is asked about.
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
fn the_terminal_is_as_before_however_it_ends() {
    for signal in ["TERM", "HUP", "INT", "QUIT"] {
        let stage = Stage::new(SCRIPT);
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
fn the_terminal_is_as_before_after_lines_too_however_they_end() {
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
fn stopped_by_ctrl_z_it_gives_the_terminal_back_and_takes_it_again() {
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
    // It takes single keys again.
    terminal.type_in("s");
    terminal.shows(" Next: shake");
    terminal.type_in("\x03");
    terminal.shows("Over: everything was stopped.");
    // How keys are taken is the shell's concern again.
    assert!(!terminal.is_full_screen() && terminal.has_cursor());
    terminal.type_in("exit\n");
    terminal.end();
}

#[test]
fn the_view_fits_the_window_whatever_becomes_of_it() {
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
fn there_is_no_colour_where_none_is_wanted_and_no_sign_that_cannot_be_shown() {
    let stage = Stage::new(SCRIPT);
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
fn a_record_that_is_there_is_kept_and_nothing_is_played() {
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
