//! The player in virtual time.

mod cues;
mod failures;
mod probes;
mod stopping;
mod world;

use std::time::Duration;

use crate::event::{
    DecidedBy, Ending, Question, RequestKind, RunCommand, RunEvent, RunOutcome, TaskState,
    WaitReason,
};
use crate::player::PlayOptions;
use world::{FIRST_STEP, World, count, on, unattended};

const SCENE: &str = "
first:
  one:
    robot: {base: 2, arm(delay=1): 1}
    lamp: {light: 3}
  two (delay=2):
    lamp: {light: 1}
second (delay=1):
  three:
    robot: {base: 1}
";

#[test]
fn a_step_starts_when_the_awaited_tasks_of_the_previous_one_end() {
    for options in [PlayOptions::default(), unattended()] {
        let mut world = World::new(SCENE, options);
        world.begin();
        world.run(on);
        assert_eq!(
            world.timeline(),
            [
                (1, "robot:base:2"),
                // Its delay begins when the first was answered.
                (1002, "robot:arm:1"),
                (1003, "lamp:light:3"),
                // The light ends after 4003 ms, when its answer comes that was held.
                (6004, "lamp:light:1"),
                (8005, "robot:base:1"),
            ]
        );
        assert_eq!(world.outcome(), Some(RunOutcome::Completed));
    }
}

#[test]
fn a_parallel_step_starts_each_task_after_its_own_delay() {
    let script =
        "s: {a (parallel): {robot: {base(delay=1): 1, arm: 1}, lamp: {light(delay=0.5): 1}}}";
    let world = World::played_unattended(script);
    let expected = [
        (1, "robot:arm:1"),
        (501, "lamp:light:1"),
        (1001, "robot:base:1"),
    ];
    assert_eq!(world.timeline(), expected);
}

#[test]
fn tasks_in_the_background_are_not_waited_for() {
    let script = "s: {a (wait=no): {robot: {base: 9}}, b: {lamp: {x(wait=no): 9, light: 1}}, c: {robot: {arm: 1}}}";
    let world = World::played_unattended(script);
    let expected = [
        (1, "robot:base:9"),
        (2, "lamp:x:9"),
        (3, "lamp:light:1"),
        (1004, "robot:arm:1"),
    ];
    assert_eq!(world.timeline(), expected);
    let Some((
        _,
        RunEvent::RunEnded {
            outcome, running, ..
        },
    )) = world.events.last()
    else {
        panic!("{:?}", world.events.last());
    };
    assert_eq!((*outcome, running.len()), (RunOutcome::Completed, 2));
}

#[test]
fn the_original_server_gets_status_requests_for_one_task_at_a_time() {
    let script = "s: {a: {robot: {base: 2, arm: 3}, lamp: {light: 1}}}";
    let world = World::played_unattended(script);
    let mut asked = Vec::new();
    for (at, event) in &world.events {
        if let RunEvent::RequestSent {
            kind: RequestKind::Status,
            text,
            ..
        } = event
        {
            asked.push((at.as_millis(), text.as_str()));
        }
    }
    let base: Vec<_> = asked
        .iter()
        .filter(|(_, text)| text.ends_with("robot:base:2"))
        .collect();
    let arm: Vec<_> = asked
        .iter()
        .filter(|(_, text)| text.ends_with("robot:arm:3"))
        .collect();
    assert!((19..=21).contains(&base.len()), "{base:?}");
    assert!((9..=12).contains(&arm.len()), "{arm:?}");
    assert!(base.iter().all(|base| base.0 <= arm[0].0));
    // Ours holds the answer until the end.
    let lamp: Vec<_> = asked
        .iter()
        .filter(|(_, text)| text.starts_with("wait "))
        .collect();
    assert!(lamp.len() <= 2, "{lamp:?}");
}

