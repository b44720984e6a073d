//! Each end of the link against arbitrary input. Afterwards it must serve a well-behaved peer.
//!
//! An input is a list of steps: a byte, then its arguments. Numbers are one byte.
//!
//! | byte | step |
//! |---|---|
//! | `b` | bytes from the line: their number, then the bytes |
//! | `f` | a frame of the current session: sequence number, length of the body, body |
//! | `g` | the same under the number of the last `Hello`, like a `Welcome` |
//! | `h` | the same under no session, like `Hello` and `Awake` |
//! | `t` | this many times 16 ms pass |
//! | `s` | session only: a client starts a task; `a` aborts the task with this id |
//! | `p` | session only: a client asks about parameters: 0 saves them, an even number reads, an odd one sets one |
//! | `u` | session only: a client asks about updates, with this request |
//! | `o`, `c` | session only: the line is opened or closed |
//! | `l` | node only: a frame of the current session that is not a command: length of the body, body |
//! | `p`, `e` | node only: the firmware starts a task itself, or reports an event |
//! | any other | ignored |
//!
//! For a node, sequence number 0 of an `f` frame stands for the next one.

use core::time::Duration;
use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};

use ztl_core::link::{ADDR_ONLY_NODE, Body, Busy, Hello, Loss, Offer};
use ztl_core::link::{Decoder, Frame, NO_SESSION, encode, next_seq, session_key, session_number};
use ztl_core::{Instant, State, TaskId};
use ztl_mcu::describe::{ComponentDescription, Describe, Described, GoalRule};
use ztl_mcu::parameters::{Declaration, Parameter, Tunable, Tuned, Value};
use ztl_mcu::update::{Firmware, Receiving, Updatable, UpdateError, Updater, Verification};
use ztl_mcu::{Acting, Component, Identity, Node, Refused, Report, Run, description};

use ztl_link::{LinkEvent, ParameterRequest, ParameterValue, Session, UpdateRequest};

/// The boot id of the example in `docs/link.md`, so that its frames are valid inputs.
const BOOT: u32 = 0xcafe_0001;
/// The session of that example.
const EXAMPLE: u32 = 0x1122_3344;
/// Longest input in steps.
const MOST_STEPS: usize = 200;

/// A motor that takes 20 ms for any number.
#[derive(Debug)]
struct Motor {
    ends: Option<Instant>,
    aborted: bool,
    gain: u32,
    reversed: bool,
}

impl Describe for Motor {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("closes and opens, and needs 20 ms for that"),
        ..ComponentDescription::new(GoalRule::NUMBER)
    });
}

const PARAMETERS: [Declaration; 2] = [
    Parameter::<u32>::new(7).range(1, 9).declare("gain"),
    Parameter::<bool>::new(false).declare("reversed"),
];

impl Tunable for Motor {
    const PARAMETERS: &'static [Declaration] = &PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        match index {
            0 => Some(Value::U32(self.gain)),
            1 => Some(Value::Bool(self.reversed)),
            _ => None,
        }
    }

    fn set(&mut self, _: usize, value: Value<'_>) {
        assert!(self.ends.is_none(), "set while it runs");
        match value {
            Value::U32(gain) => {
                assert!((1..=9).contains(&gain), "out of its range");
                self.gain = gain;
            }
            Value::Bool(reversed) => self.reversed = reversed,
            other => panic!("of another kind: {other:?}"),
        }
    }
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new("finger")
            .with_range(0.0, 100.0, "percent")
            .with_busy(Busy::Queue(1))
            .with_loss(Loss::Hold)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal.parse::<f32>().is_ok() {
            return Ok(());
        }
        why.text("finger takes 0 to 100 percent");
        Err(Refused)
    }

    fn start(&mut self, now: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        assert!(self.ends.is_none(), "started while it runs");
        self.ends = Some(now + Duration::from_millis(20));
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let Some(ends) = self.ends else {
            return Run::Aborted;
        };
        report.text("40.0");
        if now < ends && !self.aborted {
            return Run::Running;
        }
        self.ends = None;
        if self.aborted {
            Run::Aborted
        } else {
            Run::Completed
        }
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.ends = None;
    }
}

/// Receives an image of as many bytes as the first of its manifest says, times 32.
#[derive(Debug, Default)]
struct Memory {
    image: Vec<u8>,
    length: usize,
    restarts: bool,
}

