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

/// A relay whose pin fails a number of times.
struct Relay {
    loss: Loss,
    busy: Busy,
    /// Writes that fail.
    failing: u32,
    on: bool,
    failed: bool,
    every: u64,
    tick: Instant,
    /// How long it takes to become safe, in ms.
    slow: u64,
    safe_at: Instant,
    result: &'static str,
    calls: Grown<String>,
}

impl Relay {
    fn set(&mut self, on: bool) {
        self.failed = self.failing > 0;
        self.failing = self.failing.saturating_sub(1);
        if !self.failed {
            self.on = on;
        }
    }
}

impl Component for Relay {
    fn offer(&self) -> Offer<'_> {
        Offer::new("relay")
            .with_loss(self.loss)
            .with_busy(self.busy)
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.set(goal == "on");
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        if self.every > 0 {
            self.tick = now + Duration::from_millis(self.every);
        }
        if self.failed {
            report.text("pin failed");
            return Run::Failed;
        }
        match now < self.safe_at {
            true => Run::Running,
            false => Run::Completed,
        }
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, now: Instant) {
        self.calls.push(now.as_millis().to_string());
        self.safe_at = now + Duration::from_millis(self.slow);
        self.set(false);
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        match now < self.safe_at {
            true => now + Duration::from_millis(1),
            false => Instant::NEVER,
        }
    }

    fn result(&self) -> &str {
        self.result
    }

    fn next_tick(&self) -> Instant {
        self.tick
    }
}

const RELAY: Relay = Relay {
    loss: Loss::Abort,
    busy: Busy::Refuse,
    failing: 0,
    on: false,
    failed: false,
    every: 0,
    tick: Instant::NEVER,
    slow: 0,
    safe_at: Instant::ZERO,
    result: "",
    calls: Grown::new(),
};

/// Turns of a main loop that sleeps as long as the node allows. Returns what the node says.
fn sleep_for(gateway: &mut TestGateway<'_, [Relay; 2], 2>, millis: u64) -> String {
    let end = gateway.now + Duration::from_millis(millis);
    let mut heard = Grown::new();
    while gateway.now < end {
        gateway.node.handle_timeout(gateway.now);
        heard.extend(said(gateway.node, gateway.now, gateway.session));
        let next = gateway.node.poll_timeout(gateway.now);
        assert!(next > gateway.now, "sleeps");
        gateway.now = next.min(end);
    }
    heard.join(", ")
}

fn with_relays(relays: [Relay; 2], play: impl FnOnce(&mut TestGateway<'_, [Relay; 2], 2>)) {
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), relays);
    play(&mut gateway(&mut node));
}

#[test]
fn a_component_that_fails_to_become_safe_is_made_safe_until_it_is() {
    for failing in [1, 2, 3, 50] {
        with_relays([RELAY, RELAY], |gateway| {
            gateway.hello(5, 1);
            gateway.start(1, 9, 0, "on");
            sleep_for(gateway, 999);
            assert!(gateway.node.components()[0].on);
            gateway.node.components_mut()[0].failing = failing;
            sleep_for(gateway, 1);
            sleep_for(gateway, 10_000);
            let [relay, other] = gateway.node.components();
            assert!(!relay.on, "after {failing} failures");
            // At once and then every 50 ms, and no longer than it fails.
            let calls = relay.calls.len() as u32;
            assert_eq!(calls, failing + 1);
            assert_eq!(relay.calls[1], relay.calls[0]);
            let time = |call: &String| call.parse::<u64>().unwrap();
            let times = relay.calls[1..].iter().map(time).collect::<Grown<_>>();
            assert!(
                times.windows(2).all(|two| two[1] - two[0] == 50),
                "{times:?}"
            );
            assert_eq!(other.calls.len(), 1);
            assert_eq!(gateway.start(2, 10, 0, "on")[0], "2 Started 10");
        });
    }
}

#[test]
fn a_component_that_stays_unsafe_takes_no_task_and_disturbs_no_other() {
    let hold = Relay {
        loss: Loss::Hold,
        ..RELAY
    };
    with_relays([RELAY, hold], |gateway| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "on");
        gateway.node.components_mut()[0].failing = u32::MAX;
        gateway.node.stop_everything(gateway.now);
        assert_eq!(gateway.start(2, 10, 0, "on")[0], "2 Refused emergency stop");
        gateway.node.clear_stop();
        assert_eq!(
            gateway.start(3, 10, 0, "on")[0],
            "3 Refused busy with another task"
        );
        assert!(!sleep_for(gateway, 500).contains("Ended"));
        // The other one is safe. Its task fails, which is no reason to make it safe again.
        gateway.node.components_mut()[1].failing = 1;
        assert_eq!(gateway.start(4, 11, 1, "on")[0], "4 Started 11");
        assert!(sleep_for(gateway, 450).contains("Ended 11 FAILED pin failed"));
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(11) });
        assert_eq!(gateway.start(5, 12, 1, "on")[0], "5 Started 12");
        assert_eq!(gateway.node.components()[1].calls.len(), 1);
        gateway.node.components_mut()[0].failing = 0;
        let heard = sleep_for(gateway, 100);
        assert!(heard.contains("Ended 9 ABORTED emergency stop"), "{heard}");
        assert!(!gateway.node.components()[0].on);
        assert!(gateway.node.components()[1].on);
    });
}

#[test]
fn a_component_with_ticks_is_made_safe_again_at_the_same_rate() {
    let ticking = Relay {
        failing: u32::MAX,
        every: 7,
        tick: Instant::ZERO,
        ..RELAY
    };
    with_relays([ticking, RELAY], |gateway| {
        gateway.node.stop_everything(gateway.now);
        sleep_for(gateway, 1000);
        let calls = gateway.node.components()[0].calls.len();
        assert!((18..=22).contains(&calls), "{calls}");
        gateway.node.components_mut()[0].failing = 0;
        sleep_for(gateway, 1000);
        assert!(gateway.node.components()[0].calls.len() <= calls + 1);
    });
}

#[test]
fn a_neighbour_that_is_polled_often_changes_no_rate() {
    let slow = Relay {
        slow: 1000,
        ..RELAY
    };
    let failing = Relay {
        failing: u32::MAX,
        ..RELAY
    };
    with_relays([slow, failing], |gateway| {
        gateway.node.stop_everything(gateway.now);
        sleep_for(gateway, 1000);
        let calls = gateway.node.components()[1].calls.len();
        assert!((18..=22).contains(&calls), "{calls}");
    });
}

#[test]
fn a_component_that_keeps_a_result_takes_no_task_before_it_is_safe() {
    let keeping = Relay {
        busy: Busy::Queue(1),
        result: "long",
        ..RELAY
    };
    with_relays([keeping, RELAY], |gateway| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "on");
        assert!(sleep_for(gateway, 500).contains("Ended 9 COMPLETED"));
        gateway.node.components_mut()[0].failing = u32::MAX;
        sleep_for(gateway, 1000);
        let refused = "Refused busy going to its safe state";
        assert_eq!(gateway.start(2, 10, 0, "on")[0], format!("2 {refused}"));
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        assert_eq!(gateway.start(3, 10, 0, "on")[0], format!("3 {refused}"));
        gateway.node.components_mut()[0].failing = 0;
        sleep_for(gateway, 100);
        assert!(!gateway.node.components()[0].on);
        assert_eq!(gateway.start(4, 10, 0, "on")[0], "4 Started 10");
        sleep_for(gateway, 100);
        assert!(gateway.node.components()[0].on);
    });
}
