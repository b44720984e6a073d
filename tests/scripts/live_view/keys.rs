//! Keys whose bytes arrive separately, as on a slow connection, and many that arrive together.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, Terminal, until};

use super::robot::{Robot, playing_second_scene};
use super::stage::{Stage, start_scene};

/// A lone ESC that nothing follows within this time is the key Esc. The view waits longer for the rest of any other key.
const ESCAPE: Duration = Duration::from_millis(500);

/// Types the bytes of a key one by one over 300 ms. Returns whether the key was read before any part of it could be given
/// up: a busy machine may type or read a byte too late.
fn is_read_in_time(
    terminal: &mut Terminal,
    key: &str,
    is_read: impl Fn(&Terminal) -> bool,
) -> bool {
    let start = Instant::now();
    let pauses = u32::try_from(key.len() - 1).expect("a short key");
    for (nth, byte) in key.bytes().enumerate() {
        if nth > 0 {
            std::thread::sleep(Duration::from_millis(300) / pauses);
        }
        terminal.type_in([byte]);
    }
    while start.elapsed() < ESCAPE {
        if is_read(terminal) {
            return start.elapsed() < ESCAPE;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    false
}

/// The keys that were recorded, except for those that start scenes.
fn recorded(stage: &Stage) -> Vec<String> {
    let record = stage.record();
    let keys = record.iter().filter_map(|line| line["key"].as_str());
    let others = keys.filter(|key| *key != "Enter");
    others.map(str::to_owned).collect()
}

/// A run of thirty quick scenes, before the first.
#[track_caller]
fn at_the_first_of_thirty_scenes() -> (Robot, Stage, Terminal) {
    let robot = Robot::start();
    let scene = |nth: usize| format!("scene {nth}: {{a: {{test: {{echo: {nth}}}}}}}\n");
    let script: String = (1..=30).map(scene).collect();
    let stage = Stage::with(&script, &[("test", robot.port)]);
    let terminal = stage.play();
    terminal.shows(" Next: scene 1");
    (robot, stage, terminal)
}

#[test]
fn keys_in_pieces_are_read_as_those_keys_and_stop_nothing() {
    // The last byte of an arrow key alone would stop the scene. The last key is a character of several bytes.
    let keys = ["\x1b[C", "\x1bOC", "\x1b[1;5C", "é"];
    let (robot, stage, mut terminal) = until("all keys are read in time", PATIENCE, || {
        let (robot, stage, mut terminal) = playing_second_scene();
        let in_time = keys.iter().enumerate().all(|(nth, key)| {
            is_read_in_time(&mut terminal, key, |_| recorded(&stage).len() > nth)
        });
        in_time.then_some((robot, stage, terminal))
    });
    assert_eq!(recorded(&stage), ["Right", "Right", "Right", "é"]);
    // c is pressed when only a part of a character was received.
    terminal.type_in(&"€".as_bytes()[..2]);
    assert!(robot.running().contains("sleep:200"));
    terminal.type_in("c");
    terminal.shows("STOPPED THE SCENE: 1 of 1 confirmed");
    assert_eq!(recorded(&stage)[4..], ["an unknown key", "c"]);
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn keys_in_pieces_move_in_the_chooser_and_a_lone_esc_closes_it() {
    let keys = [
        ("\x1b[F", "30 scene 30"),
        ("\x1bOH", "1 scene 1"),
        ("\x1b[6~", "18 scene 18"),
        ("\x1b[5~", "1 scene 1"),
        ("\x1b[B", "2 scene 2"),
    ];
    let (_robot, stage, mut terminal) = until("all keys are read in time", PATIENCE, || {
        let (robot, stage, mut terminal) = at_the_first_of_thirty_scenes();
        terminal.type_in("j");
        terminal.shows("Esc  do not jump");
        let in_time = keys.iter().all(|(key, at)| {
            is_read_in_time(&mut terminal, key, |terminal| {
                let screen = terminal.screen();
                screen.contains(&format!("▶ {at}")) && screen.contains("Esc  do not jump")
            })
        });
        in_time.then_some((robot, stage, terminal))
    });
    terminal.type_in("\x1b");
    terminal.shows(" Next: scene 1");
    assert_eq!(stage.decided(), Vec::<String>::new());
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn keys_typed_while_the_screen_stalls_answer_no_question() {
    let robot = Robot::start();
    let script = "one: {a: {test: {held: 1}}}\ntwo: {b: {test: {echo: 1}}}\n";
    let stage = Stage::with(script, &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" Next: one");
    terminal.type_in("\r");
    terminal.shows("▶ test:held:1  accepted");
    // One line shows only the keys, so the next change is the question.
    terminal.resize((80, 1));
    terminal.shows_that("the keys alone", |screen| {
        screen.contains("p  pause after this step")
    });
    terminal.stall(true);
    robot.released.store(true, Ordering::Relaxed);
    until("the question", PATIENCE, || {
        let record = stage.record();
        let asked = record.iter().filter(|line| line["event"] == "asked");
        (asked.count() == 2).then_some(())
    });
    // A write counts as stalled after 1 s. It may begin late.
    std::thread::sleep(Duration::from_secs(5));
    assert!(terminal.screen().contains("p  pause after this step"));
    terminal.type_in("s");
    terminal.stall(false);
    until("the record of the key", PATIENCE, || {
        recorded(&stage).contains(&"s".to_owned()).then_some(())
    });
    terminal.resize((80, 24));
    terminal.shows(" Next: two");
    assert_eq!(stage.decided(), ["start operator"]);
    // A stop key counts, whenever it was typed.
    terminal.stall(true);
    terminal.type_in("\x03");
    terminal.stall(false);
    terminal.end();
    assert_eq!(stage.decided(), ["start operator", "stop operator"]);
}

#[test]
fn esc_and_a_stop_key_that_arrive_together_stop() {
    let (robot, stage, mut terminal) = playing_second_scene();
    terminal.type_in("\x1bc");
    terminal.shows("STOPPED THE SCENE: 1 of 1 confirmed");
    assert!(robot.running().contains("sleep:100"));
    // In the chooser x alone would search.
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("\x1bx");
    terminal.shows("STOPPED EVERYTHING: 1 of 1 confirmed");
    assert_eq!(recorded(&stage), ["Esc", "c", "x"]);
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_paste_of_many_bytes_decides_once() {
    let (_robot, stage, mut terminal) = at_the_first_of_thirty_scenes();
    terminal.type_in("s\r".repeat(20_000));
    terminal.shows(" Next: scene 2");
    until("the record of all keys", PATIENCE, || {
        let record = stage.record();
        let keys = record.iter().filter(|line| line["event"] == "key");
        (keys.count() == 40_000).then_some(())
    });
    assert_eq!(stage.decided(), ["skip operator"]);
    // The keys work as before.
    start_scene(&mut terminal, &stage);
    terminal.shows(" Next: scene 3");
    terminal.type_in("\x03");
    terminal.end();
}
