//! Probes while the operator is asked.

use std::time::Duration;

use super::world::World;
use crate::event::{Question, RunCommand, RunEvent, ServerState};
use crate::player::PlayOptions;

const SHOW: &str = "one: {a: {robot: {base: 30}, lamp: {arm: 1}}}\ntwo: {b: {lamp: {arm: 1}}}";

fn watched() -> PlayOptions {
    PlayOptions {
        watch: true,
        ..PlayOptions::default()
    }
}

/// The states of a server, in order.
fn states<'w>(world: &'w World, name: &str) -> Vec<&'w ServerState> {
    let states = world.events.iter().filter_map(|(_, event)| match event {
        RunEvent::Server { remote, state } if remote == name => Some(state),
        _ => None,
    });
    states.collect()
}

#[test]
fn probes_find_an_absent_server_before_the_first_scene_and_notice_its_return() {
    let mut world = World::new(SHOW, watched());
    world.machine("robot").missing = true;
    world.begin();
    world.pass(Duration::from_secs(3));
    assert_eq!(world.player.question(), Some(Question::Scene { scene: 0 }));
    assert!(matches!(
        states(&world, "robot")[..],
        [ServerState::Absent { .. }]
    ));
    assert!(matches!(
        states(&world, "lamp")[..],
        [ServerState::Answering { version: Some(_) }]
    ));
    world.machine("robot").missing = false;
    world.pass(Duration::from_secs(6));
    assert!(matches!(
        states(&world, "robot")[..],
        [
            ServerState::Absent { .. },
            ServerState::Answering { version: None }
        ]
    ));
    // Nothing was started by that.
    assert_eq!(world.timeline(), []);
}

#[test]
fn a_server_without_the_scope_stays_missing_when_it_lists_its_tasks() {
    let mut world = World::new(SHOW, watched());
    world.machine("robot").scopeless = true;
    world.begin();
    world.pass(Duration::from_secs(1));
    world.command(RunCommand::StopAll);
    world.pass(Duration::from_secs(10));
    let listed = world
        .seen(|event| matches!(event, RunEvent::TasksListed { remote, .. } if remote == "robot"));
    assert_eq!(listed.len(), 1);
    assert!(matches!(
        states(&world, "robot")[..],
        [ServerState::Absent { .. }]
    ));
    world.machine("robot").scopeless = false;
    world.pass(Duration::from_secs(6));
    assert!(matches!(
        states(&world, "robot")[..],
        [ServerState::Absent { .. }, ServerState::Answering { .. }]
    ));
}

#[test]
fn probes_notice_a_server_that_falls_silent_between_scenes() {
    let mut world = World::new(SHOW, watched());
    world.begin();
    world.pass(Duration::from_secs(10));
    let now = world.now;
    let pause = (now, now + Duration::from_secs(20));
    world.machine("robot").pauses.push(pause);
    world.pass(Duration::from_secs(40));
    assert!(matches!(
        states(&world, "robot")[..],
        [
            ServerState::Answering { .. },
            ServerState::Silent,
            ServerState::Answering { .. }
        ]
    ));
}

#[test]
fn a_server_gets_one_probe_at_a_time_and_none_during_scenes() {
    let mut world = World::new(SHOW, watched());
    world.begin();
    world.pass(Duration::from_secs(600));
    let probed = world.machine("robot").probed.clone();
    assert!((100..=200).contains(&probed.len()), "{}", probed.len());
    world.command(RunCommand::Start);
    world.pass(Duration::from_secs(20));
    assert_eq!(world.machine("robot").probed, probed);
    // There is no view to show it.
    let mut world = World::new(SHOW, PlayOptions::default());
    world.begin();
    world.pass(Duration::from_secs(600));
    assert_eq!(world.machine("robot").probed, []);
}
