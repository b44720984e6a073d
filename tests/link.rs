//! The example frames of `docs/link.md` are what the code writes and reads.

use ztl_core::State;
use ztl_core::link::{
    Body, Busy, Decoder, Frame, GoalShape, Hello, Ids, LinkId, Loss, NO_SESSION, Offer, VERSION,
    Welcome, encode, session_key,
};

const HELLO: u32 = 0x1122_3344;
const BOOT: u32 = 0xcafe_0001;

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
    let offer = Offer {
        name: "finger",
        goal: GoalShape {
            range: Some((0.0, 100.0)),
            unit: "percent",
            words: "",
        },
        busy: Busy::Refuse,
        loss: Loss::Abort,
        topics: "",
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
        state: State::Completed,
        result: "40.0",
    };
    let awake = Body::Awake {
        version: VERSION,
        boot: BOOT,
    };
    vec![
        ("Awake", NO_SESSION, 0, awake),
        ("Hello", NO_SESSION, 0, Body::Hello(hello)),
        ("Welcome", HELLO, 0, Body::Welcome(welcome)),
        ("Describe", key, 1, Body::Describe { index: 0 }),
        ("Component", key, 1, Body::Component { index: 0, offer }),
        ("Start", key, 2, start),
        ("Started", key, 2, Body::Started { task }),
        ("Progress", key, 0, Body::Progress { task, text: "12.5" }),
        ("Abort", key, 3, Body::Abort { task }),
        ("Aborting", key, 3, Body::Aborting { task }),
        ("Ended", key, 0, ended),
        ("Ack", key, 0, Body::Ack { task }),
        ("Ping", key, 4, Body::Ping),
        (
            "Pong",
            key,
            4,
            Body::Pong {
                clock_ms: 1750,
                held: 0,
            },
        ),
        (
            "Refused",
            key,
            5,
            Body::Refused {
                reason: "busy with another task",
            },
        ),
    ]
}

fn hex(bytes: &[u8]) -> String {
    let bytes: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    bytes.join(" ")
}

#[test]
fn the_example_frames_of_the_specification_are_those_of_the_code() {
    let document = include_str!("../docs/link.md");
    for (name, session, seq, body) in frames() {
        let frame = Frame { addr: 0, seq, body };
        let mut buffer = [0xA5; 300];
        let len = encode(session, &frame, &mut buffer).unwrap();
        let line = format!("{name:<10}{}", hex(&buffer[..len]));
        assert!(
            document.contains(&line),
            "docs/link.md should have:\n{line}"
        );

        let mut decoder = Decoder::<300>::new();
        let ends: Vec<bool> = buffer[..len]
            .iter()
            .map(|b| decoder.push(*b).unwrap())
            .collect();
        assert_eq!(ends.last(), Some(&true));
        assert_eq!(decoder.frame(&[session]).unwrap().1, frame);
    }
    let shown = document
        .lines()
        .filter(|line| line.ends_with(" 00"))
        .count();
    assert_eq!(shown, frames().len(), "every frame shown is compared");
}
