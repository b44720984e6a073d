//! Keys whose bytes arrive separately, as on a slow connection, and many that arrive together.

use std::sync::atomic::Ordering;
use std::time::Duration;

use ztl_tests::lab::{PATIENCE, Terminal, until};

use super::robot::{Robot, playing_second_scene};
use super::stage::{Stage, start_scene};

/// Types the bytes one by one with pauses.
fn type_in_pieces(terminal: &mut Terminal, keys: &[u8]) {
    for byte in keys {
        terminal.type_in([*byte]);
        std::thread::sleep(Duration::from_millis(100));
    }
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
    let (robot, stage, mut terminal) = playing_second_scene();
    // The last byte alone would stop the scene.
    for right in ["\x1b[C", "\x1bOC", "\x1b[1;5C"] {
        type_in_pieces(&mut terminal, right.as_bytes());
    }
    until("the keys", PATIENCE, || {
        (recorded(&stage).len() >= 3).then_some(())
    });
    assert_eq!(recorded(&stage), ["Right"; 3]);
    // A character of several bytes; c is pressed when only a part of it was received.
    type_in_pieces(&mut terminal, "é".as_bytes());
    type_in_pieces(&mut terminal, &"€".as_bytes()[..2]);
    assert!(robot.running().contains("sleep:200"));
    terminal.type_in("c");
    terminal.shows("STOPPED THE SCENE: 1 of 1 confirmed");
    assert_eq!(recorded(&stage)[3..], ["é", "an unknown key", "c"]);
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn keys_in_pieces_move_in_the_chooser_and_a_lone_esc_closes_it() {
    let (_robot, stage, mut terminal) = at_the_first_of_thirty_scenes();
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    for (key, at) in [
        ("\x1b[F", "30 scene 30"),
        ("\x1bOH", "1 scene 1"),
        ("\x1b[6~", "18 scene 18"),
        ("\x1b[5~", "1 scene 1"),
        ("\x1b[B", "2 scene 2"),
    ] {
        type_in_pieces(&mut terminal, key.as_bytes());
        terminal.shows_that(at, |screen| {
            screen.contains(&format!("▶ {at}")) && screen.contains("Esc  do not jump")
        });
    }
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
    // A write counts as stalled after 1 s.
    std::thread::sleep(Duration::from_millis(1500));
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
