//! Cues in the live view: tasks that a key starts beside the scene.

use ztl_tests::lab::{PATIENCE, until};

use super::robot::Robot;
use super::stage::{Stage, start_scene};

const SCRIPT: &str = "\
one: {a: {test: {sleep: 1}}}
two: {a: {test: {echo: 1}}}
cues:
  wave (key=w): {test: {sleep: cue}}
  say (key=s): {test: {echo: hello}}
";

/// How many cue tasks were started.
fn started(stage: &Stage) -> usize {
    let record = stage.record();
    let starts = record.iter().filter(|line| line["event"] == "cue_starting");
    starts.count()
}

#[test]
fn a_cue_is_started_by_its_key_beside_the_scene_and_not_twice() {
    let robot = Robot::start();
    let stage = Stage::with(SCRIPT, &[("test", robot.port)]);
    let mut terminal = stage.play();
    terminal.shows(" cues   w  wave ·   k s  say ·");
    start_scene(&mut terminal, &stage);
    terminal.type_in("w");
    terminal.shows("wave ▶");
    until("the cue to run", PATIENCE, || {
        robot.running().contains("sleep:cue").then_some(())
    });
    assert!(robot.running().contains("sleep:1"), "the scene goes on");
    // The time must pass in which a press counts as a repeat of the one before.
    std::thread::sleep(std::time::Duration::from_millis(800));
    terminal.type_in("w");
    terminal.shows("cue 'wave' was not started: it still runs");
    // The key of another command starts a cue only on the page of cues.
    terminal.type_in("k");
    terminal.shows("w       wave: test:sleep:cue");
    terminal.type_in("s");
    terminal.shows("say ✓");
    assert_eq!(started(&stage), 2);
    // Stopping the scene leaves the cue, also from the page of cues; stopping everything does not.
    terminal.type_in("k");
    terminal.shows("start the cue");
    terminal.type_in("c");
    terminal.shows("STOPPED THE SCENE: 1 of 1 confirmed");
    assert!(robot.running().contains("sleep:cue"));
    terminal.shows(" Next: one");
    terminal.type_in("x");
    terminal.shows("wave ■");
    until("the cue to end", PATIENCE, || {
        (!robot.running().contains("sleep:cue")).then_some(())
    });
    terminal.type_in("\x03");
    terminal.end();
}
