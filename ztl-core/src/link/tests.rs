//! Every message beside postcard's own derive of the same enum.

use super::*;
use crate::State;
use serde::{Deserialize, Serialize};
use std::string::String;
use std::vec::Vec;

/// The same messages with derived codecs; the order is the numbering.
#[derive(Serialize, Deserialize, Debug, PartialEq)]
enum Twin {
    Hello(u8, u32, u64),
    Describe(u8),
    Start(u32, u8, String, u64),
    Abort(u32),
    Ping,
    Ack(u32),
    Welcome(TwinWelcome),
    Component(
        u8,
        String,
        Option<(f32, f32)>,
        String,
        String,
        TwinBusy,
        u8,
        String,
    ),
    Started(u32),
    Refused(String),
    Aborting(u32),
    Pong(u64, u8),
    Ended(u32, u8, String),
    Progress(u32, String),
    Publish(u8, Vec<u8>),
    Log(u32, Vec<u8>),
    Awake(u8, u32),
    Description(u8, u8, Vec<u8>),
    Begun(u32, u8, String),
    Noted(u32),
    Event(u32, String),
    EventAck(u32),
}

#[derive(Serialize, Deserialize, Debug, PartialEq)]
enum TwinBusy {
    Refuse,
    Queue(u8),
    Replace,
}

#[derive(Serialize, Deserialize, Debug, PartialEq)]
struct TwinWelcome {
    version: u8,
    name: String,
    firmware: String,
    boot: u32,
    replaces: u32,
    clock_ms: u64,
    capacity: u8,
    max_body: u16,
    components: u8,
    link_timeout_ms: u32,
    highest: u32,
    held: Vec<u32>,
}

const HELD: [LinkId; 3] = [LinkId(1), LinkId(300), LinkId(u32::MAX)];

fn pairs() -> Vec<(Body<'static>, Twin)> {
    let welcome = Welcome {
        version: 1,
        name: "gripper",
        firmware: "0.1.0",
        boot: 0xdead_beef,
        replaces: 5,
        clock_ms: 1 << 40,
        capacity: 4,
        max_body: 248,
        components: 2,
        link_timeout_ms: 1000,
        highest: 300,
        held: Ids::new(&HELD),
    };
    let twin_welcome = TwinWelcome {
        version: 1,
        name: "gripper".into(),
        firmware: "0.1.0".into(),
        boot: 0xdead_beef,
        replaces: 5,
        clock_ms: 1 << 40,
        capacity: 4,
        max_body: 248,
        components: 2,
        link_timeout_ms: 1000,
        highest: 300,
        held: HELD.iter().map(|id| id.0).collect(),
    };
    let offer = |range, busy, topics| Offer {
        name: "pan",
        goal: GoalShape {
            range,
            unit: "degrees",
            words: "left right",
        },
        busy,
        loss: Loss::CarryOn,
        topics,
    };
    let (pan, deg, words) = ("pan".into(), "degrees".into(), "left right".into());
    let range = Some((-90.0, 90.5));
    let task = LinkId(129);
    std::vec![
        (
            Body::Hello(Hello {
                version: 1,
                session: u32::MAX,
                gateway: u64::MAX
            }),
            Twin::Hello(1, u32::MAX, u64::MAX),
        ),
        (Body::Describe { index: 3 }, Twin::Describe(3)),
        (
            Body::Start {
                task,
                component: 200,
                goal: "grüße",
                before_ms: 127
            },
            Twin::Start(129, 200, "grüße".into(), 127),
        ),
        (Body::Abort { task }, Twin::Abort(129)),
        (Body::Ping, Twin::Ping),
        (Body::Ack { task }, Twin::Ack(129)),
        (Body::Welcome(welcome), Twin::Welcome(twin_welcome)),
        (
            Body::Component {
                index: 1,
                offer: offer(range, Busy::Queue(200), "angle current")
            },
            Twin::Component(
                1,
                pan,
                range,
                deg,
                words,
                TwinBusy::Queue(200),
                2,
                "angle current".into()
            ),
        ),
        (
            Body::Component {
                index: 0,
                offer: offer(None, Busy::Refuse, "")
            },
            Twin::Component(
                0,
                "pan".into(),
                None,
                "degrees".into(),
                "left right".into(),
                TwinBusy::Refuse,
                2,
                String::new()
            ),
        ),
        (
            Body::Component {
                index: 0,
                offer: offer(None, Busy::Replace, "")
            },
            Twin::Component(
                0,
                "pan".into(),
                None,
                "degrees".into(),
                "left right".into(),
                TwinBusy::Replace,
                2,
                String::new()
            ),
        ),
        (Body::Started { task }, Twin::Started(129)),
        (
            Body::Refused { reason: "busy" },
            Twin::Refused("busy".into())
        ),
        (Body::Aborting { task }, Twin::Aborting(129)),
        (
            Body::Pong {
                clock_ms: 128,
                held: 255
            },
            Twin::Pong(128, 255)
        ),
        (
            Body::Ended {
                task,
                state: State::Completed,
                result: "40.0"
            },
            Twin::Ended(129, 5, "40.0".into()),
        ),
        (
            Body::Progress { task, text: "12.5" },
            Twin::Progress(129, "12.5".into())
        ),
        (
            Body::Publish {
                topic: 7,
                bytes: &[0, 255]
            },
            Twin::Publish(7, std::vec![0, 255])
        ),
        (
            Body::Log {
                lost: 128,
                bytes: &[]
            },
            Twin::Log(128, Vec::new())
        ),
        (
            Body::Awake {
                version: 1,
                boot: 0
            },
            Twin::Awake(1, 0)
        ),
        (
            Body::Description {
                index: 3,
                component: 1,
                bytes: b"{}"
            },
            Twin::Description(3, 1, b"{}".to_vec())
        ),
        (
            Body::Begun {
                task: LinkId::local(1),
                component: 2,
                goal: "grüße"
            },
            Twin::Begun(0x8000_0001, 2, "grüße".into())
        ),
        (
            Body::Noted {
                task: LinkId::local(1)
            },
            Twin::Noted(0x8000_0001)
        ),
        (
            Body::Event {
                number: 300,
                text: "door open"
            },
            Twin::Event(300, "door open".into())
        ),
        (Body::EventAck { number: 300 }, Twin::EventAck(300)),
    ]
}

