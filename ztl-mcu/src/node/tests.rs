//! A node and a gateway played by hand, on virtual time.

mod descriptions;
mod limits;
mod own;
mod parameters;
mod policies;
mod readings;
mod refusals;
mod safety;
mod sessions;
mod ticks;
mod update;

use super::*;
use crate::component::{Component, Refused, Report, Run};
use core::time::Duration;
use std::cell::RefCell;
use std::format;
use std::string::{String, ToString};
use std::vec::Vec as Grown;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Busy, Frame, Hello, Loss, Offer, VERSION, Welcome, encode, session_key,
};

/// The calls that a motor received, in order.
type Trace = RefCell<Grown<String>>;

/// Moves until it is aborted.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Motor<'t> {
    name: &'static str,
    busy: Busy,
    loss: Loss,
    trace: &'t Trace,
    ends_at: Option<Instant>,
    aborted: bool,
    moving: bool,
    /// How long it takes to its safe state, in ms, and when it is there.
    slow: u64,
    safe_at: Option<Instant>,
}

impl Component for Motor<'_> {
    fn offer(&self) -> Offer<'_> {
        Offer::new(self.name)
            .with_range(0.0, 100.0, "ms")
            .with_busy(self.busy)
            .with_loss(self.loss)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        goal.trim().parse::<u64>().map(drop).map_err(|_| {
            why.text("a number of ms");
            Refused
        })
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        let millis = goal.trim().parse().map_err(|_| Refused)?;
        if millis == 13 {
            why.text("not the 13");
            return Err(Refused);
        }
        let twice = if self.moving { " twice" } else { "" };
        assert_eq!(self.safe_at, None, "started before it is safe");
        self.moving = true;
        self.trace
            .borrow_mut()
            .push(format!("{} {goal}{twice}", self.name));
        self.ends_at = Some(now + Duration::from_millis(millis));
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        report.text("moving");
        if let Some(at) = self.safe_at {
            if now < at {
                return Run::Running;
            }
            self.safe_at = None;
            self.moving = false;
            self.trace.borrow_mut().push(format!("{} rests", self.name));
        }
        if self.aborted {
            self.moving = false;
            return Run::Aborted;
        }
        if self.ends_at.is_some_and(|end| end <= now) {
            self.moving = false;
            return Run::Completed;
        }
        Run::Running
    }

    fn abort(&mut self, _now: Instant) {
        self.trace.borrow_mut().push(format!("{} abort", self.name));
        self.aborted = true;
    }

    fn make_safe(&mut self, now: Instant) {
        self.aborted = true;
        if self.slow > 0 {
            self.safe_at = Some(now + Duration::from_millis(self.slow));
        }
        self.trace.borrow_mut().push(format!("{} safe", self.name));
    }
}

fn motor<'t>(name: &'static str, loss: Loss, trace: &'t Trace) -> Motor<'t> {
    Motor {
        name,
        busy: Busy::Refuse,
        loss,
        trace,
        ends_at: None,
        aborted: false,
        moving: false,
        slow: 0,
        safe_at: None,
    }
}

