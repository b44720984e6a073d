//! What devices say of themselves, beside ends that know nothing of it; wrong answers; and the end of a session.

use std::time::Duration;

use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Decoder, Frame, LinkId, NO_SEQ, NO_SESSION, encode, session_key,
};
use ztl_core::{Instant, State, TaskId};
use ztl_link::{LinkEvent, Session, UpdateFailure, UpdateRequest};
use ztl_mcu::describe::{ComponentDescription, Describe, Described, GoalRule};
use ztl_mcu::link::Offer;
use ztl_mcu::{Component, Components, Identity, Node, Refused, Report, Run, description};

/// Completes at once.
struct Lamp(&'static str);

impl Describe for Lamp {
    // Two bytes of the text's umlauts are in different parts, whatever comes before.
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some(
            "grüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüüßt, xüüüüüüüüüüüüüüüüüüüüüüüüüüü"
        ),
        ..ComponentDescription::new(GoalRule::words(&["on", "off"]))
    });
}

impl Component for Lamp {
    fn offer(&self) -> Offer<'_> {
        Offer::new(self.0)
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

/// Says nothing of itself.
struct Silent(Lamp);

impl Describe for Silent {}

impl Component for Silent {
    fn offer(&self) -> Offer<'_> {
        self.0.offer()
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.check(goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.start(now, goal, why)
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.0.poll(now, report)
    }

    fn abort(&mut self, now: Instant) {
        self.0.abort(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.0.make_safe(now);
    }
}

const fn described() -> Described<(Lamp, Silent, Lamp)> {
    Described((Lamp("one"), Silent(Lamp("two")), Lamp("three")))
}

/// A gateway's session and a node on a good line.
struct Talk<C> {
    now: Instant,
    session: Session,
    node: Node<'static, C, 2, 128>,
    decoder: Decoder<300>,
    /// The number of the last `Hello`.
    hello: u32,
    /// The commands of the gateway in short, each repetition too.
    said: Vec<String>,
    /// Whether the node ignores questions beyond its components.
    deaf: bool,
    events: Vec<LinkEvent>,
}

const BOOT: u32 = 77;

fn node<C: Components>(components: C, boot: u32) -> Node<'static, C, 2, 128> {
    Node::new(Identity::new("desk", "1", boot), components)
}

impl<C: Components> Talk<C> {
    fn new(components: C) -> Self {
        let mut session = Session::new(7, None, super::numbers);
        session.handle_connected(Instant::ZERO);
        Self {
            now: Instant::ZERO,
            session,
            node: node(components, BOOT),
            decoder: Decoder::new(),
            hello: NO_SESSION,
            said: Vec::new(),
            deaf: false,
            events: Vec::new(),
        }
    }

    fn pass(&mut self, millis: u64) {
        for _ in 0..millis {
            let mut frame = Vec::new();
            for byte in self.session.poll_transmit() {
                frame.push(byte);
                if byte == 0 {
                    self.hear(&std::mem::take(&mut frame));
                }
            }
            self.node.handle_timeout(self.now);
            let mut buffer = [0xA5; 64];
            loop {
                let count = self.node.poll_transmit(self.now, &mut buffer);
                if count == 0 {
                    break;
                }
                self.session.handle_bytes(self.now, &buffer[..count]);
            }
            self.session.handle_timeout(self.now);
            while let Some(event) = self.session.poll_event() {
                self.events.push(event);
            }
            self.now = self.now + Duration::from_millis(1);
        }
    }

    /// Passes a frame of the gateway to the node.
    fn hear(&mut self, bytes: &[u8]) {
        let mut heard = true;
        for byte in bytes {
            if self.decoder.push(*byte) != Ok(true) {
                continue;
            }
            let key = session_key(self.hello, BOOT);
            let Ok((_, frame)) = self.decoder.frame(&[key, NO_SESSION]) else {
                continue;
            };
            assert_eq!(frame.addr, ADDR_ONLY_NODE);
            self.said.push(match frame.body {
                Body::Hello(hello) => {
                    self.hello = hello.session;
                    "Hello".to_owned()
                }
                Body::Describe { index } => {
                    heard = !self.deaf || index < 3;
                    format!("Describe {index}")
                }
                Body::Start { .. } => "Start".to_owned(),
                Body::Ping => "Ping".to_owned(),
                Body::Ack { .. } => "Ack".to_owned(),
                other => format!("{other:?}"),
            });
        }
        if heard {
            self.node.handle_bytes(self.now, bytes);
        }
    }

