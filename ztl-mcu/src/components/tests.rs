//! The components in a real node, with a gateway played by hand, on virtual time.

use super::testing::{Pin, Wire};
use super::*;
use crate::{Components, Identity, Instant, Node};
use core::cell::Cell;
use std::format;
use std::string::String;
use std::vec::Vec;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, VERSION, encode,
    next_seq, session_key,
};

const SESSION: u32 = 5;
const BOOT: u32 = 77;

/// A gateway's side of a session.
struct TestGateway<'c, C: Components> {
    node: Node<'static, C, 6, 160>,
    now: Instant,
    seq: u8,
    /// The node's messages except progress and pongs.
    heard: Vec<String>,
    ended: Vec<LinkId>,
    progress: &'c Cell<usize>,
    pings: bool,
}

impl<C: Components> TestGateway<'_, C> {
    fn send(&mut self, session: u32, seq: u8, body: Body<'_>) {
        let frame = Frame {
            addr: ADDR_ONLY_NODE,
            seq,
            body,
        };
        let mut buffer = [0xA5; 192];
        let len = encode(session, &frame, &mut buffer).unwrap();
        self.node.handle_bytes(self.now, &buffer[..len]);
        self.listen();
    }

    fn hello(&mut self) {
        let hello = Hello {
            version: VERSION,
            session: SESSION,
            gateway: 1,
        };
        self.send(NO_SESSION, NO_SEQ, Body::Hello(hello));
    }

    fn command(&mut self, body: Body<'_>) {
        self.seq = next_seq(self.seq);
        self.send(session_key(SESSION, BOOT), self.seq, body);
    }

    fn start(&mut self, task: u32, component: u8, goal: &str) {
        self.command(Body::Start {
            task: LinkId(task),
            component,
            goal,
            before_ms: u64::MAX,
        });
    }

    fn listen(&mut self) {
        let mut decoder = Decoder::<192>::new();
        let mut byte = [0xA5];
        while self.node.poll_transmit(self.now, &mut byte) > 0 {
            if decoder.push(byte[0]) != Ok(true) {
                continue;
            }
            let keys = [session_key(SESSION, BOOT), SESSION, NO_SESSION];
            let (_, frame) = decoder.frame(&keys).unwrap();
            let line = match frame.body {
                Body::Component { index, offer } => {
                    let goal = offer.goal;
                    format!(
                        "{index} {} {:?} {} [{}] {:?} [{}]",
                        offer.name, goal.range, goal.unit, goal.words, offer.loss, offer.topics
                    )
                }
                Body::Refused { reason } => format!("refused: {reason}"),
                Body::Ended {
                    task,
                    state,
                    result,
                } => {
                    // It is repeated, because the test does not acknowledge it.
                    if self.ended.contains(&task) {
                        continue;
                    }
                    self.ended.push(task);
                    format!("{} {state}: {result}", task.0)
                }
                Body::Progress { .. } => {
                    self.progress.set(self.progress.get() + 1);
                    continue;
                }
                _ => continue,
            };
            self.heard.push(line);
        }
    }

    /// The main loop for so long, with a turn each 100 µs.
    fn pass(&mut self, millis: u64) {
        for turn in 0..millis * 10 {
            self.now = Instant::from_micros(self.now.as_micros() + 100);
            self.node.handle_timeout(self.now);
            self.listen();
            if self.pings && turn % 2000 == 0 {
                self.command(Body::Ping);
            }
        }
    }

    fn heard(&mut self) -> Vec<String> {
        core::mem::take(&mut self.heard)
    }
}

/// The simulated hardware.
#[derive(Default)]
struct World {
    pan: Wire,
    step: Wire,
    direction: Wire,
    end: Wire,
    lamp: Wire,
    button: Wire,
    progress: Cell<usize>,
}

fn components(world: &World) -> impl Components + use<'_> {
    const PAN: ServoConfig = ServoConfig {
        range: (-90, 90),
        safe: Power::Release,
        ..ServoConfig::DEFAULT
    };
    const SLIDE: StepperConfig = StepperConfig {
        range: (0, 4000),
        ..StepperConfig::DEFAULT
    };
    let motor = StepMotor::new(Pin(&world.step), Pin(&world.direction), &SLIDE)
        .with_low_limit(LimitFlag(|| world.end.value.get() > 0));
    (
        Servo::new("pan", Pin(&world.pan), PAN),
        Stepper::new("slide", motor, SLIDE),
        DigitalOutput::new("lamp", Pin(&world.lamp), DigitalOutputConfig::DEFAULT),
        DigitalInput::new("button", Pin(&world.button), DigitalInputConfig::DEFAULT),
    )
}

fn gateway(world: &World) -> TestGateway<'_, impl Components + use<'_>> {
    let identity = Identity::new("desk", "1.0.0", BOOT);
    let mut gateway = TestGateway {
        node: Node::new(identity, components(world)),
        now: Instant::from_millis(1),
        seq: 0,
        heard: Vec::new(),
        ended: Vec::new(),
        progress: &world.progress,
        pings: true,
    };
    gateway.hello();
    gateway
}

