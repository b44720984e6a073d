//! The example frames of `docs/link.md` are those that the code writes and reads, and that a real node answers.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::time::Duration;

use ztl_core::link::{
    Body, Busy, DESCRIPTION_PART, Decoder, Frame, Hello, Ids, LinkId, NO_SESSION, Offer, VERSION,
    Welcome, encode, session_key,
};
use ztl_core::{Instant, State};
use ztl_mcu::describe::{ComponentDescription, Describe, Described, GoalRule};
use ztl_mcu::log::LogSource;
use ztl_mcu::{Acting, Component, Identity, Node, Reading, Refused, Report, Run, description};

const HELLO: u32 = 0x1122_3344;
const BOOT: u32 = 0xcafe_0001;
const DOCUMENT: &str = include_str!("../../docs/link.md");

/// The finger's position when it is polled, as published.
const OPENING: [u8; 4] = 12.5f32.to_le_bytes();
/// A record of the log.
const RECORD: [u8; 4] = [0x2a, 0x05, 0x7e, 0x00];

fn offer() -> Offer<'static> {
    Offer::new("finger")
        .with_range(0.0, 100.0, "percent")
        .with_busy(Busy::Queue(2))
        .with_topics("opening")
}

/// The frames of the document, in its order: name, session, seq, body.
fn frames() -> Vec<(&'static str, u32, u8, Body<'static>)> {
    let key = session_key(HELLO, BOOT);
    let task = LinkId(300);
    let welcome = Welcome {
        version: VERSION,
        name: "gripper",
        firmware: "1.0.0",
        boot: BOOT,
        replaces: 0,
        clock_ms: 1500,
        capacity: 4,
        max_body: 250,
        components: 1,
        link_timeout_ms: 1000,
        highest: 0,
        held: Ids::new(&[]),
    };
    let hello = Hello {
        version: VERSION,
        session: HELLO,
        gateway: 7,
    };
    let start = Body::Start {
        task,
        component: 0,
        goal: "40",
        before_ms: 2500,
    };
    let ended = Body::Ended {
        task,
        state: State::Aborted,
        result: "14.0",
    };
    let awake = Body::Awake {
        version: VERSION,
        boot: BOOT,
    };
    let component = Body::Component {
        index: 0,
        offer: offer(),
    };
    let publish = Body::Publish {
        topic: 0,
        bytes: &OPENING,
    };
    let log = Body::Log {
        lost: 300,
        bytes: &RECORD,
    };
    let pong = Body::Pong {
        clock_ms: 1750,
        held: 0,
    };
    let refused = Body::Refused {
        reason: "a task of this or a later id was started already",
    };
    let (first, second) = Finger::DESCRIPTION.as_bytes().split_at(DESCRIPTION_PART);
    let description = |index, bytes| Body::Description {
        index,
        component: 0,
        bytes,
    };
    let no_more = Body::Refused {
        reason: "no such component",
    };
    let own = LinkId::local(1);
    let begun = Body::Begun {
        task: own,
        component: 0,
        goal: "40",
    };
    let own_progress = Body::Progress {
        task: own,
        text: "12.5",
    };
    let event = Body::Event {
        number: 1,
        text: "lid open",
    };
    vec![
        ("Awake", NO_SESSION, 0, awake),
        ("Hello", NO_SESSION, 0, Body::Hello(hello)),
        ("Welcome", HELLO, 0, Body::Welcome(welcome)),
        ("Describe", key, 1, Body::Describe { index: 0 }),
        ("Component", key, 1, component),
        ("Start", key, 2, start),
        ("Started", key, 2, Body::Started { task }),
        ("Progress", key, 0, Body::Progress { task, text: "12.5" }),
        ("Publish", key, 0, publish),
        ("Log", key, 0, log),
        ("Abort", key, 3, Body::Abort { task }),
        ("Aborting", key, 3, Body::Aborting { task }),
        ("Ended", key, 0, ended),
        ("Ack", key, 0, Body::Ack { task }),
        ("Ping", key, 4, Body::Ping),
        ("Pong", key, 4, pong),
        ("Start", key, 5, start),
        ("Refused", key, 5, refused),
        ("Describe", key, 6, Body::Describe { index: 1 }),
        ("Description", key, 6, description(1, first)),
        ("Describe", key, 7, Body::Describe { index: 2 }),
        ("Description", key, 7, description(2, second)),
        ("Describe", key, 8, Body::Describe { index: 3 }),
        ("Refused", key, 8, no_more),
        ("Begun", key, 0, begun),
        ("Noted", key, 0, Body::Noted { task: own }),
        ("Progress", key, 0, own_progress),
        ("Event", key, 0, event),
        ("EventAck", key, 0, Body::EventAck { number: 1 }),
    ]
}

fn hex(bytes: &[u8]) -> String {
    let bytes: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    bytes.join(" ")
}

