//! The chooser, scrolling and pages.

use std::time::Duration;

use ztl_tests::lab::{PATIENCE, Terminal, until};

use super::stage::{SCRIPT, Stage, start_scene};

/// A script of this many scenes; each opens the gripper to its number.
fn long_show(scenes: usize) -> String {
    let scene = |nth: usize| format!("scene {nth}: {{go: {{gripper: {{finger: {nth}}}}}}}\n");
    let mut script: String = (1..=scenes).map(scene).collect();
    script += "finale: {go: {gripper: {finger: 90}}}\n";
    script
}

/// The line of the chosen scene.
fn chosen(screen: &str) -> String {
    let mut lines = screen.lines().filter(|line| line.starts_with(" ▶"));
    let line = lines.next().unwrap_or_default().trim().to_owned();
    assert_eq!(lines.next(), None, "one is chosen:\n{screen}");
    line
}

#[test]
fn a_scene_is_chosen_by_its_number_and_only_the_shown_one_is_played() {
    let stage = Stage::new(&long_show(30));
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("2");
    let screen = terminal.shows("Jump to: 2  ▶ 2 scene 2");
    assert!(chosen(&screen).contains("2  scene 2"), "{screen}");
    terminal.type_in("4");
    let screen = terminal.shows("Jump to: 24  ▶ 24 scene 24");
    assert!(chosen(&screen).contains("24  scene 24"), "{screen}");
    // Enter shows the scene and decides nothing else.
    assert_eq!(stage.decided(), Vec::<String>::new());
    terminal.type_in("\r");
    terminal.shows(" Next: scene 24");
    assert_eq!(stage.decided(), ["jump operator"]);
    start_scene(&mut terminal, &stage);
    terminal.shows(" Next: scene 25");
    terminal.type_in("\x03");
    terminal.end();
    let record = stage.record();
    let sent = record.iter().filter(|line| line["kind"] == "INIT");
    let sent: Vec<&str> = sent.filter_map(|line| line["text"].as_str()).collect();
    assert_eq!(sent, ["gripper:finger:24"]);
}

