//! Parameters over a line that loses, repeats and delays frames, and with a node that is reset: a value is set at most once,
//! and its reported value is true.

use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::{Instant, TaskId};
use ztl_link::{
    LinkEvent, ParameterAnswer, ParameterFailure, ParameterRequest, ParameterValue, Session,
};
use ztl_mcu::link::Offer;
use ztl_mcu::parameters::{Declaration, Parameter, Tunable, Tuned, Value};
use ztl_mcu::{Component, Components, Identity, Node, Refused, Report, Run};

const SECTION: [Declaration; 2] = [
    Parameter::<u32>::new(0).declare("first"),
    Parameter::<u32>::new(0).declare("second"),
];

/// Moves until it is aborted; counts how often each value was set.
struct Part<'t> {
    sets: &'t RefCell<Vec<u32>>,
    values: [u32; 2],
    moving: bool,
}

impl Component for Part<'_> {
    fn offer(&self) -> Offer<'_> {
        Offer::new("part")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.moving = true;
        Ok(())
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        if self.moving {
            Run::Running
        } else {
            Run::Aborted
        }
    }

    fn abort(&mut self, _: Instant) {
        self.moving = false;
    }

    fn make_safe(&mut self, _: Instant) {
        self.moving = false;
    }
}

impl Tunable for Part<'_> {
    const PARAMETERS: &'static [Declaration] = &SECTION;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.values.get(index).copied().map(Value::U32)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        assert!(!self.moving, "set under a task");
        if let Value::U32(number) = value {
            self.sets.borrow_mut().push(number);
            self.values[index] = number;
        }
    }
}

type DeviceNode<'t> = Node<'static, Tuned<(Part<'t>,)>, 2, 128>;

fn node(sets: &RefCell<Vec<u32>>, boot: u32) -> DeviceNode<'_> {
    let part = Part {
        sets,
        values: [0; 2],
        moving: false,
    };
    // Beside the numbers of the sessions, so that no two sessions have the same key.
    let identity = Identity::new("desk", "1", boot << 20);
    Node::new(identity, Tuned::new((part,)))
}

/// Numbers of a linear congruence.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % limit
    }
}

/// A gateway's session and a node, on a line of whole frames.
struct Talk<'t> {
    now: Instant,
    session: Session,
    node: DeviceNode<'t>,
    boot: u32,
    /// Frames on the way, with the time at which they arrive: to the node, and back.
    lanes: [VecDeque<(Instant, Vec<u8>)>; 2],
    answers: BTreeMap<u64, ParameterAnswer>,
}

impl<'t> Talk<'t> {
    fn new(sets: &'t RefCell<Vec<u32>>) -> Self {
        let mut session = Session::new(7, None, super::numbers);
        session.handle_connected(Instant::ZERO);
        Self {
            now: Instant::ZERO,
            session,
            node: node(sets, 1),
            boot: 1,
            lanes: Default::default(),
            answers: BTreeMap::new(),
        }
    }

    /// A millisecond, in which each frame may suffer from a fault of probability one in `odds`; 0 is never.
    fn step(&mut self, dice: &mut Dice, odds: u64) {
        self.now = self.now + Duration::from_millis(1);
        self.node.handle_timeout(self.now);
        self.session.handle_timeout(self.now);
        let mut buffer = [0; 300];
        let count = self.node.poll_transmit(self.now, &mut buffer);
        for (lane, bytes) in [
            (0, self.session.poll_transmit()),
            (1, buffer[..count].to_vec()),
        ] {
            for frame in bytes.split_inclusive(|byte| *byte == 0) {
                let arrives = self.now + Duration::from_millis(1);
                let late = self.now + Duration::from_millis(1 + dice.below(2000));
                let fault = if odds == 0 { 99 } else { dice.below(odds) };
                match fault {
                    0 => {}
                    1 => self.lanes[lane].push_back((late, frame.to_vec())),
                    2 => {
                        self.lanes[lane].extend([(arrives, frame.to_vec()), (late, frame.to_vec())])
                    }
                    _ => self.lanes[lane].push_back((arrives, frame.to_vec())),
                }
            }
        }
        for lane in 0..2 {
            let (due, later) = self.lanes[lane]
                .drain(..)
                .partition(|(at, _)| *at <= self.now);
            self.lanes[lane] = later;
            let due: VecDeque<(Instant, Vec<u8>)> = due;
            for (_, frame) in due {
                match lane {
                    0 => self.node.handle_bytes(self.now, &frame),
                    _ => self.session.handle_bytes(self.now, &frame),
                }
            }
        }
        while let Some(event) = self.session.poll_event() {
            if let LinkEvent::Parameter(number, answer) = event {
                let before = self.answers.insert(number, answer);
                assert_eq!(before, None, "answered twice");
            }
        }
    }

    fn pass(&mut self, millis: usize) {
        let mut dice = Dice(1);
        for _ in 0..millis {
            self.step(&mut dice, 0);
        }
    }
}