    /// Answers the command in flight instead of the node, which does not receive it.
    fn answer(&mut self, body: Body<'_>) {
        let key = session_key(self.hello, BOOT);
        let mut seq = NO_SEQ;
        for byte in self.session.poll_transmit() {
            if self.decoder.push(byte) == Ok(true) {
                seq = self.decoder.frame(&[key]).expect("a command").1.seq;
            }
        }
        self.tell(seq, body);
    }

    /// Sends a frame to the gateway in the session of the node.
    fn tell(&mut self, seq: u8, body: Body<'_>) {
        let mut bytes = [0; 64];
        let frame = Frame {
            addr: ADDR_ONLY_NODE,
            seq,
            body,
        };
        let key = session_key(self.hello, BOOT);
        let len = encode(key, &frame, &mut bytes).expect("it fits");
        self.session.handle_bytes(self.now, &bytes[..len]);
        self.events
            .extend(std::iter::from_fn(|| self.session.poll_event()));
    }

    fn descriptions(&self) -> Vec<String> {
        let components = &self.session.device().expect("a device").components;
        let text = |bytes: &Vec<u8>| String::from_utf8(bytes.clone()).expect("UTF-8");
        components.iter().map(|it| text(&it.description)).collect()
    }

    /// How often it was asked for something beyond its components.
    fn asked(&self) -> usize {
        let parts = |said: &&String| {
            let index = said.strip_prefix("Describe ");
            index.is_some_and(|index| index.parse::<u8>().expect("a number") >= 3)
        };
        self.said.iter().filter(parts).count()
    }

