//! Servers that pause, restart and refuse at every point; and stopping everything.

use std::time::Duration;

use ztl_core::Instant;

use super::world::{FIRST_STEP, World, count, on, unattended};
use crate::event::{Question, RunCommand, RunEvent, RunOutcome, WaitReason};
use crate::player::PlayOptions;

const SCRIPT: &str = "
s:
  a: {robot: {base: 0.4}, lamp: {light: 0.3}}
  b (delay=0.2): {lamp: {light: 0.5, fan(wait=no): 2}}
  c: {robot: {arm(delay=0.1): 0.3}}
";

/// The awaited tasks of each step.
const AWAITED: [&[&str]; 3] = [
    &["robot:base", "lamp:light:0.3"],
    &["lamp:light:0.5"],
    &["robot:arm"],
];

/// No step starts before the tasks that the one before waited for have really ended, and no task starts twice.
#[track_caller]
fn assert_in_order(world: &World, about: &str) {
    let find = |task: &str| {
        let mut began = world
            .began
            .iter()
            .filter(|began| began.task.starts_with(task));
        let first = began.next();
        assert_eq!(began.next(), None, "{about}: started twice");
        first
    };
    for (step, next) in AWAITED.iter().zip(AWAITED.iter().skip(1)) {
        for later in next.iter().filter_map(|task| find(task)) {
            for earlier in step.iter().map(|task| find(task)) {
                let Some(earlier) = earlier else {
                    panic!("{about}: {} before its step's turn", later.task);
                };
                assert!(
                    later.at >= earlier.until,
                    "{about}: {} while {} runs",
                    later.task,
                    earlier.task
                );
            }
        }
    }
}

/// Moments of the script, every 25 ms of its 1.6 s.
fn moments() -> impl Iterator<Item = Instant> {
    (0..68).map(|at| Instant::from_millis(at * 25))
}

/// An operator who waits while waiting may help, and otherwise continues.
fn patient(world: &World, question: Question) -> Option<RunCommand> {
    match (question, world.why()) {
        (Question::Step { .. }, Some(WaitReason::ServerSilent { .. } | WaitReason::TooLong)) => {
            None
        }
        _ => on(world, question),
    }
}

#[test]
fn the_run_waits_for_a_server_that_pauses_at_any_point() {
    for name in ["robot", "lamp"] {
        for length in [300, 1900, 2500, 7000] {
            for at in moments() {
                let about = format!("{name} silent for {length} ms from {at:?}");
                let mut world = World::new(SCRIPT, PlayOptions::default());
                let pause = (at, at + Duration::from_millis(length));
                world.machine(name).pauses.push(pause);
                world.begin();
                world.run(patient);
                // The original's server never answered an INIT: the operator went on.
                let guessed = world.seen(|event| {
                    matches!(
                        event,
                        RunEvent::StepWaiting {
                            why: WaitReason::StartUnknown,
                            ..
                        }
                    )
                });
                let never = world.began.len() < 5;
                if guessed.is_empty() && !never {
                    assert_in_order(&world, &about);
                    assert_eq!(world.outcome(), Some(RunOutcome::Completed), "{about}");
                } else {
                    assert_eq!(world.outcome(), Some(RunOutcome::Failures), "{about}");
                }
                assert!(world.began.len() <= 5, "{about}: {:?}", world.timeline());
                assert!(guessed.is_empty() || name == "robot", "{about}");
            }
        }
    }
}

#[test]
fn a_step_reports_a_silent_server_and_goes_on_when_it_is_back() {
    for name in ["robot", "lamp"] {
        let script = format!("s: {{a: {{{name}: {{base: 1}}}}, b: {{robot: {{arm: 1}}}}}}");
        let mut world = World::started_with(&script, |world| world.pause(name, 500, 30_000));
        assert_eq!(world.until_asked(), FIRST_STEP);
        assert_eq!(
            world.why(),
            Some(&WaitReason::ServerSilent {
                remote: name.to_owned()
            })
        );
        assert!(
            world.now < Instant::from_millis(5000),
            "it is told soon: {:?}",
            world.now
        );
        world.pass(Duration::from_secs(20));
        assert_eq!(world.began.len(), 1);
        assert_eq!(world.until_asked(), FIRST_STEP);
        world.run(patient);
        assert_eq!(world.began.len(), 2);
        assert!(world.began[1].at >= Instant::from_millis(30_000));
        assert_eq!(count!(world, RunEvent::StepGoesOn { .. }), 1);
        assert_eq!(world.outcome(), Some(RunOutcome::Completed));
    }
}