impl Updater for Memory {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: "board",
            version: "1.0.0",
            confirmed: true,
            trial_ms: 1000,
            self_test: None,
        }
    }

    fn begin(&mut self, manifest: &[u8], _: bool) -> Result<Receiving, UpdateError> {
        self.length = usize::from(*manifest.first().ok_or(UpdateError::Manifest)?) * 32;
        self.image.truncate(self.length);
        Ok(Receiving {
            length: self.length as u32,
            offset: self.image.len() as u32,
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        assert_eq!(offset as usize, self.image.len(), "out of its place");
        self.image.extend_from_slice(bytes);
        assert!(self.image.len() <= self.length, "too long");
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        assert_eq!(self.image.len(), self.length, "incomplete");
        Ok(Verification::Done)
    }

    fn restart(&mut self) {
        self.restarts = true;
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        Ok(())
    }
}

type Components = Acting<Described<Tuned<[Motor; 1]>>>;
type SmallNode = Node<'static, Updatable<Components, Memory>, 3, 128>;

fn new_node(boot: u32) -> SmallNode {
    let motor = Motor {
        ends: None,
        aborted: false,
        gain: 7,
        reversed: false,
    };
    let components = Acting::new(Described(Tuned::new([motor])));
    let components = Updatable::new(components, Memory::default());
    Node::new(Identity::new("gripper", "1.0.0", boot), components)
}

thread_local! {
    static NUMBER: Cell<u32> = const { Cell::new(0) };
}

/// The next session number; the first is that of the example.
fn number() -> u32 {
    NUMBER.set(NUMBER.get().wrapping_add(1));
    EXAMPLE ^ NUMBER.get().wrapping_sub(1)
}

/// Parses an input.
struct Steps<'a> {
    rest: &'a [u8],
    left: usize,
}

impl<'a> Steps<'a> {
    fn next(&mut self) -> Option<u8> {
        self.left = self.left.checked_sub(1)?;
        self.byte()
    }

    fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.rest.split_first()?;
        self.rest = rest;
        Some(*first)
    }

    fn bytes(&mut self) -> &'a [u8] {
        let len = self.byte().map_or(0, usize::from).min(self.rest.len());
        let (bytes, rest) = self.rest.split_at(len);
        self.rest = rest;
        bytes
    }
}

/// A frame with a valid checksum if the body is a message, otherwise the unchanged bytes.
fn framed(session: u32, seq: u8, body: &[u8]) -> Vec<u8> {
    let Ok(body) = Body::parse(body) else {
        return body.to_vec();
    };
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let mut bytes = vec![0xA5; 800];
    let len = encode(session, &frame, &mut bytes).expect("bodies are short");
    bytes.truncate(len);
    bytes
}

/// The session numbers of all `Hello`s on a line. The current session has one of them.
#[derive(Default)]
struct Hellos {
    decoder: Decoder<1024>,
    numbers: BTreeSet<u32>,
}

impl Hellos {
    fn on_bytes(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            if self.decoder.push(byte) == Ok(true)
                && let Ok((_, frame)) = self.decoder.frame(&[NO_SESSION])
                && let Body::Hello(hello) = frame.body
            {
                self.numbers.insert(hello.session);
            }
        }
    }

    /// Makes [`number`] return other numbers from now on.
    fn skip_used(&self) {
        let heard = |upper: &u32| self.numbers.iter().any(|number| number >> 16 == *upper);
        let upper = (1..u32::from(u16::MAX)).find(|upper| !heard(upper));
        let first = upper.expect("an input has fewer sessions") << 16;
        NUMBER.set(EXAMPLE ^ first);
    }
}

