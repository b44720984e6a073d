//! Every case recorded from the original's codecs (`vectors/ztl-0.3.3-codec.json`), read and written by ours.
//! `vectors/differences.json` lists all intended differences.

#![expect(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::panic,
    reason = "a test says what is wrong by panicking"
)]

use serde_json::Value;
use ztl_core::integer::Integer;
use ztl_core::message::ParseError;
use ztl_core::spec::SpecError;
use ztl_core::{Message, Request, State, TaskSpec};

fn vectors() -> Value {
    serde_json::from_str(include_str!("vectors/ztl-0.3.3-codec.json")).unwrap()
}

/// Whether the list has this field as one that the original reads as a number and we reject.
fn is_difference(field: &str) -> bool {
    let list: Value = serde_json::from_str(include_str!("vectors/differences.json")).unwrap();
    let mut numbers = list["numbers"].as_array().unwrap().iter();
    numbers.any(|entry| {
        entry["examples"]
            .as_array()
            .unwrap()
            .iter()
            .any(|e| e == field)
    })
}

fn cases(of: &str) -> Vec<Value> {
    let cases = vectors()[of].as_array().unwrap().clone();
    assert!(cases.len() > 10, "{of} has cases");
    cases
}

fn text<'v>(case: &'v Value, name: &str) -> &'v str {
    case[name]
        .as_str()
        .unwrap_or_else(|| panic!("{name} in {case}"))
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
        .collect()
}

#[test]
fn codes_equal_the_originals() {
    let vectors = vectors();
    for state in State::ALL {
        assert_eq!(vectors["states"][state.name()], state.code());
    }
    for (name, request) in [
        ("INIT", Request::Init),
        ("STATUS", Request::Status),
        ("ABORT", Request::Abort),
    ] {
        assert_eq!(vectors["requests"][name], request.code());
    }
}

#[test]
fn messages_are_written_as_by_the_original() {
    for case in cases("message_encode") {
        let message = Message {
            scope: text(&case, "scope"),
            state: text(&case, "state"),
            id: text(&case, "id"),
            payload: text(&case, "payload"),
        };
        let mut buffer = [0xA5; 256];
        let written = message.encode_into(&mut buffer).unwrap();
        assert_eq!(written, bytes(text(&case, "bytes")), "{case}");
        assert_eq!(written.len(), message.encoded_len());
    }
}

#[test]
fn messages_are_read_as_by_the_original() {
    for case in cases("message_decode") {
        let wire = bytes(text(&case, "bytes"));
        let decoded = &case["decoded"];
        let message = match Message::parse(&wire) {
            Ok(message) => message,
            Err(ParseError::NotUtf8 { .. }) => {
                assert_eq!(case["error"], "UnicodeDecodeError", "{case}");
                continue;
            }
            Err(ParseError::MissingFields { found, scope }) => {
                assert_eq!(decoded.as_object().unwrap().len(), found, "{case}");
                assert_eq!(decoded["scope"], scope, "{case}");
                continue;
            }
            Err(other) => panic!("{other} in {case}"),
        };
        for (name, ours) in [
            ("scope", message.scope),
            ("state", message.state),
            ("id", message.id),
            ("payload", message.payload),
        ] {
            assert_eq!(text(decoded, name), ours, "{case}");
        }
        assert_number(&case, "state_int", message.state);
        assert_number(&case, "id_int", message.id);
    }
}

#[track_caller]
fn assert_number(case: &Value, name: &str, field: &str) {
    let ours = Integer::parse(field).map(|number| {
        let mut digits = Vec::new();
        number.put(&mut |bytes: &[u8]| digits.extend_from_slice(bytes));
        String::from_utf8(digits).unwrap()
    });
    let theirs = case[name].as_str();
    if is_difference(field) {
        assert_ne!(
            ours.ok().as_deref(),
            theirs,
            "no longer a difference: {case}"
        );
        return;
    }
    assert_eq!(ours.ok().as_deref(), theirs, "{name} in {case}");
}

#[test]
fn task_specs_are_written_as_by_the_original() {
    for case in cases("task_encode") {
        let spec = TaskSpec {
            handler: text(&case, "handler"),
            component: text(&case, "component"),
            goal: text(&case, "goal"),
        };
        let mut buffer = [0xA5; 128];
        assert_eq!(spec.encode_into(&mut buffer), Ok(text(&case, "text")));
        assert_eq!(spec.encoded_len(), text(&case, "text").len());
    }
}

#[test]
fn task_specs_are_read_as_by_the_original() {
    for case in cases("task_decode") {
        let mut buffer = [0xA5; 128];
        let decoded = &case["decoded"];
        match TaskSpec::decode(text(&case, "text"), &mut buffer) {
            Ok(spec) => {
                assert_eq!(text(decoded, "handler"), spec.handler, "{case}");
                assert_eq!(text(decoded, "component"), spec.component, "{case}");
                assert_eq!(text(decoded, "goal"), spec.goal, "{case}");
            }
            Err(SpecError::NoComponent) => assert_eq!(parts(decoded), 1, "{case}"),
            Err(SpecError::NoGoal) => assert_eq!(parts(decoded), 2, "{case}"),
            Err(SpecError::Base64(_)) => assert_eq!(case["error"], "Error", "{case}"),
            Err(SpecError::NotUtf8 { .. }) => {
                assert_eq!(case["error"], "UnicodeDecodeError", "{case}");
            }
            Err(other) => panic!("{other} in {case}"),
        }
    }
}

fn parts(decoded: &Value) -> usize {
    decoded.as_object().unwrap().len()
}