#[test]
fn a_scene_can_be_skipped_replayed_and_jumped_to() {
    let mut world = World::new(SCENE, PlayOptions::default());
    world.begin();
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    assert!(!world.player.choices().contains(&RunCommand::Replay));
    world.command(RunCommand::Skip);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    world.command(RunCommand::Start);
    assert_eq!(world.until_asked(), Some(Question::End));
    world.command(RunCommand::Replay);
    assert_eq!(world.until_asked(), Some(Question::End));
    world.command(RunCommand::Jump { scene: 1 });
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    world.command(RunCommand::Replay);
    // The same scene is asked about again.
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
    world.command(RunCommand::Restart);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 0 }));
    assert!(!world.player.choices().contains(&RunCommand::Replay));
    assert_eq!(world.began.len(), 3);
    assert_eq!(
        count!(
            world,
            RunEvent::SceneStarted {
                scene: 1,
                take: 3,
                replay: true
            }
        ),
        1
    );
}

#[test]
fn a_pause_begins_after_the_step_and_can_be_cancelled() {
    let mut world = World::started(SCENE);
    world.command(RunCommand::Pause);
    world.command(RunCommand::Resume);
    world.command(RunCommand::Pause);
    assert_eq!(world.until_asked(), Some(Question::Pause));
    assert_eq!(world.began.len(), 3, "the first step was played");
    let at = world.now;
    world.pass(Duration::from_secs(60));
    assert_eq!(world.began.len(), 3);
    assert_eq!(world.player.question(), Some(Question::Pause), "{at:?}");
    world.command(RunCommand::Resume);
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
}

#[test]
fn a_command_that_is_not_offered_does_nothing() {
    let mut world = World::new(SCENE, PlayOptions::default());
    world.begin();
    for command in [
        RunCommand::Replay,
        RunCommand::GoOn,
        RunCommand::Retry,
        RunCommand::Pause,
        RunCommand::Jump { scene: 2 },
    ] {
        assert!(
            !world
                .player
                .handle_command(world.now, command, DecidedBy::Operator),
            "{command:?}"
        );
    }
    world.command(RunCommand::Start);
    for command in [
        RunCommand::Start,
        RunCommand::Skip,
        RunCommand::Leave,
        RunCommand::Jump { scene: 1 },
    ] {
        assert!(
            !world
                .player
                .handle_command(world.now, command, DecidedBy::Operator),
            "{command:?}"
        );
    }
    assert_eq!(world.until_asked(), Some(Question::Scene { scene: 1 }));
}

#[test]
fn a_run_can_be_limited_to_a_scene_and_start_at_a_step() {
    let options = PlayOptions {
        scene: Some(0),
        from: Some((0, 1)),
        ..PlayOptions::default()
    };
    let mut world = World::new(SCENE, options);
    world.begin();
    world.run(on);
    assert_eq!(world.timeline(), [(2001, "lamp:light:1")]);

    let mut world = World::new(
        SCENE,
        PlayOptions {
            from: Some((1, 0)),
            ..PlayOptions::default()
        },
    );
    world.begin();
    world.run(on);
    assert_eq!(world.timeline(), [(1001, "robot:base:1")]);
    assert_eq!(count!(world, RunEvent::SceneSkipped { scene: 0, .. }), 1);
}

#[test]
fn thousands_of_empty_scenes_do_not_exhaust_the_stack() {
    let script: String = (0..3000).map(|scene| format!("s{scene}: {{}}\n")).collect();
    let mut world = World::new(&script, unattended());
    world.begin();
    assert_eq!(world.outcome(), Some(RunOutcome::Completed));
}

/// A script's reaction to a failure, by its parameter.
fn failing(policy: &str, goal: &str, options: PlayOptions) -> World {
    let script = format!(
        "s: {{a ({policy}): {{robot: {{base: {goal}, arm: 1}}}}, b: {{robot: {{head: 1}}}}}}"
    );
    let mut world = World::new(&script, options);
    world.begin();
    world
}

#[test]
fn a_script_continues_after_a_failure_like_the_original() {
    let mut world = failing("", "1 fail", PlayOptions::default());
    world.run(on);
    assert_eq!(world.began.len(), 3);
    assert_eq!(world.outcome(), Some(RunOutcome::Failures));
    assert_eq!(
        count!(
            world,
            RunEvent::StepEnded {
                end: Ending::Failures,
                ..
            }
        ),
        1
    );
    assert_eq!(
        count!(
            world,
            RunEvent::SceneEnded {
                end: Ending::Failures,
                ..
            }
        ),
        1
    );
}

