//! The example frames of section 13 of `docs/link.md` are those that the code writes and reads, and that a real node answers.

use ztl_core::link::Body;
use ztl_core::link::parameter::{
    Domain, Kept, NO_COMPONENT, Parameter, ParameterCommand, ParameterMessage,
};
use ztl_mcu::parameters;
use ztl_mcu::parameters::{Declaration, SaveError, Storage, Tunable, Tuned, Value};
use ztl_tests::inert;

use crate::link_examples::{Frames, are_played};

parameters! {
    struct Calibration {
        speed: f32 = Parameter::<f32>::new(50.0).range(1.0, 100.0).unit("percent/s").about("how fast it opens");
    }
}

struct Finger(Calibration);

inert!(Finger, "finger");

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
fn frames() -> Frames {
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

#[test]
fn the_specifications_example_frames_of_parameters_match_the_code_and_a_real_node() {
    let finger = Finger(Calibration::default());
    let components = Tuned::new((finger,)).load::<_, 1>(Accepts);
    let from_gateway = |body: &Body<'_>| {
        let is_command = matches!(body, Body::Parameter(ParameterMessage::Command(_)));
        is_command || matches!(body, Body::Describe { .. })
    };
    are_played(components, frames(), from_gateway, 16, 22..=26);
}
