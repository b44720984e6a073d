//! The reaction to a second task, by the component's policy.

use super::*;

/// Runs `play` against a node with one motor of this policy and two others, and room for four tasks.
fn with_motor(
    busy: Busy,
    loss: Loss,
    play: impl FnOnce(&mut TestGateway<'_, [Motor<'_>; 3], 4>, &Trace),
) {
    let trace = Trace::default();
    let mut components = [
        motor("m", loss, &trace),
        motor("n", Loss::CarryOn, &trace),
        motor("o", Loss::CarryOn, &trace),
    ];
    components[0].busy = busy;
    let mut node = TestNode::<4>::new(Identity::new("desk", "1", 77), components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    play(&mut gateway, &trace);
}

const WAITS: &str = "waits for another task to end";

#[test]
fn a_queued_task_starts_when_the_previous_one_has_ended() {
    with_motor(Busy::Queue(2), Loss::Abort, |gateway, trace| {
        assert_said(gateway.start(1, 7, 0, "50"), &["1 Started 7"]);
        let waits = format!("Progress 8 {WAITS}");
        assert_said(gateway.start(2, 8, 0, "60"), &["2 Started 8", &waits]);
        assert_said(
            gateway.start(3, 9, 0, "70"),
            &["3 Started 9", &format!("Progress 9 {WAITS}")],
        );
        assert_said(
            gateway.start(4, 10, 0, "80"),
            &["4 Refused busy, and no more tasks may wait"],
        );
        // Another component is not concerned.
        assert_said(gateway.start(5, 10, 1, "500"), &["5 Started 10"]);
        assert_eq!(trace.borrow().as_slice(), ["m 50", "n 500"]);

        let heard = gateway.pass(50).join(", ");
        assert!(heard.starts_with("Ended 7 COMPLETED moving, "), "{heard}");
        assert_eq!(trace.borrow().as_slice(), ["m 50", "n 500", "m 60"]);
        let heard = gateway.pass(60).join(", ");
        assert!(heard.starts_with("Ended 8 COMPLETED moving, "), "{heard}");
        assert_eq!(trace.borrow().as_slice(), ["m 50", "n 500", "m 60", "m 70"]);
    });
}

#[test]
fn the_lowest_waiting_id_starts_first() {
    with_motor(Busy::Queue(9), Loss::Abort, |gateway, trace| {
        // The end of the first one, given up, changes the order in the table.
        gateway.start(1, 1, 1, "1");
        for (seq, task) in [(2, 2), (3, 3), (4, 4)] {
            gateway.start(seq, task, 0, &format!("{}", task * 10));
        }
        gateway.pass(1);
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(1) });
        gateway.start(5, 5, 0, "50");
        for _ in 0..40 {
            gateway.pass(10);
        }
        let trace = trace.borrow();
        assert_eq!(trace.as_slice(), ["n 1", "m 20", "m 30", "m 40", "m 50"]);
    });
}

#[test]
fn a_goal_is_checked_before_it_is_queued() {
    with_motor(Busy::Queue(2), Loss::Abort, |gateway, _| {
        gateway.start(1, 7, 0, "50");
        assert_said(gateway.start(2, 8, 0, "far"), &["2 Refused a number of ms"]);
        let long = format!("{:>49}", "5");
        let reason = "busy, and the goal is too long to wait: more than 48 bytes";
        assert_said(
            gateway.start(3, 8, 0, &long),
            &[&format!("3 Refused {reason}")],
        );
        assert_said(
            gateway.start(4, 8, 0, &long[1..]),
            &["4 Started 8", &format!("Progress 8 {WAITS}")],
        );
    });
}

#[test]
fn a_queued_task_rejected_at_its_start_fails_with_the_reason() {
    with_motor(Busy::Queue(2), Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "50");
        gateway.start(2, 8, 0, "13");
        gateway.start(3, 9, 0, "60");
        let heard = gateway.pass(50).join(", ");
        let ends = "Ended 7 COMPLETED moving, Ended 8 FAILED not the 13, ";
        assert!(heard.starts_with(ends), "{heard}");
        assert_eq!(trace.borrow().as_slice(), ["m 50", "m 60"]);
        // Without a task to wait for, the goal is refused at once.
        assert_said(gateway.start(4, 10, 1, "13"), &["4 Refused not the 13"]);
    });
}

#[test]
fn a_task_with_the_highest_id_waits_in_the_queue() {
    with_motor(Busy::Queue(2), Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "50");
        gateway.start(2, u32::MAX, 0, "60");
        gateway.pass(10);
        assert_eq!(trace.borrow().as_slice(), ["m 50"]);
        gateway.pass(50);
        assert_eq!(trace.borrow().as_slice(), ["m 50", "m 60"]);
    });
}

#[test]
fn abort_of_a_queued_task_ends_it_at_once() {
    with_motor(Busy::Queue(2), Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "50");
        gateway.start(2, 8, 0, "60");
        let abort = Body::Abort { task: LinkId(8) };
        assert_said(
            gateway.command(3, abort),
            &["3 Aborting 8", "Ended 8 ABORTED aborted before it began"],
        );
        gateway.pass(50);
        gateway.pass(50);
        assert_eq!(trace.borrow().as_slice(), ["m 50"]);
    });
}

