//! Stopping a scene or everything, and going on.

use std::time::Duration;

use super::world::{World, count, unattended};
use crate::event::DecidedBy;
use crate::event::{Ending, Question, RunCommand, RunEvent, RunOutcome, ServerState, TaskState};
use crate::player::PlayOptions;

const SHOW: &str = "
first: {light(wait=no): {lamp: {light: 60}}}
second: {turn: {robot: {base: 5}, lamp: {arm: 30}}, bow: {robot: {base: 1}}}
third: {wave: {lamp: {arm: 1}}}
";

/// A run in its second scene, with a task of the first in the background.
fn in_the_second() -> World {
    let mut world = World::started(SHOW);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    world.command(RunCommand::Start);
    world.pass(Duration::from_secs(1));
    assert_eq!(world.player.question(), None);
    world
}

/// The result of stopping each task, by its number.
fn confirmed(world: &World) -> Vec<(u32, bool)> {
    let answers = world.events.iter().filter_map(|(_, event)| match event {
        RunEvent::StopAnswered {
            task, confirmed, ..
        } => Some((task.0, *confirmed)),
        _ => None,
    });
    answers.collect()
}

#[test]
fn stopping_a_scene_stops_its_tasks_and_shows_it_again() {
    let mut world = in_the_second();
    world.command(RunCommand::StopScene);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    assert_eq!(confirmed(&world), [(2, true), (3, true)]);
    let ends = world.seen(|event| matches!(event, RunEvent::SceneEnded { .. }));
    assert!(
        matches!(
            ends[1],
            RunEvent::SceneEnded {
                scene: 1,
                end: Ending::Stopped,
                ..
            }
        ),
        "{ends:?}"
    );
    // The first scene's background task continues.
    let now = world.now;
    assert_eq!(world.machine("lamp").running(now), 1);
    assert_eq!(world.machine("robot").running(now), 0);
    // None of its later steps started, and the show continues.
    world.pass(Duration::from_secs(10));
    assert_eq!(world.timeline().len(), 3, "{:?}", world.timeline());
    world.command(RunCommand::Start);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 2 }));
    assert_eq!(world.timeline().len(), 6, "{:?}", world.timeline());
    assert_eq!(world.outcome(), None);
}

#[test]
fn an_abort_that_a_silent_server_missed_is_repeated_when_it_answers_again() {
    let mut world = in_the_second();
    let from = world.now.as_millis();
    world.pause("lamp", from, from + 15_000);
    world.command(RunCommand::StopScene);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    assert_eq!(confirmed(&world), [(2, true), (3, false)]);
    // The scene plays again, and what was stopped before does not run beside it.
    world.command(RunCommand::Start);
    world.pass(Duration::from_secs(16));
    let aborted = TaskState::Aborted;
    let count = count!(world, RunEvent::TaskState { state, .. } if *state == aborted);
    assert_eq!(count, 2);
}

#[test]
fn stopping_everything_includes_background_and_foreign_tasks_and_keeps_the_position() {
    let mut world = in_the_second();
    let now = world.now;
    world.machine("lamp").begins(now, "100");
    world.machine("lamp").begins(now, "0");
    world.command(RunCommand::StopAll);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    let now = world.now;
    assert_eq!(world.machine("lamp").running(now), 0);
    assert_eq!(world.machine("robot").running(now), 0);
    assert_eq!(count!(world, RunEvent::TaskFound { .. }), 1);
    let mut confirmed = confirmed(&world);
    confirmed.sort_unstable();
    assert_eq!(confirmed, [(1, true), (2, true), (3, true), (4, true)]);
    // The original's server cannot tell.
    let notes = world.seen(|event| matches!(event, RunEvent::Note { .. }));
    assert!(
        matches!(notes[..], [RunEvent::Note { text }] if text.contains("on 'robot' may still run")),
        "{notes:?}"
    );
    let listed = world.seen(|event| matches!(event, RunEvent::TasksListed { .. }));
    let complete = listed.iter().map(|event| match event {
        RunEvent::TasksListed { remote, gaps } => (remote.as_str(), gaps.is_empty()),
        event => panic!("{event:?}"),
    });
    let mut complete: Vec<(&str, bool)> = complete.collect();
    complete.sort_unstable();
    assert_eq!(complete, [("lamp", true), ("robot", false)]);
    // Between scenes it keeps the place too.
    world.command(RunCommand::StopAll);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    world.command(RunCommand::Skip);
    world.command(RunCommand::Skip);
    assert_eq!(world.player.question(), Some(Question::End));
    world.command(RunCommand::StopAll);
    assert_eq!(world.until_asked(), Some(Question::End));
}

