use std::string::ToString;

use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::{Move, Pose, any, read};
use crate::goal::{Expected, GoalError, GoalErrorKind};

const FIELDS: &[&str] = &["x", "y", "theta"];

#[track_caller]
fn fails<T: DeserializeOwned>(text: &str, at: usize, kind: GoalErrorKind) {
    let error = read::<T>(text).err();
    assert_eq!(error, Some(GoalError { at, kind }), "{text}");
}

#[track_caller]
fn expects<T: DeserializeOwned>(text: &str, at: usize, expected: Expected) {
    fails::<T>(text, at, GoalErrorKind::Expected(expected));
}

#[test]
fn invalid_syntax_is_reported_where_it_begins() {
    use Expected::{Close, Colon, Comma, CommaOrClose, End, Value};
    type Any = serde_json::Value;
    for (text, at, expected) in [
        ("[1] 2", 4, End),
        ("[1]]", 3, End),
        ("'a' b", 4, End),
        ("[,]", 1, Value),
        ("[1,,2]", 3, Value),
        ("[1, ", 0, Value),
        ("['a' 'b']", 5, CommaOrClose),
        ("[1: 2]", 2, CommaOrClose),
        ("[a: b]", 2, CommaOrClose),
        ("[[1}]", 3, CommaOrClose),
        ("[a [b]]", 3, CommaOrClose),
        ("[a\nb]", 3, CommaOrClose),
        ("[a #b]", 3, CommaOrClose),
        ("[datetime.date(2020, 1, 1)]", 14, CommaOrClose),
        ("[a)]", 2, CommaOrClose),
        ("(1)", 2, Comma),
        ("(1 )", 3, Comma),
        ("{a}", 2, Colon),
        ("{1, 2}", 2, Colon),
        ("{a:1}", 4, Colon),
        ("{'a' 1}", 5, Colon),
        ("{a: }", 4, Value),
        ("{a: , b: 1}", 4, Value),
        ("{: 1}", 1, Value),
        ("{a: 1 b: 2}", 7, CommaOrClose),
        ("{a: b: c}", 5, CommaOrClose),
        ("[&a b]", 1, Value),
        ("[*a]", 1, Value),
        ("[!t a]", 1, Value),
        ("[b'hi']", 1, Value),
        ("[- 1]", 1, Value),
        ("{? a : b}", 1, Value),
        ("[@a]", 1, Value),
        ("[# a\n]", 1, Value),
    ] {
        if text == "[1, " {
            fails::<Any>(text, at, GoalErrorKind::Unterminated);
        } else {
            expects::<Any>(text, at, expected);
        }
        if expected == End {
            expects::<serde::de::IgnoredAny>(text, at, expected);
        }
    }
    expects::<Move>("{turn: 1, go: [1, 2]}", 10, Close);
    // At the end of the text, the missing part is reported.
    expects::<Any>("{a:", 3, Value);
    expects::<Any>("{a", 2, Colon);
}

#[test]
fn an_unclosed_bracket_or_quote_is_reported_where_it_opens() {
    for (text, at) in [
        ("[1, [2, 3]", 0),
        ("[1, [2, 3", 4),
        ("[1, {a: (2, 3, ", 8),
        ("[1, 'a]", 4),
        ("[1, 'it\\']", 4),
        ("{a: \"b}", 4),
        ("'", 0),
        ("['''", 1),
    ] {
        let error = any(text).unwrap_err();
        assert_eq!(
            (error.at, error.kind),
            (at, GoalErrorKind::Unterminated),
            "{text}"
        );
    }
}

#[test]
fn a_nul_ends_the_text_except_in_a_goal_that_is_a_text() {
    for (text, at) in [("[a\0]", 0), ("[1, '\0']", 4), ("{a: 1\0}", 0)] {
        fails::<serde_json::Value>(text, at, GoalErrorKind::Unterminated);
    }
    expects::<f32>("7\0", 1, Expected::End);
    expects::<bool>("True\0", 4, Expected::End);
    assert_eq!(crate::goal::from_str("a\0"), Ok("a\0"));
}

#[test]
fn a_value_of_the_wrong_type_is_reported_at_its_position() {
    use Expected::{Bool, Integer, Mapping, Nothing, Number, Sequence, Struct, Text};
    expects::<f32>("left", 0, Number);
    expects::<f32>("", 0, Number);
    expects::<f32>(" 1 2", 1, Number);
    expects::<f32>("'left'", 0, Number);
    expects::<[f32; 2]>("[1, left]", 4, Number);
    expects::<[f32; 2]>("[1, [2]]", 4, Number);
    expects::<[f32; 2]>("[1, None]", 4, Number);
    expects::<(i32, i32)>("[1, 2.0]", 4, Integer);
    expects::<(i32, i32)>("[1, '2']", 4, Integer);
    expects::<(i32, bool)>("[1, 0]", 4, Bool);
    expects::<[(); 1]>("[1]", 1, Nothing);
    expects::<[std::string::String; 1]>("[ [a]]", 2, Text);
    expects::<[f32; 2]>("{a: 1}", 0, Sequence);
    expects::<[f32; 2]>("left", 0, Sequence);
    expects::<std::collections::BTreeMap<u8, u8>>("[1]", 0, Mapping);
    expects::<Pose>("left", 0, Struct);
    expects::<[Pose; 1]>("[ left]", 2, Struct);
}