#[test]
fn each_component_describes_its_goals() {
    let world = World::default();
    let mut gateway = gateway(&world);
    for index in 0..4 {
        gateway.command(Body::Describe { index });
    }
    assert_eq!(
        gateway.heard(),
        [
            "0 pan Some((-90.0, 90.0)) degrees [] Abort []",
            "1 slide Some((0.0, 4000.0)) steps [home] Hold []",
            "2 lamp Some((1.0, 3600000.0)) ms [on off pulse] Abort []",
            "3 button None  [pressed released] Abort [pressed]",
        ]
    );
}

#[test]
fn components_run_tasks_concurrently() {
    let world = World::default();
    world.button.value.set(1);
    let mut gateway = gateway(&world);
    gateway.start(1, 0, "90.5");
    gateway.start(2, 0, "90");
    gateway.start(3, 1, "700");
    gateway.start(4, 2, "pulse 300");
    gateway.start(5, 3, "pressed");
    assert_eq!(gateway.heard(), ["refused: pan takes -90 to 90 degrees"]);
    gateway.pass(250);
    assert_eq!(world.lamp.value.get(), 1);
    world.button.value.set(0);
    gateway.pass(250);
    assert_eq!(world.lamp.value.get(), 0);
    assert_eq!(
        gateway.heard(),
        ["5 COMPLETED: pressed", "4 COMPLETED: off"]
    );
    gateway.pass(2000);
    assert_eq!(gateway.heard(), ["3 COMPLETED: 700", "2 COMPLETED: 90.0"]);
    assert_eq!(world.pan.value.get(), 6500);
    assert!(world.progress.get() > 20);

    gateway.start(6, 1, "home");
    gateway.pass(500);
    world.end.value.set(1);
    gateway.pass(20);
    assert_eq!(gateway.heard(), ["6 COMPLETED: 0"]);
}

#[test]
fn a_lost_link_makes_each_component_safe() {
    let world = World::default();
    let mut gateway = gateway(&world);
    gateway.start(1, 0, "90");
    gateway.start(2, 1, "4000");
    gateway.start(3, 2, "pulse 60000");
    gateway.pass(600);
    gateway.pings = false;
    gateway.pass(1100);
    assert_eq!(
        gateway.heard(),
        [
            "1 FAILED: link was lost",
            "2 FAILED: link was lost",
            "3 FAILED: link was lost",
        ]
    );
    assert_eq!(world.pan.value.get(), 0, "released");
    assert_eq!(world.lamp.value.get(), 0);
    world.step.value.set(9);
    gateway.pass(100);
    assert_eq!(world.step.value.get(), 9, "no step more");
}

#[test]
fn a_lost_link_makes_outputs_of_earlier_tasks_safe() {
    let world = World::default();
    let mut gateway = gateway(&world);
    gateway.start(1, 0, "0");
    gateway.start(2, 1, "40");
    gateway.start(3, 2, "on");
    gateway.pass(60_000);
    assert_eq!(gateway.heard().len(), 3);
    assert!(world.pan.value.get() > 0 && world.lamp.value.get() == 1);
    gateway.pings = false;
    gateway.pass(1100);
    assert_eq!(world.lamp.value.get(), 0);
    assert_eq!(world.pan.value.get(), 0, "released");
    assert_eq!(world.step.value.get(), 0);
    // It stays so, and the link, which is back, moves nothing by itself.
    gateway.pass(60_000);
    gateway.pings = true;
    gateway.pass(1000);
    assert_eq!((world.lamp.value.get(), world.pan.value.get()), (0, 0));
    assert_eq!(gateway.heard(), [""; 0]);
    gateway.start(4, 2, "on");
    assert_eq!(world.lamp.value.get(), 1);
}

#[test]
fn one_failed_write_at_a_lost_link_leaves_no_output_on() {
    let world = World::default();
    let mut gateway = gateway(&world);
    gateway.start(1, 0, "0");
    gateway.start(2, 2, "on");
    gateway.pass(60_000);
    gateway.heard();
    assert!(world.pan.value.get() > 0 && world.lamp.value.get() == 1);
    gateway.pings = false;
    gateway.pass(700);
    world.pan.broken.set(true);
    world.lamp.broken.set(true);
    gateway.pass(400);
    assert!(world.pan.value.get() > 0 && world.lamp.value.get() == 1);
    world.pan.broken.set(false);
    world.lamp.broken.set(false);
    gateway.pass(50);
    assert_eq!((world.pan.value.get(), world.lamp.value.get()), (0, 0));
}

#[test]
fn an_abort_reports_where_each_component_stopped() {
    let world = World::default();
    let mut gateway = gateway(&world);
    gateway.start(1, 0, "90");
    gateway.start(2, 1, "4000");
    gateway.start(3, 2, "60000");
    gateway.pass(1000);
    for task in 1..=3 {
        gateway.command(Body::Abort { task: LinkId(task) });
    }
    gateway.pass(1000);
    let heard = gateway.heard();
    let begins = ["3 ABORTED: off", "1 ABORTED: 60.", "2 ABORTED: 9"];
    for begin in begins {
        let found = heard.iter().any(|line| line.starts_with(begin));
        assert!(found, "{begin} in {heard:?}");
    }
    assert_eq!(heard.len(), 3);
}