#[test]
fn after_a_failure_the_operator_can_be_asked_and_retry() {
    let mut world = failing("on_failure=ask", "1 fail", PlayOptions::default());
    world.command(RunCommand::Start);
    assert_eq!(world.until_asked(), FIRST_STEP);
    assert_eq!(world.began.len(), 2);
    assert_eq!(
        count!(
            world,
            RunEvent::StepWaiting {
                why: WaitReason::Failed,
                ..
            }
        ),
        1
    );
    world.command(RunCommand::Retry);
    assert_eq!(world.until_asked(), FIRST_STEP);
    assert_eq!(world.began.len(), 3, "only what failed");
    world.command(RunCommand::GoOn);
    assert_eq!(world.until_asked(), Some(Question::End));
    assert_eq!(world.began.len(), 4);
    // Failed tasks can be retried afterwards, too.
    world.command(RunCommand::Retry);
    world.until_asked();
    assert_eq!(
        world.began.last().map(|began| began.task.as_str()),
        Some("robot:base:1 fail")
    );
}

#[test]
fn a_step_can_retry_by_itself_and_a_successful_retry_is_no_failure() {
    for times in 0..4 {
        let script =
            "s: {a (on_failure=retry 2): {robot: {base: 1, arm: 1}}, b: {robot: {head: 1}}}";
        let mut world = World::new(script, unattended());
        world.machine("robot").rejections.insert("arm", times);
        world.begin();
        world.run(on);
        let expected = if times <= 2 {
            RunOutcome::Completed
        } else {
            RunOutcome::Stopped
        };
        assert_eq!(world.outcome(), Some(expected), "{times}");
        let heads = world
            .began
            .iter()
            .filter(|began| began.task.contains("head"))
            .count();
        assert_eq!(heads, usize::from(times <= 2));
    }
}

#[test]
fn a_failure_can_stop_everything_at_once() {
    let mut world = failing("on_failure=stop", "1 fail", PlayOptions::default());
    world.machine("robot").rejections.insert("arm", 0);
    world.run(|_, question| match question {
        Question::Scene { .. } => Some(RunCommand::Start),
        _ => panic!("there is no question"),
    });
    assert_eq!(world.outcome(), Some(RunOutcome::Stopped));
    assert_eq!(world.began.len(), 2, "the next step was not started");
}

#[test]
fn a_task_over_its_time_limit_is_stopped() {
    for server in ["robot", "lamp"] {
        let script =
            format!("s: {{a: {{{server}: {{base (timeout=1.5): 9}}}}, b: {{robot: {{head: 1}}}}}}");
        let world = World::played_unattended(&script);
        assert_eq!(world.began.len(), 2);
        let base = &world.began[0];
        assert!(
            (1500..1510).contains(&base.until.since(base.at).as_millis()),
            "{base:?}"
        );
        assert!(world.began[1].at >= base.until);
        assert_eq!(world.outcome(), Some(RunOutcome::Failures));
    }
}

#[test]
fn an_unstoppable_task_over_its_limit_holds_its_step_for_a_decision() {
    let script = "s: {a: {robot: {base (timeout=1): 9 forever}}, b: {robot: {head: 1}}}";
    let mut world = World::started(script);
    assert_eq!(world.until_asked(), FIRST_STEP);
    assert_eq!(
        count!(
            world,
            RunEvent::StepWaiting {
                why: WaitReason::TooLong,
                ..
            }
        ),
        1
    );
    // It ends after all, which settles the question.
    world.pass(Duration::from_secs(9));
    assert_eq!(world.until_asked(), Some(Question::End));
    assert_eq!(world.outcome(), None);
    assert!(world.began[1].at >= world.began[0].until);
    // Without an operator everything is stopped.
    let world = World::played_unattended(script);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert_eq!(world.began.len(), 1);
}

#[test]
fn a_task_for_an_unconfigured_server_is_not_started_and_delays_nothing() {
    let script = "s: {a: {nobody: {base (delay=5): 1}, robot: {arm: 1}}}";
    let world = World::played_unattended(script);
    assert_eq!(world.timeline(), [(1, "robot:arm:1")]);
    assert_eq!(world.outcome(), Some(RunOutcome::Failures));
    assert_eq!(
        count!(
            world,
            RunEvent::TaskState {
                state: TaskState::NotStarted,
                ..
            }
        ),
        1
    );
}