#[test]
fn a_later_task_replaces_the_running_and_waiting_ones() {
    with_motor(Busy::Replace, Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "500");
        let waits = |task| format!("Progress {task} {WAITS}");
        assert_said(gateway.start(2, 8, 0, "600"), &["2 Started 8", &waits(8)]);
        assert_said(
            gateway.start(3, 9, 0, "700"),
            &[
                "3 Started 9",
                "Ended 8 ABORTED replaced by a later task",
                &waits(9),
            ],
        );
        // It begins only when the first has stopped.
        assert_eq!(trace.borrow().as_slice(), ["m 500", "m abort"]);
        let heard = gateway.pass(1).join(", ");
        assert!(
            heard.contains("Ended 7 ABORTED replaced by a later task"),
            "{heard}"
        );
        assert_eq!(trace.borrow().as_slice(), ["m 500", "m abort", "m 700"]);
        // A goal that is not taken replaces nothing.
        assert_said(
            gateway.start(4, 10, 0, "far"),
            &["4 Refused a number of ms"],
        );
        assert_eq!(trace.borrow().len(), 3);
    });
}

#[test]
fn a_task_without_room_replaces_nothing() {
    with_motor(Busy::Replace, Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "500");
        gateway.start(2, 8, 1, "500");
        gateway.start(3, 9, 2, "500");
        gateway.start(4, 10, 0, "500");
        gateway.pass(1);
        assert_said(
            gateway.start(5, 11, 0, "500"),
            &["5 Refused ends not yet acknowledged"],
        );
        let aborts = trace.borrow().iter().filter(|t| *t == "m abort").count();
        assert_eq!(aborts, 1);
    });
}

#[test]
fn a_replaced_task_that_completes_first_keeps_its_outcome() {
    with_motor(Busy::Replace, Loss::Abort, |gateway, trace| {
        gateway.start(1, 7, 0, "500");
        gateway.start(2, 8, 0, "600");
        // The motor did not hear the abort.
        gateway.node.components_mut()[0].aborted = false;
        let heard = gateway.pass(500).join(", ");
        assert!(heard.contains("Ended 7 COMPLETED moving"), "{heard}");
        assert_eq!(trace.borrow().last().unwrap(), "m 600");
    });
}

#[test]
fn a_lost_link_ends_running_and_waiting_tasks() {
    with_motor(Busy::Queue(2), Loss::Hold, |gateway, trace| {
        gateway.start(1, 7, 0, "5000");
        gateway.start(2, 8, 0, "60");
        assert_said(
            gateway.pass(1000),
            &[
                "Ended 7 FAILED link was lost",
                "Ended 8 FAILED link was lost",
            ],
        );
        gateway.pass(1000);
        // The two others carry on.
        assert_eq!(trace.borrow().as_slice(), ["m 5000", "m safe"]);
    });
}

#[test]
fn a_component_that_carries_on_runs_its_waiting_tasks() {
    with_motor(Busy::Queue(2), Loss::CarryOn, |gateway, trace| {
        gateway.start(1, 7, 0, "2000");
        gateway.start(2, 8, 0, "60");
        let heard: Grown<String> = (0..25).flat_map(|_| gateway.pass(100)).collect();
        assert!(
            heard.iter().any(|l| l == "Ended 8 COMPLETED moving"),
            "{heard:?}"
        );
        assert_eq!(trace.borrow().as_slice(), ["m 2000", "m 60"]);
    });
}

#[test]
fn an_emergency_stop_ends_waiting_tasks() {
    with_motor(Busy::Queue(2), Loss::CarryOn, |gateway, trace| {
        gateway.start(1, 7, 0, "2000");
        gateway.start(2, 8, 0, "60");
        gateway.node.stop_everything(gateway.now);
        assert!(gateway.node.is_stopped());
        assert_said(
            gateway.pass(1),
            &[
                "Ended 7 ABORTED emergency stop",
                "Ended 8 ABORTED emergency stop",
            ],
        );
        gateway.pass(3000);
        let safe = ["m 2000", "m safe", "n safe", "o safe"];
        // The link timer has fired since, and all of them are safe.
        assert_eq!(trace.borrow().as_slice(), safe);
        assert_said(gateway.start(3, 9, 1, "5"), &["3 Refused emergency stop"]);
        // The ends are in the way of new tasks until they are known.
        for task in [7, 8] {
            gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(task) });
        }
        gateway.node.clear_stop();
        assert_said(gateway.start(4, 9, 0, "5"), &["4 Started 9"]);
    });
}

#[test]
fn a_new_session_lists_the_waiting_tasks() {
    with_motor(Busy::Queue(2), Loss::CarryOn, |gateway, _| {
        gateway.start(1, 7, 0, "2000");
        gateway.start(2, 8, 0, "60");
        assert_said(
            gateway.hello(6, 1),
            &[
                "Welcome boot 77 replaces 5 highest 8 [7, 8]",
                "Progress 7 ",
                &format!("Progress 8 {WAITS}"),
            ],
        );
    });
}

#[test]
fn a_component_never_runs_two_tasks() {
    // For any tasks in any order, a start comes only after the end of the previous task.
    for policy in [Busy::Refuse, Busy::Queue(3), Busy::Replace] {
        for seed in 1..200u32 {
            with_motor(policy, Loss::CarryOn, |gateway, trace| {
                let mut dice = seed;
                let mut next = |bound| {
                    dice = dice.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    (dice >> 16) % bound
                };
                let mut task = 0;
                let mut seq = 0;
                for _ in 0..60 {
                    seq += 1;
                    let known = LinkId(1 + next(task + 1));
                    match next(5) {
                        0 | 1 => {
                            task += 1;
                            gateway.start(seq, task, 0, &format!("{}", 10 + next(20)));
                        }
                        2 => drop(gateway.command(seq, Body::Abort { task: known })),
                        3 => {
                            gateway.send(key(5), NO_SEQ, Body::Ack { task: known });
                            seq -= 1;
                        }
                        _ => {
                            gateway.pass(u64::from(next(15)));
                            seq -= 1;
                        }
                    }
                    // A motor that were started twice would say so.
                    assert!(!trace.borrow().iter().any(|line| line.contains("twice")));
                }
                assert!(!trace.borrow().is_empty());
            });
        }
    }
}