type TestNode<'t, const TASKS: usize = 2> = Node<'static, [Motor<'t>; 3], TASKS, 128>;

/// The session that a `Hello` opens with the node of these tests.
fn key(hello: u32) -> u32 {
    session_key(hello, 77)
}

/// A node's messages, with the seq in front.
fn said<C: Components, const TASKS: usize>(
    node: &mut Node<'_, C, TASKS, 128>,
    now: Instant,
    hello: u32,
) -> Grown<String> {
    let mut decoder = Decoder::<160>::new();
    let mut heard = Grown::new();
    let mut buffer = [0xA5; 7];
    loop {
        let count = node.poll_transmit(now, &mut buffer);
        if count == 0 {
            return heard;
        }
        for &byte in &buffer[..count] {
            if decoder.push(byte) == Ok(true) {
                let (_, frame) = decoder.frame(&[key(hello), hello, NO_SESSION]).unwrap();
                heard.push(match frame.body {
                    Body::Welcome(Welcome {
                        boot,
                        replaces,
                        highest,
                        held,
                        ..
                    }) => {
                        let held: Grown<u32> = held.iter().map(|id| id.0).collect();
                        format!(
                            "Welcome boot {boot} replaces {replaces} highest {highest} {held:?}"
                        )
                    }
                    Body::Ended {
                        task,
                        state,
                        result,
                    } => {
                        format!("Ended {} {state} {result}", task.0)
                    }
                    Body::Refused { reason } => format!("{} Refused {reason}", frame.seq),
                    Body::Started { task } => format!("{} Started {}", frame.seq, task.0),
                    Body::Aborting { task } => format!("{} Aborting {}", frame.seq, task.0),
                    Body::Pong { held, .. } => format!("{} Pong {held}", frame.seq),
                    Body::Progress { task, text } => format!("Progress {} {text}", task.0),
                    Body::Component { index, offer } => {
                        format!("{} Component {index} {}", frame.seq, offer.name)
                    }
                    Body::Awake { boot, .. } => format!("Awake {boot}"),
                    other => format!("{other:?}"),
                });
            }
        }
    }
}

/// A gateway's side of a session, played by hand.
struct TestGateway<'n, C, const TASKS: usize> {
    node: &'n mut Node<'static, C, TASKS, 128>,
    session: u32,
    now: Instant,
}

impl<C: Components, const TASKS: usize> TestGateway<'_, C, TASKS> {
    /// Gives a message to the node without taking its answer.
    fn write(&mut self, session: u32, seq: u8, body: Body<'_>) {
        let mut buffer = [0xA5; 160];
        let frame = Frame {
            addr: ADDR_ONLY_NODE,
            seq,
            body,
        };
        let len = encode(session, &frame, &mut buffer).unwrap();
        self.node.handle_bytes(self.now, &buffer[..len]);
    }

    fn send(&mut self, session: u32, seq: u8, body: Body<'_>) -> Grown<String> {
        self.write(session, seq, body);
        said(self.node, self.now, self.session)
    }

    fn hello(&mut self, session: u32, gateway: u64) -> Grown<String> {
        let hello = Hello {
            version: VERSION,
            session,
            gateway,
        };
        let before = core::mem::replace(&mut self.session, session);
        let heard = self.send(NO_SESSION, NO_SEQ, Body::Hello(hello));
        if heard.iter().any(|line| line.contains("Refused")) {
            self.session = before;
        }
        heard
    }

    fn command(&mut self, seq: u8, body: Body<'_>) -> Grown<String> {
        self.send(key(self.session), seq, body)
    }

    fn start(&mut self, seq: u8, task: u32, component: u8, goal: &str) -> Grown<String> {
        let before_ms = u64::MAX;
        let task = LinkId(task);
        self.command(
            seq,
            Body::Start {
                task,
                component,
                goal,
                before_ms,
            },
        )
    }

    fn pass(&mut self, millis: u64) -> Grown<String> {
        self.now = self.now + Duration::from_millis(millis);
        self.node.handle_timeout(self.now);
        said(self.node, self.now, self.session)
    }
}

/// Runs `play` against a node with three motors: abort, hold and carry on when the link is lost.
fn with_node(play: impl FnOnce(&mut TestGateway<'_, [Motor<'_>; 3], 2>, &Trace)) {
    let trace = Trace::default();
    let components = [
        motor("a", Loss::Abort, &trace),
        motor("h", Loss::Hold, &trace),
        motor("c", Loss::CarryOn, &trace),
    ];
    let mut node = TestNode::new(Identity::new("desk", "1", 77), components);
    play(&mut gateway(&mut node), &trace);
}

fn gateway<'n, C, const TASKS: usize>(
    node: &'n mut Node<'static, C, TASKS, 128>,
) -> TestGateway<'n, C, TASKS> {
    TestGateway {
        node,
        session: 5,
        now: Instant::from_millis(10_000),
    }
}

