//! Cues, beside scenes and after a stop.

use std::time::Duration;

use super::world::{World, count};
use crate::event::{Question, RunCommand, RunEvent, TaskState};
use crate::player::PlayOptions;

const SHOW: &str = "
first: {a: {lamp: {arm: 5}}, b: {lamp: {arm: 5}}}
cues:
  wave(key=w): {lamp: {hand: 30}, robot: {hand: 30}}
  short(timeout=2): {lamp: {eye: 60}}
";

#[test]
fn a_cue_starts_its_tasks_beside_the_scene_and_not_twice() {
    let mut world = World::new(
        SHOW,
        PlayOptions {
            watch: true,
            ..PlayOptions::default()
        },
    );
    world.begin();
    // Before the first scene, too.
    assert_eq!(world.cue(0), Ok(()));
    assert_eq!(world.player.question(), Some(Question::Scene { scene: 0 }));
    world.command(RunCommand::Start);
    world.pass(Duration::from_secs(1));
    assert_eq!(world.cue(0), Err("it still runs"));
    assert_eq!(world.cue(7), Err("there is no such cue"));
    let now = world.now;
    assert_eq!(world.machine("robot").running(now), 1);
    assert_eq!(world.machine("lamp").running(now), 2);
    // The scene waits for its own tasks only, and its stop leaves the cue.
    world.pass(Duration::from_secs(6));
    world.command(RunCommand::StopScene);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    let now = world.now;
    assert_eq!(world.machine("robot").running(now), 1);
    assert_eq!(world.machine("lamp").running(now), 1);
    world.pass(Duration::from_secs(30));
    assert_eq!(count!(world, RunEvent::CueStarting { cue: 0, .. }), 2);
    assert_eq!(world.cue(0), Ok(()));
}

#[test]
fn stopping_everything_stops_cues_and_starts_none() {
    let mut world = World::started(SHOW);
    assert_eq!(world.cue(0), Ok(()));
    world.pass(Duration::from_secs(1));
    world.command(RunCommand::StopAll);
    assert!(world.cue(1).is_err(), "while tasks are being stopped");
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    let now = world.now;
    assert_eq!(world.machine("robot").running(now), 0);
    assert_eq!(world.machine("lamp").running(now), 0);
}

#[test]
fn the_limit_of_a_cue_counts() {
    let mut world = World::started(SHOW);
    assert_eq!(world.cue(1), Ok(()));
    world.pass(Duration::from_secs(4));
    let aborted = TaskState::Aborted;
    assert_eq!(
        count!(world, RunEvent::TaskState { state, .. } if *state == aborted),
        1
    );
}