#[test]
fn a_server_restart_at_any_point_is_noticed_and_needs_a_decision() {
    for name in ["robot", "lamp"] {
        for at in moments() {
            let about = format!("{name} restarted at {at:?}");
            let mut world = World::new(SCRIPT, PlayOptions::default());
            world.machine(name).restarts.push(at);
            world.begin();
            let mut asked = 0;
            world.run(|world, question| {
                if matches!(question, Question::Step { .. }) {
                    asked += 1;
                }
                patient(world, question)
            });
            // The server's tasks ended with it.
            for began in &mut world.began {
                let of = if began.task.starts_with("robot") {
                    "robot"
                } else {
                    "lamp"
                };
                if of == name && began.at < at {
                    began.until = began.until.min(at);
                }
            }
            assert_in_order(&world, &about);
            assert_eq!(world.began.len(), 5, "{about}");
            let waiting = world.seen(|event| matches!(event, RunEvent::StepWaiting { .. }));
            let outcome = world.outcome();
            let expected = match waiting.is_empty() {
                true => RunOutcome::Completed,
                false => RunOutcome::Failures,
            };
            // The server may have lost the fan's background task, whose outcome is then unknown.
            let fan = outcome == Some(RunOutcome::Failures) && name == "lamp";
            assert!(outcome == Some(expected) || fan, "{about}: {outcome:?}");
            assert_eq!(asked > 0, !waiting.is_empty(), "{about}");
        }
    }
}

#[test]
fn a_reused_task_id_does_not_end_the_earlier_task() {
    let script = "s: {a: {robot: {base: 2, arm(delay=0.5): 0.1}}, b: {robot: {base: 0}}}";
    let mut world = World::new(script, PlayOptions::default());
    world
        .machine("robot")
        .restarts
        .push(Instant::from_millis(250));
    world.begin();
    world.command(RunCommand::Start);
    assert_eq!(world.until_asked(), FIRST_STEP);
    world.pass(Duration::from_secs(5));
    assert_eq!(
        world.player.question(),
        FIRST_STEP,
        "what became of the base?"
    );
    assert!(matches!(
        world.why(),
        Some(WaitReason::ServerRestarted { .. })
    ));
    assert_eq!(world.began.len(), 2, "{:?}", world.timeline());
}

#[test]
fn an_unattended_run_stops_where_a_decision_is_needed() {
    let mut world = World::new(SCRIPT, unattended());
    world
        .machine("robot")
        .restarts
        .push(Instant::from_millis(200));
    world.begin();
    world.run(patient);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert_eq!(world.began.len(), 2);
    assert!(
        world.began[1].until < Instant::from_millis(300),
        "the light was stopped"
    );

    // The run waits for a silent server for a while.
    let mut world = World::new(SCRIPT, unattended());
    world.pause("robot", 200, 300_000);
    world.begin();
    world.run(patient);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    let ended = world.now.since(Instant::ZERO);
    assert!((60..75).contains(&ended.as_secs()), "{ended:?}");
}

#[test]
fn an_unanswered_init_is_never_resent() {
    let script = "s: {a (on_failure=retry 5): {robot: {base: 1}}, b: {robot: {arm: 1}}}";
    let mut world = World::started_with(script, |world| world.pause("robot", 0, 2500));
    assert_eq!(world.until_asked(), FIRST_STEP);
    assert_eq!(world.why(), Some(&WaitReason::StartUnknown));
    assert!(
        !world.player.choices().contains(&RunCommand::Retry),
        "its failure is not known"
    );
    world.pass(Duration::from_secs(600));
    assert_eq!(world.timeline(), [(2501, "robot:base:1")]);
    world.run(patient);
    assert_eq!(world.outcome(), Some(RunOutcome::Failures));
    assert_eq!(world.began.len(), 2);
}