/// After any bytes a node serves a gateway.
pub fn node(input: &[u8]) {
    let mut node = new_node(BOOT);
    let mut now = Instant::ZERO;
    let (mut hello, mut seq) = (EXAMPLE, 0);
    let mut hellos = Hellos::default();
    let mut steps = Steps {
        rest: input,
        left: MOST_STEPS,
    };
    while let Some(step) = steps.next() {
        let bytes = match step {
            b'b' => steps.bytes().to_vec(),
            b'f' => {
                let wanted = steps.byte().unwrap_or(0);
                seq = if wanted == 0 { next_seq(seq) } else { wanted };
                framed(session_key(hello, BOOT), seq, steps.bytes())
            }
            b'h' => {
                let body = steps.bytes();
                if let Ok(Body::Hello(Hello { session, .. })) = Body::parse(body) {
                    (hello, seq) = (session, 0);
                }
                framed(NO_SESSION, 0, body)
            }
            b't' => {
                now = now + Duration::from_millis(16) * u32::from(steps.byte().unwrap_or(0));
                Vec::new()
            }
            b'l' => framed(session_key(hello, BOOT), 0, steps.bytes()),
            b'p' => {
                let _ = node.start_here(now, 0, "40");
                Vec::new()
            }
            b'e' => {
                node.report_event(now, "pressed");
                Vec::new()
            }
            _ => Vec::new(),
        };
        hellos.on_bytes(&bytes);
        node.handle_bytes(now, &bytes);
        node.handle_timeout(now);
        let _ = sent_by(&mut node, now);
        if node.components().updater.restarts {
            node = new_node(BOOT.wrapping_add(1));
            break;
        }
    }
    // An update that does not go on is over, and restarts do not wait for anything. One that was complete is verified first,
    // and then waits for 30 s.
    now = now + Duration::from_secs(30);
    node.handle_timeout(now);
    now = now + Duration::from_secs(31);
    node.handle_timeout(now);
    if node.components().updater.restarts {
        node = new_node(BOOT.wrapping_add(1));
    }
    // The node admits another gateway after a period of silence. The new session uses a number that was not
    // used before.
    hellos.skip_used();
    let mut session = Session::new(7, None, number);
    session.handle_connected(now);
    let mut ends = Ends {
        now,
        session,
        node,
        taken: 0,
    };
    ends.serve();
}

/// After any bytes each task has one final state, and the session serves with a device.
pub fn session(input: &[u8]) {
    NUMBER.set(0);
    let mut now = Instant::ZERO;
    let mut session = Session::new(7, None, number);
    let mut told = Told::default();
    let (mut boot, mut last, mut taken) = (BOOT, 0, 0);
    let mut steps = Steps {
        rest: input,
        left: MOST_STEPS,
    };
    session.handle_connected(now);
    while let Some(step) = steps.next() {
        let hello = session_number(EXAMPLE ^ NUMBER.get().saturating_sub(1));
        match step {
            b'b' => session.handle_bytes(now, steps.bytes()),
            b'f' => {
                let seq = steps.byte().unwrap_or(0);
                let key = session_key(hello, boot);
                session.handle_bytes(now, &framed(key, seq, steps.bytes()));
            }
            b'g' => {
                let body = steps.bytes();
                if let Ok(Body::Welcome(welcome)) = Body::parse(body) {
                    boot = welcome.boot;
                }
                session.handle_bytes(now, &framed(hello, 0, body));
            }
            b'h' => session.handle_bytes(now, &framed(NO_SESSION, 0, steps.bytes())),
            b't' => now = now + Duration::from_millis(16) * u32::from(steps.byte().unwrap_or(0)),
            b's' if last < 50 => {
                last += 1;
                let id = TaskId::new(last).expect("not 0");
                told.tasks.insert(id, None);
                session.start(now, id, "finger", "40");
            }
            b'a' => {
                if let Some(id) = TaskId::new(steps.byte().unwrap_or(0).into()) {
                    session.abort(now, id);
                }
            }
            b'p' => {
                let request = match steps.byte().unwrap_or(0) {
                    0 => ParameterRequest::Save,
                    byte if byte % 2 == 0 => ParameterRequest::Read(byte / 2 - 1),
                    byte => ParameterRequest::Set(byte / 2, ParameterValue::U32(byte.into())),
                };
                told.asked += 1;
                session.request_parameter(now, told.asked, request);
            }
            b'u' => {
                let request = match steps.byte().unwrap_or(0) {
                    0 => UpdateRequest::Read,
                    1 => UpdateRequest::Begin {
                        now: true,
                        downgrade: false,
                        manifest: steps.bytes().to_vec(),
                    },
                    2 => UpdateRequest::Write {
                        offset: steps.byte().unwrap_or(0).into(),
                        bytes: steps.bytes().to_vec(),
                    },
                    3 => UpdateRequest::Finish,
                    4 => UpdateRequest::Restart,
                    5 => UpdateRequest::Confirm,
                    6 => UpdateRequest::Cancel,
                    _ => UpdateRequest::Ask,
                };
                told.asked += 1;
                session.request_update(now, told.asked, request);
            }
            b'o' => session.handle_connected(now),
            b'c' => session.handle_disconnected(),
            _ => {}
        }
        session.handle_timeout(now);
        let _ = session.poll_transmit();
        while let Some(event) = session.poll_event() {
            if let Some(id) = take_up(&mut session, now, &event, &mut taken) {
                told.tasks.insert(id, None);
            }
            told.on_event(&event);
        }
        // Room for 255 descriptions of 1 KiB each, and 50 tasks.
        assert!(format!("{session:?}").len() < 600_000, "the session grows");
    }
    session.handle_disconnected();
    session.handle_connected(now);
    let mut ends = Ends {
        now,
        session,
        node: new_node(boot.wrapping_add(1)),
        taken: 100_000,
    };
    for event in ends.serve() {
        told.on_event(&event);
    }
    for (id, end) in told.tasks {
        assert!(end.is_some(), "{id} has no final state");
    }
    let all: BTreeSet<u64> = (1..=told.asked).collect();
    assert_eq!(
        told.answered, all,
        "each request about parameters and updates is answered"
    );
}