#[test]
fn nested_errors_are_reported_at_the_innermost_value() {
    use GoalErrorKind::{MissingField, OutOfRange, UnknownField, UnknownVariant, WrongLength};
    type Poses = std::collections::BTreeMap<std::string::String, [Pose; 2]>;
    let text = "{home: [[0, 0, 0], {x: 1, y: z, theta: 0}]}";
    expects::<Poses>(text, 29, Expected::Number);
    for (text, at, kind) in [
        (
            "{a: [[0, 0, 0], {x: 1, z: 2, theta: 0}]}",
            23,
            UnknownField(FIELDS),
        ),
        (
            "{a: [[0, 0, 0], {x: 1, theta: 0}]}",
            16,
            MissingField("theta"),
        ),
        ("{a: [[0, 0, 0], [1, 2]]}", 16, WrongLength),
        ("{a: [[0, 0, 0], [1, 2, 3, 4]]}", 26, WrongLength),
        ("{a: [[0, 0, 0]]}", 4, WrongLength),
        ("{a: [[0, 0, 0], [1, 1e39, 3]]}", 20, OutOfRange),
    ] {
        let kind = match kind {
            MissingField(_) => MissingField("y"),
            kind => kind,
        };
        fails::<Poses>(text, at, kind);
    }
    const VARIANTS: &[&str] = &["stop", "turn", "go", "drive"];
    for (text, at, kind) in [
        ("halt", 0, UnknownVariant(VARIANTS)),
        (" 'halt'", 1, UnknownVariant(VARIANTS)),
        ("{ halt: 1}", 2, UnknownVariant(VARIANTS)),
        ("{turn: 1e40}", 7, OutOfRange),
        ("{go: [1, 128]}", 9, OutOfRange),
        ("{go: [1]}", 5, WrongLength),
        ("{drive: {fast: yes}}", 8, MissingField("to")),
        ("{drive: {to: [0, 0]}}", 13, WrongLength),
        ("{stop: 1}", 7, GoalErrorKind::Expected(Expected::Nothing)),
        (
            "turn",
            0,
            GoalErrorKind::Expected(Expected::VariantWithValue),
        ),
        ("{}", 1, GoalErrorKind::Expected(Expected::VariantWithValue)),
    ] {
        fails::<Move>(text, at, kind);
    }
}

#[test]
fn unknown_and_duplicate_fields_are_reported_at_their_keys() {
    fails::<Pose>("{'z': 1}", 1, GoalErrorKind::UnknownField(FIELDS));
    fails::<Pose>(
        "{x: 1, y: {z: 1}}",
        10,
        GoalErrorKind::Expected(Expected::Number),
    );
    fails::<Pose>(
        "{x: 1, y: 2,  x: 3, theta: 0}",
        14,
        GoalErrorKind::DuplicateField("x"),
    );
    fails::<Pose>("{x: 1}", 0, GoalErrorKind::MissingField("y"));
}

#[test]
fn errors_from_the_targets_code_have_a_position_but_no_message() {
    #[derive(Debug, Deserialize)]
    #[serde(try_from = "[f32; 2]")]
    struct Range;
    impl TryFrom<[f32; 2]> for Range {
        type Error = &'static str;
        fn try_from([low, high]: [f32; 2]) -> Result<Self, Self::Error> {
            (low <= high).then_some(Self).ok_or("the wrong way round")
        }
    }
    assert!(read::<Range>("[1, 2]").is_ok());
    fails::<[Range; 2]>("[[1, 2], [2, 1]]", 9, GoalErrorKind::Refused);
    fails::<[core::num::NonZeroU8; 2]>("[1, 0]", 4, GoalErrorKind::OutOfRange);
    fails::<[char; 2]>("[a, bc]", 4, GoalErrorKind::WrongValue);
}

#[test]
fn errors_display_position_and_cause() {
    for (error, text) in [
        (
            read::<Pose>("[0, left, 0]"),
            "goal, byte 4: expected a number",
        ),
        (
            read::<Pose>("{z: 1}"),
            "goal, byte 1: unknown field, expected x or y or theta",
        ),
        (read::<Pose>("{x: 1}"), "goal, byte 0: field y is missing"),
        (read::<Pose>("[0, 0"), "goal, byte 0: never closed"),
        (
            read::<Pose>("[0, 0, 0] left"),
            "goal, byte 10: expected the end",
        ),
    ] {
        assert_eq!(error.unwrap_err().to_string(), text);
    }
}