/// What a node says to a gateway that asks for its components only, and for nothing that came later.
fn play_older_gateway<C: Components>(mut gateway: TestGateway<'_, C, 2>) -> Grown<String> {
    let mut heard = gateway.pass(300);
    heard.extend(gateway.hello(5, 1));
    let count = gateway.node.components().count() as u8;
    for index in 0..count {
        heard.extend(gateway.command(index + 1, Body::Describe { index }));
    }
    heard.extend(gateway.start(count + 1, 1, 0, "50"));
    heard.extend(gateway.command(count + 2, Body::Ping));
    heard.extend(gateway.command(count + 3, Body::Abort { task: LinkId(1) }));
    heard.extend(gateway.pass(100));
    heard.extend(gateway.hello(6, 1));
    heard.extend(gateway.pass(5000));
    heard
}

#[track_caller]
fn assert_said(heard: Grown<String>, expected: &[&str]) {
    assert_eq!(heard, expected);
}

#[test]
fn nodes_with_the_same_future_behaviour_are_equal() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        let before = gateway.node.clone();
        gateway.node.handle_bytes(gateway.now, &[7, 7, 7, 0]);
        assert!(*gateway.node == before, "what was counted does not matter");
        assert_ne!(gateway.node.counters(), before.counters());
        gateway.node.handle_bytes(gateway.now, &[7]);
        assert!(*gateway.node != before, "a frame has begun");
        gateway.node.handle_bytes(gateway.now, &[0]);
        gateway.start(1, 9, 0, "50");
        assert!(*gateway.node != before, "a task runs");
    });
}

#[test]
fn a_repeated_command_is_answered_but_not_executed_again() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        assert_said(gateway.start(1, 9, 0, "50"), &["1 Started 9"]);
        assert_said(gateway.start(1, 9, 0, "50"), &["1 Started 9"]);
        assert_said(gateway.start(1, 9, 0, "50"), &["1 Started 9"]);
        assert_eq!(trace.borrow().as_slice(), ["a 50"]);
        assert_eq!(gateway.node.counters().repeats, 2);
        // Out of sequence: the previous number and one too far ahead.
        assert_said(gateway.command(3, Body::Ping), &[]);
        assert_said(gateway.command(255, Body::Ping), &[]);
        assert_eq!(gateway.node.counters().out_of_sequence, 2);
        assert_said(gateway.command(2, Body::Ping), &["2 Pong 1"]);
    });
}

#[test]
fn the_sequence_number_wraps_from_255_to_1() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        for seq in 1..=255 {
            assert_said(
                gateway.command(seq, Body::Ping),
                &[&format!("{seq} Pong 0")],
            );
        }
        assert_said(gateway.command(0, Body::Ping), &[]);
        assert_said(gateway.command(1, Body::Ping), &["1 Pong 0"]);
    });
}

#[test]
fn a_task_reports_progress_and_repeats_its_outcome_until_acknowledged() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "50");
        assert_said(gateway.pass(10), &["Progress 9 moving"]);
        assert_said(gateway.pass(10), &[]);
        assert_said(gateway.pass(40), &["Ended 9 COMPLETED moving"]);
        assert_said(gateway.pass(99), &[]);
        assert_said(gateway.pass(1), &["Ended 9 COMPLETED moving"]);
        assert_said(gateway.command(2, Body::Ping), &["2 Pong 1"]);
        assert_said(
            gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) }),
            &[],
        );
        assert_said(gateway.pass(200), &[]);
        assert_said(gateway.command(3, Body::Ping), &["3 Pong 0"]);
    });
}

#[test]
fn an_acknowledgement_of_a_running_task_changes_nothing() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "50");
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        assert_said(gateway.pass(60), &["Ended 9 COMPLETED moving"]);
    });
}

