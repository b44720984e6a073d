use core::fmt::{self, Display};
use std::collections::BTreeMap;
use std::string::{String, ToString};

use serde::{Serialize, Serializer};

use super::{Move, Pose};
use crate::goal::{Fixed, WriteError, to_sink_with, to_slice};
use crate::sink::BufferTooSmall;

#[track_caller]
fn writes(value: &(impl Serialize + ?Sized), text: &str) {
    let mut buffer = [0xA5; 128];
    assert_eq!(to_slice(value, &mut buffer), Ok(text));
}

#[test]
fn results_are_written_as_by_pythons_str() {
    writes("it's", "it's");
    writes("", "");
    writes(&'x', "x");
    writes(&true, "True");
    writes(&false, "False");
    writes(&(), "None");
    writes(&None::<u8>, "None");
    writes(&Some("a"), "a");
    writes(&-7i8, "-7");
    writes(&i64::MIN, "-9223372036854775808");
    writes(&u64::MAX, "18446744073709551615");
    writes(&[1u8, 0], "[1, 0]");
    writes(&(1, "a", 'b', true, ()), "[1, 'a', 'b', True, None]");
    writes(&[""; 0], "[]");
    writes(
        &["it's", "say \"hi\"", "'\"", "\n\u{e9}\u{85}"],
        r#"["it's", 'say "hi"', '\'"', '\né\x85']"#,
    );
    writes(
        &BTreeMap::from([("it's", 1), ("x", 2)]),
        "{\"it's\": 1, 'x': 2}",
    );
    writes(&BTreeMap::from([(1, [[0u8; 0]])]), "{1: [[]]}");
    writes(
        &Pose {
            x: 0.0,
            y: -0.1,
            theta: 1e-5,
        },
        "{'x': 0.0, 'y': -0.1, 'theta': 1e-05}",
    );
}

#[test]
fn variants_are_names_and_mappings() {
    let to = Pose {
        x: 1.0,
        y: 2.0,
        theta: 3.0,
    };
    writes(&Move::Stop, "stop");
    writes(&[Move::Stop], "['stop']");
    writes(&Move::Turn(1.5), "{'turn': 1.5}");
    writes(&[Move::Go(1, -1), Move::Stop], "[{'go': [1, -1]}, 'stop']");
    writes(
        &[Move::Drive { to, fast: true }],
        "[{'drive': {'to': {'x': 1.0, 'y': 2.0, 'theta': 3.0}, 'fast': True}}]",
    );
    #[derive(Serialize)]
    struct Odd {
        #[serde(rename = "it's \\é")]
        key: u8,
    }
    writes(&Odd { key: 1 }, r"{'it\'s \\é': 1}");
}

#[test]
fn floats_are_written_as_by_pythons_repr() {
    for (value, text) in [
        (0.0, "0.0"),
        (-0.0, "-0.0"),
        (1.0, "1.0"),
        (1000.0, "1000.0"),
        (0.1, "0.1"),
        (0.0001, "0.0001"),
        (0.00001, "1e-05"),
        (1.5e-7, "1.5e-07"),
        (123456789.125, "123456789.125"),
        (1e15, "1000000000000000.0"),
        (9999999999999998.0, "9999999999999998.0"),
        (1e16, "1e+16"),
        (123456789012345678.0, "1.2345678901234568e+17"),
        (1e100, "1e+100"),
        (5e-324, "5e-324"),
        (f64::MAX, "1.7976931348623157e+308"),
        (f64::MIN_POSITIVE, "2.2250738585072014e-308"),
        (2f64.powi(-44), "5.684341886080802e-14"),
        (9007199254740993.0, "9007199254740992.0"),
        (f64::INFINITY, "inf"),
        (f64::NEG_INFINITY, "-inf"),
        (f64::NAN, "nan"),
        (-f64::NAN, "nan"),
    ] {
        writes(&value, text);
    }
    writes(
        &[0.1f32, 16777216.0, 1e16, f32::MAX],
        "[0.1, 16777216.0, 1e+16, 3.4028235e+38]",
    );
}

#[test]
fn floats_can_have_fixed_decimals() {
    let mut text = String::new();
    let pose = Pose {
        x: 39.96,
        y: -0.001,
        theta: 1.0,
    };
    let sink = &mut |bytes: &[u8]| text.push_str(std::str::from_utf8(bytes).unwrap());
    to_sink_with(&(pose, 0.125f64), Fixed(2), sink).unwrap();
    assert_eq!(text, "[{'x': 39.96, 'y': 0.00, 'theta': 1.00}, 0.12]");
}

#[test]
fn display_output_is_quoted_as_a_whole() {
    struct Pieces(&'static str);
    impl Display for Pieces {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "{}{}, \né", self.0, 7)
        }
    }
    impl Serialize for Pieces {
        fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
            serializer.collect_str(self)
        }
    }
    writes(&Pieces("it's "), "it's 7, \né");
    writes(&[Pieces("a\\")], r"['a\\7, \né']");
    writes(&[Pieces("it's ")], r#"["it's 7, \né"]"#);
    writes(&[Pieces("\"'' ")], r#"['"\'\' 7, \né']"#);
}

#[test]
fn more_than_eight_levels_are_an_error() {
    let nested = |levels| {
        let mut value = serde_json::json!(7);
        for _ in 0..levels {
            value = serde_json::json!([value]);
        }
        value
    };
    writes(&nested(8), "[[[[[[[[7]]]]]]]]");
    assert_eq!(
        to_slice(&nested(9), &mut [0xA5; 64]),
        Err(WriteError::TooDeep)
    );
}

#[test]
fn a_buffer_too_small_reports_the_size_needed() {
    let error = to_slice(&["left", "right"], &mut [0xA5; 10]).unwrap_err();
    let BufferTooSmall {
        needed, available, ..
    } = match error {
        WriteError::BufferTooSmall(error) => error,
        error => panic!("{error}"),
    };
    assert_eq!((needed, available), (17, 10));
    assert_eq!(
        error.to_string(),
        "buffer too small: 17 bytes needed, 10 available"
    );
}
