//! Every message about updates beside postcard's own derive of the same values.

use super::*;
use crate::link::{Body, BodyError, LinkCommand};
use serde::Serialize;
use std::vec::Vec;

fn written(message: UpdateMessage<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    Body::Update(message).put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

fn tagged(tag: u8, fields: &impl Serialize) -> Vec<u8> {
    let mut bytes = std::vec![tag];
    bytes.extend(postcard::to_stdvec(fields).unwrap());
    bytes
}

fn pairs() -> Vec<(UpdateMessage<'static>, Vec<u8>)> {
    let command = UpdateMessage::Command;
    let (long, short) = (&[7; 200][..], &[9; 3][..]);
    let begin = |now, downgrade| {
        command(UpdateCommand::Begin {
            now,
            downgrade,
            manifest: short,
        })
    };
    let write = UpdateCommand::Write {
        offset: 300,
        bytes: long,
    };
    let firmware = |self_test| {
        UpdateMessage::Firmware(Firmware {
            board: "microbit",
            version: "1.2.3",
            confirmed: true,
            trial_ms: 60_000,
            self_test,
        })
    };
    let test = SelfTest {
        component: 2,
        goal: "test",
    };
    let mut pairs = std::vec![
        (command(UpdateCommand::Read), tagged(27, &())),
        (begin(false, false), tagged(28, &(0u8, short))),
        (begin(true, false), tagged(28, &(1u8, short))),
        (begin(false, true), tagged(28, &(2u8, short))),
        (command(write), tagged(29, &(300u32, long))),
        (
            firmware(None),
            tagged(31, &("microbit", "1.2.3", true, 60_000u32, None::<()>))
        ),
        (
            firmware(Some(test)),
            tagged(
                31,
                &("microbit", "1.2.3", true, 60_000u32, Some((2u8, "test")))
            )
        ),
        (
            UpdateMessage::Phase(UpdatePhase::Receiving { offset: 70_000 }),
            tagged(32, &(2u8, 70_000u32))
        ),
    ];
    let steps = [
        UpdateCommand::Ask,
        UpdateCommand::Finish,
        UpdateCommand::Restart,
        UpdateCommand::Confirm,
        UpdateCommand::Cancel,
    ];
    for (number, step) in (0u8..).zip(steps) {
        pairs.push((command(step), tagged(30, &number)));
    }
    for (number, phase) in [
        (0u8, UpdatePhase::Idle),
        (1, UpdatePhase::Stopping),
        (3, UpdatePhase::Verifying),
        (4, UpdatePhase::Ready),
        (5, UpdatePhase::Restarting),
    ] {
        pairs.push((UpdateMessage::Phase(phase), tagged(32, &number)));
    }
    // The last ones are unknown.
    for code in [0u8, 1, 2, 3, 4, 5, 6, 7, 255] {
        let error = UpdateError::from_code(code);
        let failed = UpdateMessage::Phase(UpdatePhase::Failed(error));
        pairs.push((failed, tagged(32, &(6u8, code))));
    }
    pairs
}

#[test]
fn every_message_is_written_and_read_like_postcard() {
    for (message, twin) in pairs() {
        assert_eq!(written(message), twin, "{message:?}");
        assert_eq!(Body::parse(&twin), Ok(Body::Update(message)));
        let unknown = BodyError::UnknownTag {
            tag: twin[0].into(),
        };
        let command = match message {
            UpdateMessage::Command(command) => Ok(command),
            _ => Err(unknown),
        };
        assert_eq!(UpdateCommand::parse(&twin), command);
        // A node without updates does not know them.
        assert_eq!(LinkCommand::parse(&twin), Err(unknown));
    }
}

#[test]
fn truncated_messages_and_trailing_bytes_are_rejected() {
    for (message, mut bytes) in pairs() {
        for len in 0..bytes.len() {
            assert!(
                Body::parse(&bytes[..len]).is_err(),
                "{message:?} cut to {len}"
            );
        }
        bytes.push(0);
        assert_eq!(Body::parse(&bytes), Err(BodyError::Trailing { extra: 1 }));
    }
}

#[test]
fn undefined_values_are_rejected() {
    for bytes in [
        &[28, 4, 0][..],         // no such flag
        &[30, 5],                // no such step
        &[31, 0, 0, 2, 0, 0],    // neither confirmed nor on trial
        &[31, 0, 0, 1, 0, 2],    // neither with nor without a test
        &[31, 1, 0xff, 1, 0, 0], // not UTF-8
        &[32, 7],                // no such phase
    ] {
        assert!(Body::parse(bytes).is_err(), "{bytes:?}");
    }
}
