//! Every message about parameters beside postcard's own derive of the same enum.

use super::*;
use crate::link::{Body, BodyError, LinkCommand};
use serde::{Deserialize, Serialize};
use std::string::String;
use std::vec::Vec;

/// The same messages with derived codecs, after their tag.
#[derive(Serialize, Deserialize, Debug, PartialEq)]
struct TwinParameter {
    index: u8,
    component: u8,
    name: String,
    unit: String,
    about: String,
    kept: u8,
    domain: TwinDomain,
    default: TwinValue,
    value: TwinValue,
}

#[derive(Serialize, Deserialize, Debug, PartialEq, Clone)]
enum TwinValue {
    Bool(bool),
    U32(u32),
    I32(i32),
    F32(f32),
    Text(String),
}

#[derive(Serialize, Deserialize, Debug, PartialEq)]
enum TwinDomain {
    Bool,
    U32(u32, u32),
    I32(i32, i32),
    F32(f32, f32),
    Text(u8),
}

fn twin(value: Value<'_>) -> TwinValue {
    match value {
        Value::Bool(on) => TwinValue::Bool(on),
        Value::U32(number) => TwinValue::U32(number),
        Value::I32(number) => TwinValue::I32(number),
        Value::F32(number) => TwinValue::F32(number),
        Value::Text(text) => TwinValue::Text(text.into()),
    }
}

/// A domain, a default and a value of each kind.
fn kinds() -> Vec<(Domain, TwinDomain, Value<'static>, Value<'static>)> {
    std::vec![
        (
            Domain::Bool,
            TwinDomain::Bool,
            Value::Bool(false),
            Value::Bool(true)
        ),
        (
            Domain::U32 {
                least: 1,
                most: u32::MAX
            },
            TwinDomain::U32(1, u32::MAX),
            Value::U32(300),
            Value::U32(u32::MAX)
        ),
        (
            Domain::I32 {
                least: i32::MIN,
                most: i32::MAX
            },
            TwinDomain::I32(i32::MIN, i32::MAX),
            Value::I32(i32::MIN),
            Value::I32(-65)
        ),
        (
            Domain::F32 {
                least: -1.5,
                most: 1e9
            },
            TwinDomain::F32(-1.5, 1e9),
            Value::F32(0.0),
            Value::F32(12.25)
        ),
        (
            Domain::Text { longest: 9 },
            TwinDomain::Text(9),
            Value::Text(""),
            Value::Text("Grüße")
        ),
    ]
}

fn written(message: ParameterMessage<'_>) -> Vec<u8> {
    let mut out = Vec::new();
    Body::Parameter(message).put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    out
}

fn tagged(tag: u8, fields: &impl Serialize) -> Vec<u8> {
    let mut bytes = std::vec![tag];
    bytes.extend(postcard::to_stdvec(fields).unwrap());
    bytes
}

fn pairs() -> Vec<(ParameterMessage<'static>, Vec<u8>)> {
    let read = ParameterCommand::Read { index: 7 };
    let mut pairs = std::vec![
        (ParameterMessage::Command(read), tagged(22, &7u8)),
        (
            ParameterMessage::Command(ParameterCommand::Save),
            tagged(24, &())
        ),
        (ParameterMessage::Saved, tagged(26, &())),
    ];
    for (number, (domain, its_twin, default, value)) in kinds().into_iter().enumerate() {
        let index = number as u8;
        let set = ParameterCommand::Set { index, value };
        pairs.push((
            ParameterMessage::Command(set),
            tagged(23, &(index, twin(value))),
        ));
        let kept = [Kept::Never, Kept::Saved, Kept::Changed, Kept::Replaced][number % 4];
        let parameter = Parameter {
            index,
            component: NO_COMPONENT,
            name: "gain",
            unit: "1/s",
            about: "of the loop",
            kept,
            domain,
            default,
            value,
        };
        let same = TwinParameter {
            index,
            component: 255,
            name: "gain".into(),
            unit: "1/s".into(),
            about: "of the loop".into(),
            kept: kept as u8,
            domain: its_twin,
            default: twin(default),
            value: twin(value),
        };
        pairs.push((ParameterMessage::Is(parameter), tagged(25, &same)));
    }
    pairs
}

#[test]
fn every_message_is_written_and_read_like_postcard() {
    for (message, twin) in pairs() {
        assert_eq!(written(message), twin, "{message:?}");
        assert_eq!(Body::parse(&twin), Ok(Body::Parameter(message)));
        let command = match message {
            ParameterMessage::Command(command) => Ok(command),
            _ => Err(BodyError::UnknownTag {
                tag: twin[0].into(),
            }),
        };
        assert_eq!(ParameterCommand::parse(&twin), command);
        // A node without parameters does not know them.
        let unknown = BodyError::UnknownTag {
            tag: twin[0].into(),
        };
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
        &[23, 0, 5][..],                        // no such kind
        &[23, 0, 0, 2],                         // neither true nor false
        &[23, 0, 4, 2, 0xc3, 0x28],             // not UTF-8
        &[25, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0, 0], // no such state
        &[25, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0], // no such domain
        &[25, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1], // a value of another kind
    ] {
        assert!(Body::parse(bytes).is_err(), "{bytes:?}");
    }
}

#[test]
fn a_value_fits_its_kind_and_range() {
    let percent = Domain::F32 {
        least: 0.0,
        most: 100.0,
    };
    assert_eq!(percent.check(&Value::F32(100.0)), Ok(()));
    for number in [-0.5, 100.5, f32::NAN, f32::INFINITY] {
        assert_eq!(percent.check(&Value::F32(number)), Err(Unfit::Range));
    }
    assert_eq!(percent.check(&Value::U32(1)), Err(Unfit::Kind));
    let name = Domain::Text { longest: 5 };
    assert_eq!(name.check(&Value::Text("Grüß")), Err(Unfit::Range));
    assert_eq!(name.check(&Value::Text("Grüe")), Ok(()));
}
