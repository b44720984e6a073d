//! A driver played by hand, with and without a node.

use super::*;
use core::cell::Cell;
use core::pin::Pin;
use core::time::Duration;
use std::rc::Rc;
use std::string::{String, ToString};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::Wake;
use std::vec::Vec;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, VERSION, encode,
    session_key,
};

use crate::{Identity, Node};

/// What the driver did, in order, and what its hardware waits for.
#[derive(Default)]
struct World {
    trace: RefCell<Vec<&'static str>>,
    /// The transfer that a task waits for is done.
    moved: Cell<bool>,
    /// The transfer of `make_safe` is done.
    stopped: Cell<bool>,
    /// The transfer of `abort` is done.
    braked: Cell<bool>,
    millis: Cell<u64>,
}

impl World {
    fn take(&self) -> Vec<&'static str> {
        core::mem::take(&mut *self.trace.borrow_mut())
    }
}

struct Arm(Rc<World>);

/// Tells when the future of a task is dropped.
struct Dropped(Rc<World>);

impl Drop for Dropped {
    fn drop(&mut self) {
        self.0.trace.borrow_mut().push("over");
    }
}

async fn until(done: &Cell<bool>) {
    poll_fn(|_| match done.take() {
        true => Poll::Ready(()),
        false => Poll::Pending,
    })
    .await;
}

impl Driver for Arm {
    fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal == "nowhere" {
            why.text("arm goes out");
            return Err(Refused);
        }
        Ok(())
    }

    async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
        self.0.trace.borrow_mut().push("begins");
        let _dropped = Dropped(self.0.clone());
        progress.write(|report| report.text(goal));
        until(&self.0.moved).await;
        if goal == "fail" {
            progress.write(|report| report.text("stuck"));
            return Err(Failed);
        }
        progress.write(|report| report.number(90.0, 1));
        Ok(())
    }

    async fn abort(&mut self) {
        self.0.trace.borrow_mut().push("brakes");
        until(&self.0.braked).await;
        self.0.trace.borrow_mut().push("holds");
    }

    async fn make_safe(&mut self) {
        self.0.trace.borrow_mut().push("stops");
        until(&self.0.stopped).await;
        self.0.trace.borrow_mut().push("safe");
    }
}

/// Counts its calls.
#[derive(Default)]
struct Bell(AtomicUsize);

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

type ArmSlot = Slot<'static, Arm>;
type Running<'f> = Pin<&'f mut dyn Future<Output = Result<Infallible, AlreadyRuns>>>;

/// Drives the slot by the time of the world.
fn drive<'f>(
    slot: &'f ArmSlot,
    arm: &'f mut Arm,
) -> impl Future<Output = Result<Infallible, AlreadyRuns>> + 'f {
    let world = arm.0.clone();
    slot.run(arm, move || Instant::from_millis(world.millis.get()))
}

fn turn(running: &mut Running<'_>) {
    let polled = running
        .as_mut()
        .poll(&mut Context::from_waker(Waker::noop()));
    assert!(polled.is_pending());
}

fn poll(slot: &ArmSlot) -> (Run, String) {
    let mut text = TaskText::new();
    let run = SlotComponent(slot).poll(Instant::ZERO, &mut Report::new(&mut text));
    (run, text.as_str().to_string())
}

fn start(slot: &ArmSlot, goal: &str) -> Result<(), String> {
    let mut slot = SlotComponent(slot);
    let mut text = TaskText::new();
    let mut why = Report::new(&mut text);
    let started = slot
        .check(goal, &mut why)
        .and_then(|()| slot.start(Instant::ZERO, goal, &mut why));
    started.map_err(|Refused| text.as_str().to_string())
}