#[test]
fn parameters_are_announced_read_and_set() {
    let sets = RefCell::default();
    let mut talk = Talk::new(&sets);
    talk.pass(300);
    assert_eq!(talk.session.device().map(|it| it.parameters), Some(2));
    let set = ParameterRequest::Set(1, ParameterValue::U32(5));
    talk.session.request_parameter(talk.now, 1, set);
    talk.session
        .request_parameter(talk.now, 2, ParameterRequest::Read(1));
    talk.session
        .request_parameter(talk.now, 3, ParameterRequest::Read(2));
    talk.session
        .request_parameter(talk.now, 4, ParameterRequest::Save);
    talk.pass(100);
    for number in [1, 2] {
        let answer = talk.answers[&number].as_ref();
        let info = answer.expect("it is done").as_ref().expect("a parameter");
        assert_eq!(
            (info.name.as_str(), &info.value),
            ("second", &ParameterValue::U32(5))
        );
    }
    let refused = |reason: &str| Err(ParameterFailure::Refused(reason.to_owned()));
    assert_eq!(talk.answers[&3], refused("no such parameter"));
    assert_eq!(
        talk.answers[&4],
        refused("this firmware saves no parameters")
    );
    // Also after the next session has begun, without asking for the descriptions.
    talk.session.handle_disconnected();
    let unreached = ParameterRequest::Read(0);
    talk.session
        .request_parameter(talk.now, 5, unreached.clone());
    talk.session.handle_connected(talk.now);
    talk.pass(300);
    let reason = "the device is not answering";
    assert_eq!(talk.answers[&5], Err(ParameterFailure::NotSent(reason)));
    talk.session.request_parameter(talk.now, 6, unreached);
    talk.pass(100);
    assert!(talk.answers[&6].is_ok(), "{:?}", talk.answers);
}

#[test]
fn a_request_for_a_boot_of_the_node_never_reaches_another() {
    let sets = RefCell::default();
    let mut talk = Talk::new(&sets);
    talk.pass(300);
    // More than the commands of a session.
    for number in 1..=300 {
        let set = ParameterRequest::Set(0, ParameterValue::U32(number));
        talk.session.request_parameter(talk.now, number.into(), set);
    }
    while talk.session.counters().sessions == 1 {
        talk.pass(1);
    }
    talk.node = node(&sets, 2);
    talk.pass(1000);
    let done = sets.borrow().len();
    assert!((200..256).contains(&done), "{done}");
    assert_eq!(talk.answers.len(), 300);
    let told = talk.answers.values().filter(|it| it.is_ok()).count();
    assert_eq!(told, done);
    assert!(matches!(
        talk.answers[&300],
        Err(ParameterFailure::NotSent(_))
    ));
    assert!(talk.session.is_up());
}

#[test]
fn a_node_without_parameters_is_never_asked() {
    let sets = RefCell::default();
    let Tuned { components, .. } = Tuned::new((Part {
        sets: &sets,
        values: [0; 2],
        moving: false,
    },));
    fn never_asked(components: impl Components) {
        let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 1), components);
        let mut session = Session::new(7, None, super::numbers);
        let mut now = Instant::ZERO;
        session.handle_connected(now);
        for millis in 0..3000 {
            now = now + Duration::from_millis(1);
            if millis == 1000 {
                session.request_parameter(now, 1, ParameterRequest::Read(0));
            }
            session.handle_timeout(now);
            node.handle_timeout(now);
            node.handle_bytes(now, &session.poll_transmit());
            let mut buffer = [0; 300];
            let count = node.poll_transmit(now, &mut buffer);
            session.handle_bytes(now, &buffer[..count]);
        }
        let events: Vec<LinkEvent> = std::iter::from_fn(|| session.poll_event()).collect();
        let none = LinkEvent::Parameter(1, Err(ParameterFailure::NoParameters));
        assert!(events.contains(&none), "{events:?}");
        assert!(!events.contains(&LinkEvent::Lost), "{events:?}");
        assert_eq!(node.counters().errors, 0);
    }
    never_asked(components);
}

#[test]
fn under_faults_a_value_is_set_at_most_once_and_what_is_told_is_true() {
    let mut told = [0; 4];
    for seed in 0..150 {
        let sets = RefCell::new(Vec::new());
        let mut talk = Talk::new(&sets);
        let mut dice = Dice(seed);
        // The first of them is 1; each value is asked for once.
        let mut asked = 0;
        for _ in 0..3000 {
            match dice.below(2000) {
                0 => {
                    talk.boot += 1;
                    talk.node = node(&sets, talk.boot);
                }
                1 => {
                    talk.session.handle_disconnected();
                    talk.session.handle_connected(talk.now);
                }
                2 => {
                    let id = TaskId::new(asked + 1).expect("not 0");
                    talk.session.start(talk.now, id, "part", "on");
                }
                3..6 => {
                    for id in 0..=asked {
                        let id = TaskId::new(id + 1).expect("not 0");
                        talk.session.abort(talk.now, id);
                    }
                }
                6..26 => {
                    asked += 1;
                    let value = ParameterValue::U32(asked);
                    let set = ParameterRequest::Set(dice.below(2) as u8, value);
                    talk.session.request_parameter(talk.now, asked.into(), set);
                }
                _ => {}
            }
            talk.step(&mut dice, 12);
        }
        talk.pass(6000);
        for value in 1..=asked {
            let times = sets.borrow().iter().filter(|set| **set == value).count();
            let answer = talk.answers.get(&value.into());
            let why = format!("seed {seed}: {value} was set {times} times, told {answer:?}");
            assert!(times <= 1, "{why}");
            match answer.expect("an answer") {
                Ok(info) => {
                    let now = info.as_ref().map(|info| info.value.clone());
                    assert_eq!(now, Some(ParameterValue::U32(value)), "{why}");
                    assert_eq!(times, 1, "{why}");
                    told[0] += 1;
                }
                Err(ParameterFailure::Refused(_)) => {
                    assert_eq!(times, 0, "{why}");
                    told[1] += 1;
                }
                Err(ParameterFailure::Unknown) => told[2] += 1,
                Err(_) => {
                    assert_eq!(times, 0, "{why}");
                    told[3] += 1;
                }
            }
        }
        // It serves as before.
        let id = TaskId::new(9999).expect("not 0");
        assert!(talk.session.is_up(), "seed {seed}");
        talk.session.abort(talk.now, id);
    }
    assert!(
        told.iter().all(|count| *count > 10),
        "too few of a kind: {told:?}"
    );
}
