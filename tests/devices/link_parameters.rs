//! The example frames of section 13 of `docs/link.md` are those that the code writes and reads, and that a real node answers.

use std::collections::BTreeSet;

use ztl_core::Instant;
use ztl_core::link::parameter::{
    Domain, Kept, NO_COMPONENT, Parameter, ParameterCommand, ParameterMessage,
};
use ztl_core::link::{
    Body, Decoder, Frame, Hello, NO_SEQ, NO_SESSION, Offer, VERSION, encode, session_key,
};
use ztl_mcu::parameters;
use ztl_mcu::parameters::{Declaration, SaveError, Storage, Tunable, Tuned, Value};
use ztl_mcu::{Component, Identity, Node, Refused, Report, Run};

const HELLO: u32 = 0x1122_3344;
const BOOT: u32 = 0xcafe_0001;
const DOCUMENT: &str = include_str!("../../docs/link.md");

parameters! {
    struct Calibration {
        speed: f32 = Parameter::<f32>::new(50.0).range(1.0, 100.0).unit("percent/s").about("how fast it opens");
    }
}

struct Finger(Calibration);

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

impl Tunable for Finger {
    const PARAMETERS: &'static [Declaration] = Calibration::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.0.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.0.set(index, value);
    }
}

/// Accepts everything.
struct Accepts;

impl Storage for Accepts {
    fn read(&mut self, _: u64, _: &mut [u8]) -> Result<Option<usize>, SaveError> {
        Ok(None)
    }

    fn write(&mut self, _: u64, _: &[u8]) -> Result<(), SaveError> {
        Ok(())
    }
}

fn command(command: ParameterCommand<'static>) -> Body<'static> {
    Body::Parameter(ParameterMessage::Command(command))
}

fn speed(value: f32, kept: Kept) -> Body<'static> {
    Body::Parameter(ParameterMessage::Is(Parameter {
        index: 0,
        component: 0,
        name: "speed",
        unit: "percent/s",
        about: "how fast it opens",
        kept,
        domain: Domain::F32 {
            least: 1.0,
            most: 100.0,
        },
        default: Value::F32(50.0),
        value: Value::F32(value),
    }))
}

/// The frames of the document, in its order: name, seq, body.
fn frames() -> Vec<(&'static str, u8, Body<'static>)> {
    let set = |value| {
        command(ParameterCommand::Set {
            index: 0,
            value: Value::F32(value),
        })
    };
    let announced = Body::Description {
        index: 1,
        component: NO_COMPONENT,
        bytes: &[1],
    };
    let refused = Body::Refused {
        reason: "the value is out of its range",
    };
    let saved = Body::Parameter(ParameterMessage::Saved);
    vec![
        ("Describe", 1, Body::Describe { index: 1 }),
        ("Description", 1, announced),
        (
            "ReadParameter",
            2,
            command(ParameterCommand::Read { index: 0 }),
        ),
        ("Parameter", 2, speed(50.0, Kept::Saved)),
        ("SetParameter", 3, set(80.0)),
        ("Parameter", 3, speed(80.0, Kept::Changed)),
        ("SaveParameters", 4, command(ParameterCommand::Save)),
        ("ParametersSaved", 4, saved),
        ("SetParameter", 5, set(120.0)),
        ("Refused", 5, refused),
    ]
}

/// A frame as sent over the line.
fn sent(session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let mut buffer = [0xA5; 300];
    let len = encode(session, &Frame { addr: 0, seq, body }, &mut buffer).expect("it fits");
    buffer[..len].to_vec()
}

#[test]
fn the_specifications_example_frames_of_parameters_match_the_code_and_a_real_node() {
    let key = session_key(HELLO, BOOT);
    let finger = Finger(Calibration::default());
    let components = Tuned::new((finger,)).load::<_, 1>(Accepts);
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
        document += &format!("{name:<16}{}\n", hex.join(" "));
        let mut decoder = Decoder::<300>::new();
        for byte in &bytes {
            decoder.push(*byte).expect("a frame");
        }
        assert_eq!(decoder.frame(&[key]).expect("a frame").1.body, body);
        let mut first = None;
        body.put(&mut |bytes: &[u8]| first = first.or(bytes.first().copied()));
        tags.extend(first);
        match body {
            Body::Describe { .. } | Body::Parameter(ParameterMessage::Command(_)) => {
                node.handle_bytes(now, &bytes);
            }
            _ => {
                let len = node.poll_transmit(now, &mut said);
                assert_eq!(said[..len], bytes, "{name}");
            }
        }
    }
    assert!(
        DOCUMENT.contains(&format!("```text\n{document}```\n")),
        "docs/link.md should have:\n{document}"
    );
    assert!(
        tags.is_superset(&(22..=26).collect()),
        "each message has an example"
    );
}