/// Runs `play` with a slot whose driver runs and is safe.
fn with_arm(play: impl FnOnce(&ArmSlot, &World, &mut Running<'_>)) {
    let world = Rc::new(World::default());
    let mut arm = Arm(world.clone());
    let slot = ArmSlot::new(Offer::new("arm"));
    let mut running = pin!(drive(&slot, &mut arm));
    world.stopped.set(true);
    turn(&mut (running.as_mut() as Running<'_>));
    assert_eq!(world.take(), ["stops", "safe"]);
    play(&slot, &world, &mut (running.as_mut() as Running<'_>));
}

fn said(run: Run, text: &str) -> (Run, String) {
    (run, text.to_string())
}

#[test]
fn a_task_runs_and_tells_progress_result_and_failure() {
    with_arm(|slot, world, running| {
        for (goal, end) in [
            ("out", said(Run::Completed, "90.0")),
            ("fail", said(Run::Failed, "stuck")),
        ] {
            assert_eq!(start(slot, goal), Ok(()));
            assert_eq!(poll(slot), said(Run::Running, ""));
            turn(running);
            assert_eq!(poll(slot), said(Run::Running, goal));
            turn(running);
            assert_eq!(world.take(), ["begins"]);
            world.moved.set(true);
            turn(running);
            if goal == "fail" {
                // It may still move: the end is told when it is safe.
                assert_eq!(poll(slot), said(Run::Running, "stuck"));
                assert_eq!(world.take(), ["over", "stops"]);
                world.stopped.set(true);
                turn(running);
                assert_eq!(world.take(), ["safe"]);
            } else {
                assert_eq!(world.take(), ["over"]);
            }
            assert_eq!(poll(slot), end);
        }
    });
}

#[test]
fn a_driver_made_safe_after_a_failed_task_is_safe() {
    with_arm(|slot, world, running| {
        start(slot, "fail").unwrap();
        world.moved.set(true);
        world.stopped.set(true);
        turn(running);
        assert_eq!(poll(slot).0, Run::Failed);
        SlotComponent(slot).make_safe(Instant::ZERO);
        assert_eq!(poll(slot).0, Run::Running);
        world.stopped.set(true);
        turn(running);
        assert_eq!(poll(slot).0, Run::Aborted);
    });
}

#[test]
fn a_slot_whose_future_was_dropped_takes_no_task() {
    let world = Rc::new(World::default());
    world.stopped.set(true);
    let mut arm = Arm(world.clone());
    let slot = ArmSlot::new(Offer::new("arm"));
    {
        let mut running = pin!(drive(&slot, &mut arm));
        turn(&mut (running.as_mut() as Running<'_>));
    }
    assert_eq!(
        start(&slot, "out"),
        Err("its driver is not ready".to_string())
    );
}

#[test]
fn an_abort_drops_the_task_and_stops_without_the_safe_state() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        turn(running);
        SlotComponent(slot).abort(Instant::ZERO);
        turn(running);
        turn(running);
        assert_eq!(world.take(), ["begins", "over", "brakes"]);
        assert_eq!(poll(slot), said(Run::Running, "out"));
        assert_eq!(
            start(slot, "out"),
            Err("its driver is not ready".to_string())
        );
        world.braked.set(true);
        turn(running);
        assert_eq!(poll(slot), said(Run::Aborted, "out"));
        assert_eq!(world.take(), ["holds"]);
        assert_eq!(start(slot, "out"), Ok(()));
    });
}

#[test]
fn a_stop_during_an_abort_makes_safe_at_once() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        turn(running);
        SlotComponent(slot).abort(Instant::ZERO);
        turn(running);
        SlotComponent(slot).make_safe(Instant::ZERO);
        world.stopped.set(true);
        turn(running);
        assert_eq!(world.take(), ["begins", "over", "brakes", "stops", "safe"]);
        assert_eq!(poll(slot), said(Run::Aborted, "out"));
    });
}

#[test]
fn a_driver_without_an_abort_of_its_own_makes_safe() {
    struct Plain(Rc<World>);

    impl Driver for Plain {
        fn check(_: &str, _: &mut Report<'_>) -> Result<(), Refused> {
            Ok(())
        }

        async fn run(&mut self, _: &str, _: Progress<'_>) -> Result<(), Failed> {
            Ok(())
        }

        async fn make_safe(&mut self) {
            self.0.trace.borrow_mut().push("safe");
        }
    }

    let world = Rc::new(World::default());
    let mut plain = Plain(world.clone());
    let aborting = pin!(plain.abort());
    let mut context = Context::from_waker(Waker::noop());
    assert!(aborting.poll(&mut context).is_ready());
    assert_eq!(world.take(), ["safe"]);
}

#[test]
fn an_abort_after_the_end_changes_nothing() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        world.moved.set(true);
        turn(running);
        SlotComponent(slot).abort(Instant::ZERO);
        turn(running);
        assert_eq!(world.take(), ["begins", "over"]);
        assert_eq!(poll(slot), said(Run::Completed, "90.0"));
    });
}

#[test]
fn a_second_future_of_a_slot_is_refused_and_the_first_goes_on() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        turn(running);
        let mut other = Arm(Rc::default());
        let second = pin!(drive(slot, &mut other));
        let polled = second.poll(&mut Context::from_waker(Waker::noop()));
        assert_eq!(polled, Poll::Ready(Err(AlreadyRuns)));
        world.moved.set(true);
        turn(running);
        assert_eq!(world.take(), ["begins", "over"]);
        assert_eq!(poll(slot), said(Run::Completed, "90.0"));
    });
}