#[test]
fn a_task_that_cannot_start_is_rejected_with_the_reason() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        assert_said(gateway.start(1, 9, 0, "far"), &["1 Refused a number of ms"]);
        assert_said(
            gateway.start(2, 9, 7, "1"),
            &["2 Refused no such component"],
        );
        let late = Body::Start {
            task: LinkId(9),
            component: 0,
            goal: "1",
            before_ms: 9_999,
        };
        assert_said(
            gateway.command(3, late),
            &["3 Refused the command came too late"],
        );
        assert!(trace.borrow().is_empty());
        assert_said(gateway.start(4, 9, 0, "50"), &["4 Started 9"]);
        assert_said(
            gateway.start(5, 10, 0, "50"),
            &["5 Refused busy with another task"],
        );
        assert_said(gateway.start(6, 10, 1, "50"), &["6 Started 10"]);
        assert_said(
            gateway.start(7, 11, 2, "50"),
            &["7 Refused too many tasks are running"],
        );
        gateway.pass(60);
        assert_said(
            gateway.start(8, 11, 2, "50"),
            &["8 Refused ends not yet acknowledged"],
        );
        gateway.send(key(5), NO_SEQ, Body::Ack { task: LinkId(9) });
        let again = "a task of this or a later id was started already";
        assert_said(
            gateway.start(9, 10, 2, "50"),
            &[&format!("9 Refused {again}")],
        );
        assert_said(gateway.start(10, 11, 2, "50"), &["10 Started 11"]);
    });
}

#[test]
fn abort_stops_the_task_and_reports_its_outcome() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "50");
        let abort = Body::Abort { task: LinkId(9) };
        assert_said(gateway.command(2, abort), &["2 Aborting 9"]);
        assert_said(gateway.command(2, abort), &["2 Aborting 9"]);
        assert_said(gateway.pass(1), &["Ended 9 ABORTED moving"]);
        assert_said(gateway.command(3, abort), &["3 Aborting 9"]);
        assert_eq!(trace.borrow().as_slice(), ["a 50", "a abort"]);
        let other = Body::Abort { task: LinkId(8) };
        assert_said(gateway.command(4, other), &["4 Refused no such task"]);
    });
}

#[test]
fn without_new_commands_each_component_follows_its_loss_policy() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "5000");
        gateway.start(2, 10, 2, "5000");
        // A repeated command proves nothing about the way back, and neither does a new session.
        for _ in 0..9 {
            gateway.pass(100);
            gateway.start(2, 10, 2, "5000");
        }
        gateway.hello(6, 1);
        assert_said(gateway.pass(100), &["Ended 9 FAILED link was lost"]);
        // One without a task too.
        let safe = ["a 5000", "c 5000", "a safe", "h safe"];
        assert_eq!(trace.borrow().as_slice(), safe);
        let ends: Grown<String> = (0..50).flat_map(|_| gateway.pass(100)).collect();
        assert!(
            ends.iter().any(|line| line == "Ended 10 COMPLETED moving"),
            "{ends:?}"
        );
        assert!(
            !ends.iter().any(|line| line.starts_with("Ended 10 FAILED")),
            "{ends:?}"
        );
    });
}

#[test]
fn a_holding_component_becomes_safe_and_its_task_fails() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 1, "5000");
        assert_said(gateway.pass(1000), &["Ended 9 FAILED link was lost"]);
        assert_eq!(trace.borrow().as_slice(), ["h 5000", "a safe", "h safe"]);
    });
}

#[test]
fn an_emergency_stop_is_latched() {
    with_node(|gateway, trace| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "500");
        gateway.node.stop_everything(gateway.now);
        assert_said(gateway.pass(1), &["Ended 9 ABORTED emergency stop"]);
        assert_eq!(
            trace.borrow().as_slice(),
            ["a 500", "a safe", "h safe", "c safe"]
        );
        assert_said(gateway.start(2, 10, 0, "5"), &["2 Refused emergency stop"]);
        gateway.node.clear_stop();
        assert_said(gateway.start(3, 10, 0, "5"), &["3 Started 10"]);
    });
}

#[test]
fn a_command_after_the_link_timeout_does_not_save_the_task() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        gateway.start(1, 7, 0, "50000");
        // The firmware was busy with something else.
        gateway.now = gateway.now + Duration::from_millis(1400);
        let heard = gateway.command(2, Body::Ping);
        let lost = heard.iter().any(|line| line.contains("link was lost"));
        assert!(lost, "{heard:?}");
    });
}