fn written(body: &Body<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    body.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

#[test]
fn every_message_is_written_and_read_like_postcard() {
    for (body, twin) in pairs() {
        let ours = written(&body);
        assert_eq!(ours, postcard::to_stdvec(&twin).unwrap(), "{body:?}");
        assert_eq!(Body::parse(&ours), Ok(body));
        assert_eq!(postcard::from_bytes::<Twin>(&ours).unwrap(), twin);
    }
}

#[test]
fn a_node_reads_only_gateway_messages() {
    for (body, _) in pairs() {
        let bytes = written(&body);
        let expected = match body {
            Body::Hello(hello) => Ok(LinkCommand::Hello(hello)),
            Body::Describe { index } => Ok(LinkCommand::Describe { index }),
            Body::Start {
                task,
                component,
                goal,
                before_ms,
            } => Ok(LinkCommand::Start {
                task,
                component,
                goal: goal.as_bytes(),
                before_ms,
            }),
            Body::Abort { task } => Ok(LinkCommand::Abort { task }),
            Body::Ping => Ok(LinkCommand::Ping),
            Body::Ack { task } => Ok(LinkCommand::Ack { task }),
            _ => Err(BodyError::UnknownTag {
                tag: bytes[0].into(),
            }),
        };
        assert_eq!(LinkCommand::parse(&bytes), expected);
        let own = match body {
            Body::Noted { task } => Ok(OwnAnswer::Noted { task }),
            Body::EventAck { number } => Ok(OwnAnswer::EventAck { number }),
            _ => Err(()),
        };
        assert_eq!(OwnAnswer::parse(&bytes).map_err(drop), own);
    }
}

#[test]
fn truncated_messages_and_trailing_bytes_are_rejected() {
    for (body, _) in pairs() {
        let mut bytes = written(&body);
        for len in 0..bytes.len() {
            assert!(Body::parse(&bytes[..len]).is_err(), "{body:?} cut to {len}");
        }
        bytes.push(0);
        assert_eq!(Body::parse(&bytes), Err(BodyError::Trailing { extra: 1 }));
    }
}

#[test]
fn undefined_values_are_rejected() {
    for bytes in [
        &[99][..],                          // no such message
        &[12, 1, 1, 0],                     // an end that is not final
        &[12, 1, 6, 0],                     // no such state
        &[9, 2, 0xc3, 0x28],                // not UTF-8
        &[2, 1, 0, 2, 0xc3, 0x28, 0],       // the same in a goal
        &[3, 0xff, 0xff, 0xff, 0xff, 0x1f], // more than 32 bits
        &[
            11, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 2, 0,
        ],
        &[7, 0, 0, 2, 0, 0, 0, 0],    // neither a range nor none
        &[7, 0, 0, 0, 0, 0, 3, 0, 0], // no such way to be busy
    ] {
        assert!(Body::parse(bytes).is_err(), "{bytes:?}");
    }
}