    #[track_caller]
    fn assert_serves(&mut self) {
        assert!(self.session.is_up());
        let id = TaskId::new(self.events.len() as u32 + 1).expect("not 0");
        self.session.start(self.now, id, "two", "on");
        self.pass(200);
        let ended = LinkEvent::Ended(id, State::Completed, String::new());
        assert!(self.events.contains(&ended), "{:?}", self.events);
    }
}

#[test]
fn a_device_describes_its_components_in_parts_after_it_serves() {
    let mut talk = Talk::new(described());
    talk.pass(300);
    assert_eq!(
        talk.descriptions(),
        [Lamp::DESCRIPTION, "", Lamp::DESCRIPTION]
    );
    let begin = "Hello, Describe 0, Describe 1, Describe 2, Ping, Describe 3, Describe 4, ";
    assert!(talk.said.join(", ").starts_with(begin), "{:?}", talk.said);
    let parts = 2 * Lamp::DESCRIPTION.len().div_ceil(48);
    assert_eq!(talk.asked(), parts + 1);
    talk.assert_serves();
    // Not again in the next session, but after a reset.
    talk.session.handle_disconnected();
    talk.session.handle_connected(talk.now);
    talk.pass(300);
    assert_eq!(talk.asked(), parts + 1);
    assert_eq!(
        talk.descriptions(),
        [Lamp::DESCRIPTION, "", Lamp::DESCRIPTION]
    );
    talk.session.handle_disconnected();
    talk.node = node(described(), BOOT);
    talk.session.handle_connected(talk.now);
    talk.pass(3000);
    assert_eq!(talk.asked(), 2 * (parts + 1));
    assert_eq!(
        talk.descriptions(),
        [Lamp::DESCRIPTION, "", Lamp::DESCRIPTION]
    );
    talk.assert_serves();
}

#[test]
fn a_node_without_descriptions_is_asked_once() {
    let Described(plain) = described();
    let mut talk = Talk::new(plain);
    talk.pass(300);
    assert_eq!(talk.descriptions(), ["", "", ""]);
    assert_eq!(talk.asked(), 1);
    talk.assert_serves();
    talk.pass(5000);
    assert_eq!(talk.asked(), 1);
    assert!(!talk.events.contains(&LinkEvent::Lost));
}

#[test]
fn a_node_that_does_not_even_refuse_serves_nevertheless() {
    let mut talk = Talk::new(described());
    talk.deaf = true;
    talk.pass(1500);
    let lost = |talk: &Talk<_>| {
        talk.events
            .iter()
            .filter(|it| **it == LinkEvent::Lost)
            .count()
    };
    assert_eq!(lost(&talk), 1);
    let asked = talk.asked();
    talk.assert_serves();
    talk.pass(5000);
    assert_eq!((lost(&talk), talk.asked()), (1, asked));
    assert_eq!(talk.descriptions(), ["", "", ""]);
}

#[test]
fn a_lost_session_leaves_descriptions_that_are_asked_for_once_more_when_a_client_needs_them() {
    for heals in [true, false] {
        let mut talk = Talk::new(described());
        talk.deaf = true;
        talk.pass(1500);
        assert_eq!(talk.descriptions(), ["", "", ""]);
        talk.deaf = !heals;
        // A task would end if the session was lost again.
        let id = TaskId::new(9).expect("a task id");
        talk.session.start(talk.now, id, "one", "on");
        let asked = talk.asked();
        talk.session
            .request_update(talk.now, 1, UpdateRequest::Read);
        talk.pass(300);
        assert_eq!(talk.asked(), asked);
        for number in 2..4 {
            let read = UpdateRequest::Read;
            talk.session.request_update(talk.now, number, read);
            talk.pass(1500);
        }
        let lost = talk.events.iter().filter(|it| **it == LinkEvent::Lost);
        assert_eq!(lost.count(), if heals { 1 } else { 2 });
        assert_eq!(talk.descriptions()[0].is_empty(), !heals);
        let none = LinkEvent::Update(3, Err(UpdateFailure::NoUpdates));
        assert!(talk.events.contains(&none), "{:?}", talk.events);
    }
}

#[test]
fn tasks_go_before_descriptions() {
    let mut talk = Talk::new(described());
    for (number, component) in [(1, "one"), (2, "two")] {
        let id = TaskId::new(number).expect("not 0");
        talk.session.start(talk.now, id, component, "on");
    }
    talk.pass(300);
    let said = talk.said.iter().skip_while(|said| *said != "Ping");
    let said: Vec<&str> = said
        .map(String::as_str)
        .filter(|said| *said != "Ack")
        .collect();
    let begin = ["Ping", "Start", "Start", "Describe 3", "Describe 4"];
    assert_eq!(said[..5], begin, "{said:?}");
}

#[test]
fn an_answer_for_another_task_opens_a_new_session() {
    let (first, other) = (LinkId(1), LinkId(2));
    let mut talk = Talk::new(described());
    talk.pass(300);
    let id = TaskId::new(1).expect("not 0");
    talk.events.clear();
    talk.session.start(talk.now, id, "one", "on");
    talk.answer(Body::Started { task: other });
    assert_eq!(talk.events, [LinkEvent::Lost]);
    talk.pass(2000);
    let rejected = |it: &LinkEvent| matches!(it, LinkEvent::TaskRejected(..));
    assert!(talk.events.iter().any(rejected), "{:?}", talk.events);

    talk.session.start(talk.now, id, "one", "on");
    talk.answer(Body::Started { task: first });
    talk.session.abort(talk.now, id);
    talk.events.clear();
    talk.answer(Body::Aborting { task: other });
    assert_eq!(talk.events, [LinkEvent::Lost]);
    talk.pass(2000);
    talk.assert_serves();
}

#[test]
fn readings_of_a_full_session_arrive_until_the_next_one_begins() {
    let mut talk = Talk::new(described());
    talk.pass(300);
    let reading = Body::Publish {
        topic: 0,
        bytes: b"4",
    };
    let heard = |talk: &Talk<_>| {
        let reading = |it: &&LinkEvent| matches!(it, LinkEvent::Reading(..));
        talk.events.iter().filter(reading).count()
    };
    for _ in 0..70_000 {
        if !talk.session.is_up() {
            break;
        }
        talk.pass(1);
    }
    assert!(!talk.session.is_up());
    let old = talk.hello;
    talk.tell(NO_SEQ, reading);
    assert_eq!((heard(&talk), talk.session.counters().damaged), (1, 0));
    talk.pass(100);
    assert!(talk.session.is_up() && talk.hello != old);
    talk.hello = old;
    talk.tell(NO_SEQ, reading);
    assert_eq!((heard(&talk), talk.session.counters().damaged), (1, 1));
    assert!(!talk.events.contains(&LinkEvent::Lost));
}
