//! The example frames of section 16 of `docs/link.md` are those that the code writes and reads, and that a real node answers.

use ztl_core::link::Body;
use ztl_core::link::parameter::NO_COMPONENT;
use ztl_core::link::update::{UpdateCommand, UpdateMessage, UpdatePhase};
use ztl_mcu::update::{
    Firmware, Receiving, SelfTest, Updatable, UpdateError, Updater, Verification,
};
use ztl_tests::inert;

use crate::link_examples::{Frames, are_played};

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

inert!(Finger, "finger");

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
fn frames() -> Frames {
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

#[test]
fn the_specifications_example_frames_of_updates_match_the_code_and_a_real_node() {
    let components = Updatable::new((Finger,), Accepts);
    let from_gateway = |body: &Body<'_>| {
        let is_command = matches!(body, Body::Update(UpdateMessage::Command(_)));
        is_command || matches!(body, Body::Describe { .. })
    };
    are_played(components, frames(), from_gateway, 13, 27..=32);
}