#[test]
fn a_goal_that_waited_too_long_for_its_executor_never_begins() {
    with_arm(|slot, world, running| {
        for (millis, end) in [
            (499, said(Run::Running, "out")),
            (500, said(Run::Failed, LATE)),
        ] {
            world.millis.set(0);
            assert_eq!(start(slot, "out"), Ok(()));
            world.millis.set(millis);
            turn(running);
            assert_eq!(poll(slot), end, "{millis}");
            world.moved.set(true);
            turn(running);
        }
        assert_eq!(world.take(), ["begins", "over"]);
        assert_eq!(start(slot, "out"), Ok(()), "it is still safe");
    });
}

#[test]
fn a_new_component_stops_the_task_that_an_earlier_node_left() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        turn(running);
        let _component = slot.component();
        world.stopped.set(true);
        turn(running);
        assert_eq!(world.take(), ["begins", "over", "stops", "safe"]);
        assert_eq!(start(slot, "out"), Ok(()));
    });
}

#[test]
fn progress_returns_what_its_closure_found() {
    let text = Mutex::new(RefCell::new(TaskText::new()));
    let written = Progress(&text).write(|report| {
        report.text("at 7");
        Err::<(), _>(Failed)
    });
    assert_eq!(written, Err(Failed));
}

static SPEED: crate::shared::LatestReading<4> = crate::shared::LatestReading::new();

/// Reports a speed, and says what it is.
struct Wheel;

