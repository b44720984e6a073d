//! The example frames of section 16 of `docs/link.md` are those that the code writes and reads, and that a real node answers.

use std::collections::BTreeSet;

use ztl_core::Instant;
use ztl_core::link::parameter::NO_COMPONENT;
use ztl_core::link::update::{UpdateCommand, UpdateMessage, UpdatePhase};
use ztl_core::link::{
    Body, Decoder, Frame, Hello, NO_SEQ, NO_SESSION, Offer, VERSION, encode, session_key,
};
use ztl_mcu::update::{
    Firmware, Receiving, SelfTest, Updatable, UpdateError, Updater, Verification,
};
use ztl_mcu::{Component, Identity, Node, Refused, Report, Run};

const HELLO: u32 = 0x1122_3344;
const BOOT: u32 = 0xcafe_0001;
const DOCUMENT: &str = include_str!("../../docs/link.md");
const MANIFEST: &[u8] = b"manifest";

const FIRMWARE: Firmware<'_> = Firmware {
    board: "gripper-1",
    version: "1.0.0",
    confirmed: true,
    trial_ms: 60_000,
    self_test: Some(SelfTest {
        component: 0,
        goal: "20",
    }),
};

struct Finger;

impl Component for Finger {
    fn offer(&self) -> Offer<'_> {
        Offer::new("finger")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Err(Refused)
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        Run::Failed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

/// Takes an image of 40 bytes.
struct Accepts;

impl Updater for Accepts {
    fn firmware(&self) -> Firmware<'_> {
        FIRMWARE
    }

    fn begin(&mut self, manifest: &[u8], _: bool) -> Result<Receiving, UpdateError> {
        assert_eq!(manifest, MANIFEST);
        Ok(Receiving {
            length: 40,
            offset: 32,
        })
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), UpdateError> {
        Ok(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        Ok(Verification::Done)
    }

    fn restart(&mut self) {}

    fn confirm(&mut self) -> Result<(), UpdateError> {
        Ok(())
    }
}

/// The frames of the document, in its order: name, seq, body.
fn frames() -> Vec<(&'static str, u8, Body<'static>)> {
    let command = |command| Body::Update(UpdateMessage::Command(command));
    let phase = |phase| Body::Update(UpdateMessage::Phase(phase));
    let announced = Body::Description {
        index: 1,
        component: NO_COMPONENT,
        bytes: &[0, 1],
    };
    let begin = UpdateCommand::Begin {
        now: false,
        downgrade: false,
        manifest: MANIFEST,
    };
    let write = UpdateCommand::Write {
        offset: 32,
        bytes: &[0xaa; 8],
    };
    vec![
        ("Describe", 1, Body::Describe { index: 1 }),
        ("Description", 1, announced),
        ("ReadUpdate", 2, command(UpdateCommand::Read)),
        (
            "Firmware",
            2,
            Body::Update(UpdateMessage::Firmware(FIRMWARE)),
        ),
        ("BeginUpdate", 3, command(begin)),
        (
            "UpdatePhase",
            3,
            phase(UpdatePhase::Receiving { offset: 32 }),
        ),
        ("WriteUpdate", 4, command(write)),
        (
            "UpdatePhase",
            4,
            phase(UpdatePhase::Receiving { offset: 40 }),
        ),
        ("UpdateStep", 5, command(UpdateCommand::Finish)),
        ("UpdatePhase", 5, phase(UpdatePhase::Verifying)),
        ("UpdateStep", 6, command(UpdateCommand::Ask)),
        ("UpdatePhase", 6, phase(UpdatePhase::Ready)),
        ("UpdateStep", 7, command(UpdateCommand::Restart)),
        ("UpdatePhase", 7, phase(UpdatePhase::Restarting)),
    ]
}

/// A frame as sent over the line.
fn sent(session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let mut buffer = [0xA5; 300];
    let len = encode(session, &Frame { addr: 0, seq, body }, &mut buffer).expect("it fits");
    buffer[..len].to_vec()
}

#[test]
fn the_specifications_example_frames_of_updates_match_the_code_and_a_real_node() {
    let key = session_key(HELLO, BOOT);
    let components = Updatable::new((Finger,), Accepts);
    let mut node = Node::<_, 4, 256>::new(Identity::new("gripper", "1.0.0", BOOT), components);
    let now = Instant::from_millis(1500);
    let hello = Body::Hello(Hello {
        version: VERSION,
        session: HELLO,
        gateway: 7,
    });
    node.handle_bytes(now, &sent(NO_SESSION, NO_SEQ, hello));
    let mut said = [0; 300];
    node.poll_transmit(now, &mut said);
    let (mut document, mut tags) = (String::new(), BTreeSet::new());
    for (name, seq, body) in frames() {
        let bytes = sent(key, seq, body);
        let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        document += &format!("{name:<13}{}\n", hex.join(" "));
        let mut decoder = Decoder::<300>::new();
        for byte in &bytes {
            decoder.push(*byte).expect("a frame");
        }
        assert_eq!(decoder.frame(&[key]).expect("a frame").1.body, body);
        let mut first = None;
        body.put(&mut |bytes: &[u8]| first = first.or(bytes.first().copied()));
        tags.extend(first);
        match body {
            Body::Describe { .. } | Body::Update(UpdateMessage::Command(_)) => {
                node.handle_bytes(now, &bytes);
            }
            _ => {
                let len = node.poll_transmit(now, &mut said);
                assert_eq!(said[..len], bytes, "{name}");
                node.handle_timeout(now);
            }
        }
    }
    assert!(
        DOCUMENT.contains(&format!("```text\n{document}```\n")),
        "docs/link.md should have:\n{document}"
    );
    assert!(
        tags.is_superset(&(27..=32).collect()),
        "each message has an example"
    );
}