#[test]
fn stopping_a_replay_returns_to_where_it_started() {
    let mut world = in_the_second();
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 2 }));
    world.command(RunCommand::Replay);
    world.pass(Duration::from_secs(1));
    world.command(RunCommand::StopScene);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 2 }));
}

#[test]
fn a_task_that_cannot_be_stopped_is_reported_and_the_run_can_still_be_stopped() {
    let script = "one: {a: {robot: {base: 500 forever}}}\ntwo: {b: {lamp: {arm: 1}}}";
    let mut world = World::started(script);
    world.pass(Duration::from_secs(1));
    world.command(RunCommand::StopScene);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    assert_eq!(confirmed(&world), [(1, false)]);
    world.command(RunCommand::StopAll);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    assert_eq!(confirmed(&world), [(1, false), (1, false)]);
    world.command(RunCommand::Stop);
    world.run(|_, _| None);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert_eq!(confirmed(&world).len(), 3);
}

#[test]
fn a_task_is_stopped_as_soon_as_its_init_is_answered() {
    let mut world = World::new("one: {a: {robot: {base: 5}}}", PlayOptions::default());
    world.begin();
    let now = world.now;
    let pause = (now, now + Duration::from_secs(1));
    world.machine("robot").pauses.push(pause);
    world.command(RunCommand::Start);
    world.command(RunCommand::StopScene);
    assert_eq!(world.player.question(), None, "not known yet");
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    assert_eq!(confirmed(&world), [(1, true)]);
    let now = world.now;
    assert_eq!(world.machine("robot").running(now), 0);
}

#[test]
fn a_wider_stop_is_accepted_during_a_narrower_one() {
    let mut world = in_the_second();
    let (now, late) = (world.now, Duration::from_secs(60));
    for name in ["robot", "lamp"] {
        world.machine(name).pauses.push((now, now + late));
    }
    world.command(RunCommand::StopScene);
    world.command(RunCommand::StopAll);
    world.command(RunCommand::Stop);
    assert_eq!(world.player.choices(), [RunCommand::Leave]);
    world.run(|_, _| None);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert_eq!(confirmed(&world), [(1, false), (2, false), (3, false)]);
}

#[test]
fn stopping_everything_ends_an_unattended_run() {
    let mut world = World::new(SHOW, unattended());
    world.begin();
    world.pass(Duration::from_secs(1));
    assert!(!world.player.choices().contains(&RunCommand::StopScene));
    let now = world.now;
    let scene = world
        .player
        .handle_command(now, RunCommand::StopScene, DecidedBy::Operator);
    assert!(!scene, "it would be played again");
    world.command(RunCommand::StopAll);
    world.run(|_, _| None);
    assert_eq!(world.outcome(), Some(RunOutcome::Stopped));
    assert_eq!(
        world.seen(|event| matches!(
            event,
            RunEvent::Server {
                state: ServerState::Silent,
                ..
            }
        )),
        Vec::<&RunEvent>::new()
    );
}

#[test]
fn leaving_between_scenes_is_no_failure_unless_something_failed() {
    for (first, outcome) in [("0", RunOutcome::Left), ("1 fail", RunOutcome::Failures)] {
        let script =
            format!("s: {{a: {{lamp: {{light: {first}}}}}}}\nt: {{b: {{lamp: {{light: 0}}}}}}");
        let mut world = World::started(&script);
        while let Some(Question::Step { .. }) = world.until_asked() {
            world.command(RunCommand::GoOn);
        }
        assert_eq!(world.player.question(), Some(Question::Scene { scene: 1 }));
        world.command(RunCommand::Leave);
        assert_eq!(world.outcome(), Some(outcome), "{first}");
    }
}