impl Driver for Wheel {
    fn check(_: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    async fn run(&mut self, _: &str, _: Progress<'_>) -> Result<(), Failed> {
        Err(Failed)
    }

    async fn make_safe(&mut self) {}

    fn poll_reading(_: Instant, buffer: &mut [u8]) -> Option<Reading> {
        SPEED.take(0, buffer)
    }
}

impl Describe for Wheel {
    const DESCRIPTION: &str = "{\"about\": \"turns\"}";
}

#[test]
fn a_slot_forwards_readings_and_the_description_of_its_driver() {
    use crate::describe::DescribeAll;

    let slot = Slot::<Wheel>::new(Offer::new("wheel").with_topics("speed"));
    let mut wheel = slot.component();
    let mut buffer = [0; 8];
    assert_eq!(wheel.poll_reading(Instant::ZERO, &mut buffer), None);
    assert_eq!(SPEED.set(b"12.5"), Ok(()));
    let reading = wheel.poll_reading(Instant::ZERO, &mut buffer);
    assert_eq!(reading, Some(Reading { topic: 0, len: 4 }));
    assert_eq!(buffer[..4], *b"12.5");
    type Wheels = [SlotComponent<'static, 'static, Wheel>; 1];
    assert_eq!(Wheels::DESCRIPTIONS, [Wheel::DESCRIPTION]);
}

#[test]
fn a_task_that_is_aborted_before_its_driver_saw_it_never_begins() {
    with_arm(|slot, world, running| {
        assert_eq!(start(slot, "out"), Ok(()));
        SlotComponent(slot).abort(Instant::ZERO);
        world.braked.set(true);
        turn(running);
        assert_eq!(world.take(), ["brakes", "holds"]);
        assert_eq!(poll(slot).0, Run::Aborted);
    });
}

#[test]
fn an_idle_driver_is_made_safe() {
    with_arm(|slot, world, running| {
        SlotComponent(slot).make_safe(Instant::ZERO);
        turn(running);
        assert_eq!(poll(slot).0, Run::Running);
        world.stopped.set(true);
        turn(running);
        assert_ne!(poll(slot).0, Run::Running);
        assert_eq!(world.take(), ["stops", "safe"]);
    });
}

#[test]
fn a_driver_takes_no_task_before_it_runs_and_is_safe() {
    let world = Rc::new(World::default());
    let mut arm = Arm(world.clone());
    let slot = ArmSlot::new(Offer::new("arm"));
    let refused = Err("its driver is not ready".to_string());
    assert_eq!(start(&slot, "out"), refused);
    {
        let mut running = pin!(drive(&slot, &mut arm));
        turn(&mut (running.as_mut() as Running<'_>));
        assert_eq!(start(&slot, "out"), refused);
        world.stopped.set(true);
        turn(&mut (running.as_mut() as Running<'_>));
        assert_eq!(start(&slot, "out"), Ok(()));
        turn(&mut (running.as_mut() as Running<'_>));
    }
    // The executor's task was dropped in the middle of it.
    assert_eq!(world.take(), ["stops", "safe", "begins", "over"]);
    SlotComponent(&slot).abort(Instant::ZERO);
    assert_eq!(poll(&slot).0, Run::Running, "may still move");
    let mut running = pin!(drive(&slot, &mut arm));
    world.stopped.set(true);
    turn(&mut (running.as_mut() as Running<'_>));
    assert_eq!(world.take(), ["stops", "safe"]);
    assert_eq!(poll(&slot).0, Run::Aborted);
}

#[test]
fn a_task_whose_driver_was_dropped_fails() {
    let world = Rc::new(World::default());
    let mut arm = Arm(world.clone());
    let slot = ArmSlot::new(Offer::new("arm"));
    for _ in 0..2 {
        let mut running = pin!(drive(&slot, &mut arm));
        world.stopped.set(true);
        turn(&mut (running.as_mut() as Running<'_>));
        let _ = start(&slot, "out");
        turn(&mut (running.as_mut() as Running<'_>));
    }
    assert_eq!(poll(&slot).0, Run::Running);
    let mut running = pin!(drive(&slot, &mut arm));
    world.stopped.set(true);
    turn(&mut (running.as_mut() as Running<'_>));
    assert_eq!(poll(&slot), said(Run::Failed, INTERRUPTED));
}

#[test]
fn goals_are_checked_by_the_driver_and_bounded() {
    with_arm(|slot, _, _| {
        assert_eq!(start(slot, "nowhere"), Err("arm goes out".to_string()));
        let long = "x".repeat(TEXT + 1);
        let why = "goal is too long for its driver";
        assert_eq!(start(slot, &long), Err(why.to_string()));
        assert_eq!(start(slot, &long[1..]), Ok(()));
    });
}

#[test]
fn tasks_and_stops_wake_the_executor() {
    let world = Rc::new(World::default());
    let mut arm = Arm(world.clone());
    let slot = &ArmSlot::new(Offer::new("arm"));
    let bell = Arc::new(Bell::default());
    let waker = Waker::from(bell.clone());
    let mut running = pin!(drive(slot, &mut arm));
    world.stopped.set(true);
    let mut rings = 0;
    let mut turn = || {
        let rung = bell.0.load(Ordering::Relaxed);
        let polled = running.as_mut().poll(&mut Context::from_waker(&waker));
        assert!(polled.is_pending());
        core::mem::replace(&mut rings, rung) < rung
    };
    assert!(!turn());
    assert_eq!(start(slot, "out"), Ok(()));
    assert!(turn());
    SlotComponent(slot).abort(Instant::ZERO);
    assert!(turn());
    world.braked.set(true);
    assert!(!turn());
    SlotComponent(slot).make_safe(Instant::ZERO);
    assert!(turn());
}

#[test]
fn a_lost_link_ends_the_task_when_the_driver_is_safe() {
    with_arm(|slot, world, running| {
        let mut node =
            Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [SlotComponent(slot)]);
        let mut now = Instant::from_millis(10_000);
        let hello = Hello {
            version: VERSION,
            session: 5,
            gateway: 1,
        };
        let started = Body::Start {
            task: LinkId(9),
            component: 0,
            goal: "out",
            before_ms: u64::MAX,
        };
        let sessions = [
            (NO_SESSION, NO_SEQ, Body::Hello(hello)),
            (session_key(5, 77), 1, started),
        ];
        for (session, seq, body) in sessions {
            let mut buffer = [0xA5; 160];
            let frame = Frame {
                addr: ADDR_ONLY_NODE,
                seq,
                body,
            };
            let len = encode(session, &frame, &mut buffer).unwrap();
            node.handle_bytes(now, &buffer[..len]);
        }
        turn(running);
        assert_eq!(world.take(), ["begins"]);
        let mut ends = Vec::new();
        let mut pass = |node: &mut Node<'_, [SlotComponent<'_, '_, Arm>; 1], 2, 128>, millis| {
            now = now + Duration::from_millis(millis);
            node.handle_timeout(now);
            let mut decoder = Decoder::<160>::new();
            let mut buffer = [0; 128];
            let count = node.poll_transmit(now, &mut buffer);
            for byte in &buffer[..count] {
                if decoder.push(*byte) == Ok(true)
                    && let (_, frame) = decoder.frame(&[session_key(5, 77), 5, NO_SESSION]).unwrap()
                    && let Body::Ended { state, result, .. } = frame.body
                {
                    ends.push(std::format!("{state} {result}"));
                }
            }
            core::mem::take(&mut ends)
        };
        pass(&mut node, 0);
        assert!(pass(&mut node, 1000).is_empty());
        turn(running);
        turn(running);
        assert_eq!(world.take(), ["over", "stops"]);
        assert!(pass(&mut node, 100).is_empty());
        world.stopped.set(true);
        turn(running);
        assert_eq!(pass(&mut node, 10), ["FAILED link was lost"]);
    });
}