/// Takes up a task that the device has begun. Returns its id.
fn take_up(
    session: &mut Session,
    now: Instant,
    event: &LinkEvent,
    taken: &mut u32,
) -> Option<TaskId> {
    if *event != LinkEvent::Begun {
        return None;
    }
    *taken += 1;
    let id = TaskId::new(10_000 + *taken).expect("not 0");
    session.take_up(now, id).then_some(id)
}

/// What was told.
#[derive(Default)]
struct Told {
    /// The final state of each task.
    tasks: BTreeMap<TaskId, Option<State>>,
    /// The number of requests about parameters and updates, and those that were answered.
    asked: u64,
    answered: BTreeSet<u64>,
}

impl Told {
    fn on_event(&mut self, event: &LinkEvent) {
        let (id, state) = match event {
            LinkEvent::TaskRejected(id, _) => (id, State::Rejected),
            LinkEvent::Ended(id, state, _) => (id, *state),
            LinkEvent::Parameter(number, _) | LinkEvent::Update(number, _) => {
                assert!(self.answered.insert(*number), "{number} is answered twice");
                return;
            }
            _ => return,
        };
        // The task of `serve` is not recorded.
        if let Some(end) = self.tasks.get_mut(id) {
            assert_eq!(end.replace(state), None, "{id} has a second final state");
        }
    }
}

fn sent_by(node: &mut SmallNode, now: Instant) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut buffer = [0xA5; 64];
    for _ in 0..100 {
        let count = node.poll_transmit(now, &mut buffer);
        if count == 0 {
            return bytes;
        }
        bytes.extend_from_slice(&buffer[..count]);
    }
    panic!("the node always has more to send");
}

/// Both ends on a good line.
struct Ends {
    now: Instant,
    session: Session,
    node: SmallNode,
    /// Number of tasks of the device that were taken up, by any session.
    taken: u32,
}

impl Ends {
    /// A task completes within some seconds.
    fn serve(&mut self) -> Vec<LinkEvent> {
        let mut events = self.pass(Duration::from_secs(4));
        assert!(self.session.is_up(), "{:?}", self.session);
        let device = self.session.device().expect("it is up");
        let description = device.components.first().map(|it| &*it.description);
        assert_eq!(description, Some(Motor::DESCRIPTION.as_bytes()));
        assert_eq!((device.parameters, device.updates), (2, true));
        let id = TaskId::new(1000).expect("not 0");
        self.session.start(self.now, id, "finger", "40");
        let after = self.pass(Duration::from_millis(500));
        let end = after.iter().find_map(|event| match event {
            LinkEvent::Ended(ended, state, text) if *ended == id => Some((*state, text.as_str())),
            LinkEvent::TaskRejected(ended, reason) if *ended == id => {
                Some((State::Rejected, reason))
            }
            _ => None,
        });
        let used_up = "a task of this or a later id was started already";
        assert!(
            end == Some((State::Completed, "40.0")) || end == Some((State::Rejected, used_up)),
            "{end:?}"
        );
        events.extend(after);
        events
    }

    fn pass(&mut self, time: Duration) -> Vec<LinkEvent> {
        let end = self.now + time;
        let mut events = Vec::new();
        for _ in 0..5000 {
            for _ in 0..3 {
                let down = self.session.poll_transmit();
                self.node.handle_bytes(self.now, &down);
                self.node.handle_timeout(self.now);
                let up = sent_by(&mut self.node, self.now);
                self.session.handle_bytes(self.now, &up);
                self.session.handle_timeout(self.now);
                while let Some(event) = self.session.poll_event() {
                    take_up(&mut self.session, self.now, &event, &mut self.taken);
                    events.push(event);
                }
            }
            let node = self.node.poll_timeout(self.now);
            let wake = self.session.poll_timeout().map_or(node, |at| at.min(node));
            if wake >= end {
                self.now = end;
                return events;
            }
            self.now = wake.max(self.now + Duration::from_micros(100));
        }
        panic!("the ends never wait");
    }
}
