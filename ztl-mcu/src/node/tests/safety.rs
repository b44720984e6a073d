//! The way to the safe state: when the link is lost, and in an emergency stop.

use super::*;

#[test]
fn a_later_link_loss_makes_switched_on_outputs_safe() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "50");
        let ended = gateway.pass(50);
        assert_eq!(ended, ["Ended 9 COMPLETED moving"]);
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        gateway.command(2, Body::Ping);
        gateway.pass(999);
        assert_eq!(trace.borrow().as_slice(), ["a 50"]);
        gateway.pass(1);
        assert_eq!(trace.borrow().as_slice(), ["a 50", "a safe", "h safe"]);
        // Once: it stays as it is.
        gateway.pass(5000);
        assert_eq!(trace.borrow().len(), 3);
        // The next command starts the timer again, and so on.
        gateway.command(3, Body::Ping);
        gateway.pass(1000);
        assert_eq!(trace.borrow()[3..], ["a safe", "h safe"]);
    });
}

#[test]
fn a_component_is_polled_until_safe_and_its_task_then_ends() {
    with_node(|gateway, trace| {
        for motor in gateway.node.components_mut() {
            motor.slow = 300;
        }
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "50000");
        assert_eq!(gateway.pass(1000), ["Progress 9 moving"]);
        assert_eq!(trace.borrow().as_slice(), ["a 50000", "a safe", "h safe"]);
        // The link is back: no component accepts a task before it is safe, with or without a task of its own.
        let busy = "busy with another task";
        assert_said(
            gateway.start(2, 10, 0, "5"),
            &[&format!("2 Refused {busy}")],
        );
        let busy = "busy going to its safe state";
        assert_said(
            gateway.start(3, 10, 1, "5"),
            &[&format!("3 Refused {busy}")],
        );
        assert_said(gateway.start(4, 10, 2, "5"), &["4 Started 10"]);
        for _ in 0..29 {
            gateway.pass(10);
            assert_eq!(trace.borrow().len(), 4, "{trace:?}");
        }
        let heard = gateway.pass(10).join(", ");
        assert!(heard.contains("Ended 9 FAILED link was lost"), "{heard}");
        assert_eq!(trace.borrow()[4..], ["a rests", "h rests"]);
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        assert_eq!(gateway.start(5, 11, 1, "5")[0], "5 Started 11");
    });
}

#[test]
fn a_cleared_emergency_stop_lasts_until_each_component_is_safe() {
    with_node(|gateway, trace| {
        for motor in gateway.node.components_mut() {
            motor.slow = 300;
        }
        gateway.hello(5, 1);
        gateway.start(1, 9, 2, "50000");
        gateway.node.stop_everything(gateway.now);
        gateway.node.clear_stop();
        assert_eq!(trace.borrow()[1..], ["a safe", "h safe", "c safe"]);
        let busy = "busy going to its safe state";
        assert_eq!(gateway.start(2, 10, 1, "5")[0], format!("2 Refused {busy}"));
        // The link timer fires meanwhile: the end stays that of the stop.
        gateway.pass(299);
        gateway.pass(1);
        let ends = gateway.pass(1000).join(", ");
        assert!(ends.contains("Ended 9 ABORTED emergency stop"), "{ends}");
        assert!(trace.borrow().contains(&"c rests".into()), "{trace:?}");
    });
}