/// The lines of the document's conversation: name and bytes.
fn shown() -> Vec<(&'static str, Vec<u8>)> {
    let (_, examples) = DOCUMENT.split_once("## 12. Examples").unwrap();
    let (_, block) = examples.split_once("```text\n").unwrap();
    let (block, _) = block.split_once("```").unwrap();
    let line = |line: &'static str| {
        let (name, bytes) = line.split_once(' ').unwrap();
        let byte = |byte| u8::from_str_radix(byte, 16).unwrap();
        (name, bytes.split_whitespace().map(byte).collect())
    };
    block.lines().map(line).collect()
}

#[test]
fn the_specifications_example_frames_match_the_code() {
    let mut tags = BTreeSet::new();
    let mut document = String::new();
    for (name, session, seq, body) in frames() {
        let frame = Frame { addr: 0, seq, body };
        let mut buffer = [0xA5; 300];
        let len = encode(session, &frame, &mut buffer).unwrap();
        document += &format!("{name:<12}{}\n", hex(&buffer[..len]));

        let mut decoder = Decoder::<300>::new();
        let ends: Vec<bool> = buffer[..len]
            .iter()
            .map(|b| decoder.push(*b).unwrap())
            .collect();
        assert_eq!(ends.last(), Some(&true));
        assert_eq!(decoder.frame(&[session]).unwrap().1, frame);
        let mut first = None;
        body.put(&mut |bytes: &[u8]| first = first.or(bytes.first().copied()));
        tags.extend(first);
    }
    assert!(
        DOCUMENT.contains(&format!("```text\n{document}```\n")),
        "docs/link.md should have:\n{document}"
    );
    assert_eq!(
        tags,
        (0..=21).collect(),
        "each kind of message has an example"
    );
}

#[test]
fn clauses_are_numbered_consecutively() {
    let mut last = (0, 0);
    for line in DOCUMENT.lines() {
        let Some((clause, _)) = line.strip_prefix("- [").and_then(|l| l.split_once(']')) else {
            continue;
        };
        let (section, number) = clause.split_once('.').unwrap();
        let here: (u32, u32) = (section.parse().unwrap(), number.parse().unwrap());
        // The section of the examples has no clauses.
        let follows = here == (last.0, last.1 + 1) || here.0 > last.0 && here.1 == 1;
        assert!(follows, "[{clause}] after {last:?}");
        last = here;
    }
    assert_eq!(last.0, 16);
}

/// Moves as documented.
struct Finger {
    aborted: bool,
    reading: bool,
}

impl Describe for Finger {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("opens the gripper"),
        ..ComponentDescription::new(GoalRule::NUMBER)
    });
}

impl Component for Finger {
    fn offer(&self) -> Offer<'_> {
        offer()
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        assert_eq!(goal, "40");
        self.reading = true;
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run {
        report.number(if self.aborted { 14.0 } else { 12.5 }, 1);
        if self.aborted {
            Run::Aborted
        } else {
            Run::Running
        }
    }

    fn abort(&mut self, _: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _: Instant) {
        self.aborted = true;
    }

    fn poll_reading(&mut self, _: Instant, buffer: &mut [u8]) -> Option<Reading> {
        buffer.get_mut(..4)?.copy_from_slice(&OPENING);
        let reading = Reading { topic: 0, len: 4 };
        std::mem::take(&mut self.reading).then_some(reading)
    }
}

struct Once(RefCell<Vec<u8>>);

impl LogSource for Once {
    fn read(&self, buffer: &mut [u8]) -> usize {
        let bytes = self.0.take();
        buffer[..bytes.len()].copy_from_slice(&bytes);
        bytes.len()
    }

    fn lost(&self) -> u32 {
        300
    }
}

#[test]
fn a_real_node_matches_the_documented_conversation() {
    let finger = Finger {
        aborted: false,
        reading: false,
    };
    let identity = Identity::new("gripper", "1.0.0", BOOT);
    let components = Acting::new(Described([finger]));
    let mut node = Node::<_, 4, 256>::new(identity, components);
    let log = Once(RefCell::new(RECORD.to_vec()));
    let mut now = Instant::from_millis(1500);
    // An announcement starts with a byte that flushes noise.
    let awake = node.transmit_buf(now, &()).to_vec();
    node.consume(1);
    assert_eq!(awake.first(), Some(&0));
    let asks = [
        "Hello", "Describe", "Start", "Abort", "Ping", "Ack", "Noted", "EventAck",
    ];
    for (name, bytes) in shown() {
        match name {
            "Ping" => now = now + Duration::from_millis(250),
            // The component reports these later.
            "Progress" | "Ended" => node.handle_timeout(now),
            "Begun" => drop(node.start_here(now, 0, "40")),
            "Event" => assert!(node.report_event(now, "lid open")),
            _ => {}
        }
        if asks.contains(&name) {
            node.handle_bytes(now, &bytes);
        } else {
            let said = node.transmit_buf(now, &log).to_vec();
            assert_eq!(hex(&said), hex(&bytes), "{name}");
            node.consume(said.len());
        }
    }
    let counters = node.counters();
    assert_eq!((counters.errors, counters.out_of_sequence), (0, 0));
}
