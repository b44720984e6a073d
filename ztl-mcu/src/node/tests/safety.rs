//! The way to the safe state: when the link is lost, and in an emergency stop.

use super::*;

#[test]
fn a_later_link_loss_makes_switched_on_outputs_safe() {
    with_node(|desk, trace| {
        desk.hello(5, 1);
        desk.start(1, 9, 0, "50");
        let ended = desk.pass(50);
        assert_eq!(ended, ["Ended 9 COMPLETED moving"]);
        desk.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        desk.command(2, Body::Ping);
        desk.pass(999);
        assert_eq!(trace.borrow().as_slice(), ["a 50"]);
        desk.pass(1);
        assert_eq!(trace.borrow().as_slice(), ["a 50", "a safe", "h safe"]);
        // Once: it stays as it is.
        desk.pass(5000);
        assert_eq!(trace.borrow().len(), 3);
        // The next command starts the timer again, and so on.
        desk.command(3, Body::Ping);
        desk.pass(1000);
        assert_eq!(trace.borrow()[3..], ["a safe", "h safe"]);
    });
}

#[test]
fn a_component_is_polled_until_safe_and_its_task_then_ends() {
    with_node(|desk, trace| {
        for motor in desk.node.components_mut() {
            motor.slow = 300;
        }
        desk.hello(5, 1);
        desk.start(1, 9, 0, "50000");
        assert_eq!(desk.pass(1000), ["Progress 9 moving"]);
        assert_eq!(trace.borrow().as_slice(), ["a 50000", "a safe", "h safe"]);
        // The link is back: no component accepts a task before it is safe, with or without a task of its own.
        let busy = "busy with another task";
        assert_said(desk.start(2, 10, 0, "5"), &[&format!("2 Refused {busy}")]);
        let busy = "busy going to its safe state";
        assert_said(desk.start(3, 10, 1, "5"), &[&format!("3 Refused {busy}")]);
        assert_said(desk.start(4, 10, 2, "5"), &["4 Started 10"]);
        for _ in 0..29 {
            desk.pass(10);
            assert_eq!(trace.borrow().len(), 4, "{trace:?}");
        }
        let heard = desk.pass(10).join(", ");
        assert!(heard.contains("Ended 9 FAILED link was lost"), "{heard}");
        assert_eq!(trace.borrow()[4..], ["a rests", "h rests"]);
        desk.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        assert_eq!(desk.start(5, 11, 1, "5")[0], "5 Started 11");
    });
}

#[test]
fn a_cleared_emergency_stop_lasts_until_each_component_is_safe() {
    with_node(|desk, trace| {
        for motor in desk.node.components_mut() {
            motor.slow = 300;
        }
        desk.hello(5, 1);
        desk.start(1, 9, 2, "50000");
        desk.node.stop_everything(desk.now);
        desk.node.clear_stop();
        assert_eq!(trace.borrow()[1..], ["a safe", "h safe", "c safe"]);
        let busy = "busy going to its safe state";
        assert_eq!(desk.start(2, 10, 1, "5")[0], format!("2 Refused {busy}"));
        // The link timer fires meanwhile: the end stays that of the stop.
        desk.pass(299);
        desk.pass(1);
        let ends = desk.pass(1000).join(", ");
        assert!(ends.contains("Ended 9 ABORTED emergency stop"), "{ends}");
        assert!(trace.borrow().contains(&"c rests".into()), "{trace:?}");
    });
}