#[test]
fn a_pasted_number_shows_its_scene_and_starts_none() {
    let stage = Stage::new(&long_show(30));
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.type_in("j24\r\r");
    terminal.shows(" Next: scene 24");
    terminal.type_in("?");
    terminal.shows("start the scene that is shown");
    assert_eq!(stage.decided(), ["jump operator"]);
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_number_without_a_scene_does_not_jump() {
    let stage = Stage::new(&long_show(30));
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("99");
    terminal.shows("Jump to: 99  ✗ no such scene, there are 1 to 31");
    terminal.type_in("\r");
    terminal.type_in("\x7f");
    terminal.shows("Jump to: 9  ▶ 9 scene 9");
    assert_eq!(stage.decided(), Vec::<String>::new());
    terminal.type_in("\x1b");
    terminal.shows(" Next: scene 1");
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn letters_search_and_arrow_and_page_keys_move() {
    let stage = Stage::new(&long_show(30));
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    let mut press = |key: &str, at: &str| {
        terminal.type_in(key);
        let screen = terminal.shows_that(at, |screen| {
            screen.contains(&format!("▶ {at}")) && !screen.contains("Next:")
        });
        let name = at.split_once(' ').unwrap().1;
        assert!(chosen(&screen).contains(name), "{screen}");
    };
    press("\x1b[F", "31 finale");
    press("\x1b[H", "1 scene 1");
    press("\x1b[6~", "18 scene 18");
    press("\x1b[5~", "1 scene 1");
    press("\x1b[B", "2 scene 2");
    press("FIN", "31 finale");
    terminal.type_in("\r");
    terminal.shows(" Next: finale");
    terminal.type_in("\x03");
    terminal.end();
    let record = stage.record();
    let key = record.iter().find(|line| line["event"] == "key").unwrap();
    assert_eq!(key["key"], "j FIN Enter");
}

#[test]
fn leaving_the_chooser_decides_nothing() {
    let stage = Stage::new(&long_show(3));
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("zqx");
    terminal.shows("Jump to: zqx");
    terminal.type_in("\x1b");
    let screen = terminal.shows(" Next: scene 1");
    assert!(!screen.contains("no effect"), "{screen}");
    terminal.type_in("s");
    terminal.shows(" Next: scene 2");
    let record = stage.record();
    let keys = record.iter().filter(|line| line["event"] == "key");
    let keys: Vec<&str> = keys.filter_map(|line| line["key"].as_str()).collect();
    assert_eq!(keys, ["s"]);
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_long_list_scrolls_and_returns_to_the_current_scene() {
    let stage = Stage::new(&long_show(60));
    // Scene 45 must still play when the screen is read.
    stage.set_speed(0.1);
    let mut terminal = stage.play();
    terminal.shows(" Next: scene 1");
    terminal.shows("· 1 scene 1");
    terminal.type_in("\x1b[6~");
    let screen = terminal.shows_that("another page", |screen| !screen.contains("· 1 scene 1\n"));
    assert!(screen.contains(" Next: scene 1"), "{screen}");
    terminal.type_in("\x1b[F");
    terminal.shows("61 finale");
    terminal.type_in("\x1b");
    terminal.shows("· 1 scene 1");
    // The current scene is always visible.
    terminal.type_in("j");
    terminal.shows("Esc  do not jump");
    terminal.type_in("45");
    terminal.shows("Jump to: 45  ▶ 45 scene 45");
    terminal.type_in("\r");
    terminal.shows("· 45 scene 45");
    until("another page", PATIENCE, || {
        // A new question returns to the current scene, so scroll again.
        terminal.type_in("\x1b[5~");
        std::thread::sleep(Duration::from_millis(100));
        (!terminal.screen().contains("· 45 scene 45")).then_some(())
    });
    start_scene(&mut terminal, &stage);
    terminal.shows("▶ 45 scene 45");
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn pages_of_keys_and_failures_decide_nothing() {
    let stage = Stage::new(SCRIPT);
    let mut terminal = stage.play();
    terminal.shows(" Next: open");
    terminal.type_in("?");
    let screen = terminal.shows("start the scene that is shown");
    assert!(screen.contains(" Next: open"), "{screen}");
    terminal.type_in("\x1b[F");
    terminal.shows("suspend this program");
    terminal.type_in("\x1b");
    terminal.shows("· 1 open");
    terminal.type_in("d");
    terminal.shows("Nothing went wrong.");
    terminal.type_in("\x1b");
    terminal.shows("· 1 open");
    assert_eq!(stage.decided(), Vec::<String>::new());
    terminal.type_in("\x03");
    terminal.end();
}

#[test]
fn a_rejection_shows_its_full_reason() {
    let goal = "a-goal-with-a-long-name-".repeat(12);
    let script = format!("one: {{a(on_failure=ask): {{gripper: {{finger: {goal}}}}}}}\n");
    let stage = Stage::new(&script);
    let mut terminal = Terminal::start(&stage.command(), (60, 24));
    terminal.shows(" Next: one");
    terminal.type_in("\r");
    let screen = terminal.shows("Decide.");
    let flat = |screen: &str| screen.split_whitespace().collect::<String>();
    let reason = "rejected:thegoalis288byteslong,thedevicetakes243(gripper:finger:a-goal";
    let (_, after) = screen.split_once("Decide.").unwrap();
    assert!(flat(after).starts_with(reason), "{screen}");
    assert!(screen.contains("rejected  the goal is"), "{screen}");
    // The rest is on a page.
    terminal.resize((60, 9));
    terminal.shows("d shows the rest");
    terminal.type_in("d");
    terminal.resize((60, 40));
    let whole = format!("(gripper:finger:{goal})");
    terminal.shows_that("all of it on a page", |screen| {
        screen.contains("Esc  back") && flat(screen).matches(&whole).count() == 2
    });
    terminal.type_in("\x03");
    terminal.end();
}