#[test]
fn a_task_with_an_unknown_outcome_holds_its_step_and_is_listed_at_the_end() {
    let script = "s: {a (on_failure=retry 5): {robot: {base: 1 lost}}, b: {robot: {arm: 1}}}";
    let mut world = World::started(script);
    assert_eq!(world.until_asked(), FIRST_STEP);
    let unclear = WaitReason::AnswerUnclear {
        remote: "robot".to_owned(),
    };
    assert_eq!(world.why(), Some(&unclear));
    assert!(!world.player.choices().contains(&RunCommand::Retry));
    assert_eq!(world.began.len(), 1);
    world.run(patient);
    let named = |event: &RunEvent| matches!(event, RunEvent::RunEnded { running, .. } if running.len() == 1);
    assert_eq!(world.seen(named).len(), 1);
    assert_eq!(world.outcome(), Some(RunOutcome::Failures));
    let world = World::played_unattended(script);
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert_eq!(world.began.len(), 1);
}

#[test]
fn everything_can_be_stopped_at_any_point_with_confirmed_final_states() {
    for at in moments() {
        let about = format!("stopped at {at:?}");
        let mut world = World::started(SCRIPT);
        world.pass(at.since(Instant::ZERO));
        let began = world.began.len();
        if world.player.question().is_some() {
            break;
        }
        world.command(RunCommand::Stop);
        world.run(|_, question| panic!("{about}: {question:?}"));
        assert_eq!(world.outcome(), Some(RunOutcome::Stopped), "{about}");
        assert_eq!(
            world.began.len(),
            began,
            "{about}: nothing was started afterwards"
        );
        let still: Vec<_> = world
            .began
            .iter()
            .filter(|began| began.until > world.now)
            .collect();
        assert!(still.is_empty(), "{about}: {still:?}");
        let confirmed = world.seen(|event| {
            matches!(
                event,
                RunEvent::StopAnswered {
                    confirmed: true,
                    ..
                }
            )
        });
        let Some(RunEvent::Stopping { tasks, .. }) = world
            .seen(|event| matches!(event, RunEvent::Stopping { .. }))
            .first()
            .copied()
        else {
            panic!("{about}");
        };
        assert_eq!(confirmed.len(), tasks.len(), "{about}");
        let Some((_, RunEvent::RunEnded { running, .. })) = world.events.last() else {
            panic!("{about}");
        };
        assert!(running.is_empty(), "{about}");
    }
}

#[test]
fn stopping_reaches_background_tasks_of_an_earlier_scene() {
    let script = "s: {a (wait=no): {robot: {base: 60}, lamp: {fan: 60}}}";
    let mut world = World::started(script);
    assert_eq!(world.until_asked(), Some(Question::End));
    world.command(RunCommand::Stop);
    world.run(|_, question| panic!("{question:?}"));
    assert!(
        world.began.iter().all(|began| began.until <= world.now),
        "{:?}",
        world.began
    );
    assert_eq!(world.began.len(), 2);
}

#[test]
fn stopping_reports_unstoppable_tasks_and_silent_servers() {
    let script = "s: {a: {robot: {base: 60 forever}, lamp: {light: 60}}}";
    let mut world = World::started(script);
    world.pass(Duration::from_millis(50));
    let silent = (world.now, world.now + Duration::from_secs(600));
    world.machine("lamp").pauses.push(silent);
    world.command(RunCommand::Stop);
    world.run(|_, question| panic!("{question:?}"));
    assert_eq!(
        count!(
            world,
            RunEvent::StopAnswered {
                confirmed: false,
                ..
            }
        ),
        2
    );
    let Some((
        _,
        RunEvent::RunEnded {
            running, outcome, ..
        },
    )) = world.events.last()
    else {
        panic!("{:?}", world.events.last());
    };
    assert_eq!((running.len(), *outcome), (2, RunOutcome::NotConfirmed));
    assert!(world.now < Instant::from_millis(10_000), "{:?}", world.now);
}

#[test]
fn a_second_stop_leaves_at_once() {
    let script = "s: {a: {lamp: {light: 60}}}";
    let mut world = World::started(script);
    world.pass(Duration::from_millis(50));
    world.pause("lamp", 0, 600_000);
    world.command(RunCommand::Stop);
    world.pass(Duration::from_millis(50));
    assert_eq!(world.outcome(), None);
    assert!(world.stop_by_signal());
    assert_eq!(world.outcome(), Some(RunOutcome::NotConfirmed));
    assert!(!world.stop_by_signal());
}

#[test]
fn a_pending_init_is_stopped_with_everything_else() {
    for name in ["robot", "lamp"] {
        let script = format!("s: {{a: {{{name}: {{base: 60}}}}}}");
        let mut world = World::started_with(&script, |world| world.pause(name, 0, 1000));
        world.pass(Duration::from_millis(100));
        world.command(RunCommand::Stop);
        world.run(|_, question| panic!("{question:?}"));
        assert_eq!(world.began.len(), 1, "it was acted on late");
        assert!(world.began[0].until <= world.now);
    }
}

#[test]
fn the_operator_is_asked_about_an_absent_server_unless_the_script_says_to_go_on() {
    for (policy, asked) in [("", true), ("(on_failure=go on)", false)] {
        let script =
            format!("s: {{'a{policy}': {{lamp: {{light: 1}}}}, b: {{robot: {{arm: 1}}}}}}");
        let mut world = World::started_with(&script, |world| world.pause("lamp", 0, 7000));
        let question = world.until_asked();
        assert_eq!(
            question == Some(Question::Step { scene: 0, step: 0 }),
            asked
        );
        if asked {
            assert!(world.began.is_empty());
            world.command(RunCommand::Retry);
            assert_eq!(world.until_asked(), Some(Question::End));
            assert_eq!(world.began.len(), 2);
        }
        let mut world = World::new(&script, unattended());
        world.pause("lamp", 0, 7000);
        world.begin();
        world.run(on);
        assert_eq!(world.began.len(), usize::from(!asked), "{policy}");
    }
}

#[test]
fn an_unanswered_init_does_not_delay_the_end_of_a_stop() {
    let script = "s: {a: {robot: {base: 60}}}";
    let mut world = World::started_with(script, |world| world.pause("robot", 0, 600_000));
    world.pass(Duration::from_millis(100));
    world.command(RunCommand::Stop);
    world.run(|_, question| panic!("{question:?}"));
    assert_eq!(
        count!(
            world,
            RunEvent::StopAnswered {
                confirmed: false,
                ..
            }
        ),
        1
    );
    assert!(world.now <= Instant::from_millis(2001), "{:?}", world.now);
}

#[test]
fn a_step_is_not_retried_automatically_after_asking_the_operator() {
    let silent = (Instant::from_millis(500), Instant::from_millis(9500));
    // One exceeds its limit and stops late; one fails while its server is silent.
    for (task, pause) in [
        ("base(timeout=1): 5 stubborn", None),
        ("base: 1 fail", Some(silent)),
    ] {
        let script = format!("s: {{a (on_failure=retry 2): {{robot: {{{task}}}}}}}");
        let mut world = World::new(&script, PlayOptions::default());
        world.machine("robot").pauses.extend(pause);
        world.begin();
        world.command(RunCommand::Start);
        assert_eq!(world.until_asked(), FIRST_STEP, "{task}");
        assert!(world.why().is_some_and(WaitReason::may_mend), "{task}");
        world.pass(Duration::from_secs(60));
        assert_eq!(world.began.len(), 1, "{task}: there was no decision");
        assert_eq!(world.player.question(), FIRST_STEP, "{task}");
        assert_eq!(world.why(), Some(&WaitReason::Failed), "{task}");
        assert!(
            world.player.choices().contains(&RunCommand::Retry),
            "{task}"
        );
        world.command(RunCommand::Retry);
        world.pass(Duration::from_secs(60));
        assert_eq!(world.began.len(), 2, "{task}: once for each decision");
        assert_eq!(world.player.question(), FIRST_STEP, "{task}");

        // An unattended run ends as after a failure.
        let mut world = World::new(&script, unattended());
        world.machine("robot").pauses.extend(pause);
        world.begin();
        world.run(on);
        assert_eq!(world.began.len(), 1, "{task}: unattended");
        assert_eq!(world.outcome(), Some(RunOutcome::Stopped), "{task}");
    }
}

#[test]
fn a_failed_retry_can_be_retried_while_another_task_is_unknown() {
    let script = "s: {a (parallel; on_failure=ask): {robot: {base: 100}, lamp: {arm: 1 fail}}}";
    let mut world = World::started_with(script, |world| world.pause("robot", 500, 500_000));
    for arms in 1..4 {
        world.pass(Duration::from_secs(10));
        assert!(matches!(world.why(), Some(WaitReason::ServerSilent { .. })));
        assert_eq!(world.began.len(), 1 + arms);
        let asked = world.seen(|event| matches!(event, RunEvent::Asked { .. }));
        let Some(RunEvent::Asked { choices, .. }) = asked.last() else {
            panic!("{asked:?}");
        };
        assert!(choices.contains(&RunCommand::Retry), "{choices:?}");
        world.command(RunCommand::Retry);
    }
}
