use std::collections::BTreeMap;
use std::string::String;
use std::vec::Vec;

use serde::Deserialize;
use serde_json::json;

use super::{Move, Pose, any, read};
use crate::goal::{Expected, GoalErrorKind, MAX_DEPTH, from_str};

#[test]
fn a_pose_is_read_from_a_list_a_tuple_and_mappings_in_any_order() {
    let pose = Pose {
        x: 0.0,
        y: -0.5,
        theta: 1.57,
    };
    for text in [
        "[0, -0.5, 1.57]",
        " [ 0 ,-.5,1.57 ] ",
        "[0,\n -5e-1,\n 1.57,\n]",
        "(0, -0.5, 1.57)",
        "{'x': 0, 'y': -0.5, 'theta': 1.57}",
        "{\"theta\":1.57,\"y\":-0.5,\"x\":0}",
        "{x: 0, y: -0.5, theta: 1.57}",
        "{theta: 1.57, y : -0.5, x: 0x0,}",
        "['0', '-5e-1', \"1.57\"]",
    ] {
        assert_eq!(from_str::<Pose>(text), Ok(pose), "{text}");
    }
}

#[test]
fn variants_are_read_from_names_and_from_mappings() {
    let to = Pose {
        x: 1.0,
        y: 2.0,
        theta: 0.0,
    };
    for (text, command) in [
        ("stop", Move::Stop),
        (" stop ", Move::Stop),
        ("'stop'", Move::Stop),
        ("\"stop\"", Move::Stop),
        ("{'stop': None}", Move::Stop),
        ("{stop: ~}", Move::Stop),
        ("{'turn': 1.5}", Move::Turn(1.5)),
        ("{turn: 90,}", Move::Turn(90.0)),
        ("{go: [1, -2]}", Move::Go(1, -2)),
        ("{'go': (1, -2)}", Move::Go(1, -2)),
        (
            "{drive: {to: [1, 2, 0], fast: on}}",
            Move::Drive { to, fast: true },
        ),
        (
            "{'drive': [{'x': 1, 'y': 2, 'theta': 0}]}",
            Move::Drive { to, fast: false },
        ),
    ] {
        assert_eq!(read::<Move>(text), Ok(command), "{text}");
    }
    let commands = [Move::Stop, Move::Turn(1.0), Move::Stop];
    assert_eq!(read("[stop, {turn: 1}, 'stop']"), Ok(commands));
}

#[test]
fn an_option_is_none_for_every_spelling_of_null_and_an_empty_goal() {
    for text in ["None", "null", "Null", "NULL", "~", " None ", "", "  "] {
        assert_eq!(from_str::<Option<f32>>(text), Ok(None), "{text}");
        assert_eq!(from_str::<()>(text), Ok(()), "{text}");
    }
    assert_eq!(from_str("1"), Ok(Some(1)));
    assert_eq!(from_str("none"), Ok(Some("none")));
    assert_eq!(from_str(" 'None' "), Ok(Some(" 'None' ")));
    assert_eq!(
        from_str("[None, 'None', ~, nil]"),
        Ok([None, Some("None"), None, Some("nil")])
    );
}

#[test]
fn yaml_words_are_bools_for_a_bool_and_texts_for_any() {
    for (words, value) in [
        (
            [
                "True", "true", "TRUE", "yes", "Yes", "YES", "on", "On", "ON",
            ],
            true,
        ),
        (
            [
                "False", "false", "FALSE", "no", "No", "NO", "off", "Off", "OFF",
            ],
            false,
        ),
    ] {
        for word in words {
            assert_eq!(from_str(word), Ok(value));
            let expected = match word.len() {
                4 | 5 => json!(value),
                _ => json!(word),
            };
            assert_eq!(any(word), Ok(expected));
        }
    }
    for word in ["y", "n", "1", "0", "tRUE", "'True'", "", "[True]"] {
        let error = from_str::<bool>(word).unwrap_err();
        assert_eq!(
            error.kind,
            GoalErrorKind::Expected(Expected::Bool),
            "{word}"
        );
    }
}

#[test]
fn deserialize_any_reads_what_the_text_looks_like() {
    for (text, value) in [
        ("None", json!(null)),
        ("[]", json!([])),
        ("()", json!([])),
        ("{}", json!({})),
        ("(1,)", json!([1])),
        ("[1, -2, 3.5, 1e3]", json!([1, -2, 3.5, 1000.0])),
        // The second is how YAML quotes the text `-.0`, which the first one spells plainly.
        ("[-.0, '-.0']", json!([-0.0, "-.0"])),
        ("[0x1F, 0o17, 0b11, 1_000]", json!([31, 15, 3, 1000])),
        (
            "[010, 1__0, 1:30, 2020-01-01]",
            json!(["010", "1__0", "1:30", "2020-01-01"]),
        ),
        (
            "[left, it's, say \"hi\"]",
            json!(["left", "it's", "say \"hi\""]),
        ),
        (
            "[a b, -a, a-b, a#b, a:b, ?a]",
            json!(["a b", "-a", "a-b", "a#b", "a:b", "?a"]),
        ),
        ("[f(x), (hi), :(]", json!(null)),
        (
            "{'a': {b: [c]}, d e : f}",
            json!({"a": {"b": ["c"]}, "d e": "f"}),
        ),
        ("{1: a, True: b}", json!({"1": "a", "True": "b"})),
        ("hello, world: it's", json!("hello, world: it's")),
        (" padded ", json!(" padded ")),
        (" 7 ", json!(7)),
        ("", json!("")),
        ("'quoted'", json!("quoted")),
        ("a\u{a0}b\u{3000}", json!("a\u{a0}b\u{3000}")),
    ] {
        if value.is_null() && text != "None" {
            assert!(any(text).is_err(), "{text}");
        } else {
            assert_eq!(any(text), Ok(value), "{text}");
        }
    }
    assert_eq!(
        any("[f(x), hi (you), (a,)]"),
        Ok(json!(["f(x)", "hi (you)", ["a"]]))
    );
}

#[test]
fn a_goal_that_is_a_text_is_taken_unchanged() {
    for text in [
        "hello, world: it's",
        "'tis",
        "'quoted'",
        "[draft",
        "{a: 1} ",
        " \n",
        "",
        "None",
        "1e3",
        "\\n",
    ] {
        assert_eq!(from_str::<&str>(text), Ok(text));
        assert_eq!(read::<String>(text).as_deref(), Ok(text));
        let small = read::<heapless::String<32>>(text).unwrap();
        assert_eq!(small, text);
    }
    assert_eq!(from_str("'"), Ok('\''));
}

#[test]
fn a_text_in_a_collection_is_plain_or_quoted() {
    let words: [&str; 5] = from_str("[left, 1e3, 'None', None, \"it's\"]").unwrap();
    assert_eq!(words, ["left", "1e3", "None", "None", "it's"]);
    assert_eq!(from_str("[a, 'b', 7]"), Ok(('a', 'b', '7')));
}

#[test]
fn keys_have_types_too() {
    assert_eq!(
        read("{1: a, 0x2: b}"),
        Ok(BTreeMap::from([(1u8, String::from("a")), (2, "b".into())]))
    );
    assert_eq!(
        read("{(0, 1): 2, [3, 4]: 5}"),
        Ok(BTreeMap::from([((0, 1), 2), ((3, 4), 5)]))
    );
    assert_eq!(
        read("{None: 1, x: 2}"),
        Ok(BTreeMap::from([(None, 1), (Some(String::from("x")), 2)]))
    );
}

#[test]
fn heapless_collections_are_filled() {
    let few: heapless::Vec<f32, 4> = from_str("[1, 2.5]").unwrap();
    assert_eq!(few, [1.0, 2.5]);
    let texts: heapless::Vec<heapless::String<8>, 4> = read("['it\\'s', left]").unwrap();
    assert_eq!(texts, ["it's", "left"]);
    let error = from_str::<heapless::Vec<u8, 2>>("[1, 2, 3]").unwrap_err();
    assert_eq!((error.at, error.kind), (0, GoalErrorKind::WrongLength));
    let error = from_str::<heapless::String<2>>("left").unwrap_err();
    assert_eq!((error.at, error.kind), (0, GoalErrorKind::WrongLength));
    assert_eq!(read::<Vec<u8>>("(1, 2, 3)"), Ok(std::vec![1, 2, 3]));
    assert_eq!(from_str::<&[u8]>("bytes"), Ok(&b"bytes"[..]));
}

#[test]
fn unknown_fields_are_skipped_with_any_value() {
    #[derive(Debug, PartialEq, Deserialize)]
    struct Speed {
        speed: u8,
    }
    let text = r"{'a': 'it\'s', b: [{c: (1, 2)}, 'x'], speed: 7, d: {}, e f: None}";
    assert_eq!(from_str(text), Ok(Speed { speed: 7 }));
}

#[test]
fn serde_attributes_apply() {
    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    struct Motion {
        #[serde(rename = "max speed", alias = "v")]
        speed: f32,
        note: Option<String>,
        times: u8,
    }
    impl Default for Motion {
        fn default() -> Self {
            Self {
                speed: 0.5,
                note: None,
                times: 1,
            }
        }
    }
    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(untagged)]
    enum Where {
        Named(String),
        At([f32; 2]),
        Level(i32),
    }
    #[derive(Debug, PartialEq, Deserialize)]
    struct Name<'a>(&'a str);

    let plain = Motion::default();
    assert_eq!(read("{}"), Ok(Motion { ..plain }));
    assert_eq!(
        read("{v: 2}"),
        Ok(Motion {
            speed: 2.0,
            ..Motion::default()
        })
    );
    assert_eq!(
        read("{'max speed': 1, 'note': 'x', 'times': 3}"),
        Ok(Motion {
            speed: 1.0,
            note: Some("x".into()),
            times: 3
        })
    );
    assert_eq!(
        read("[door, [1, 2.5], -3]"),
        Ok([
            Where::Named("door".into()),
            Where::At([1.0, 2.5]),
            Where::Level(-3)
        ])
    );
    assert_eq!(from_str("'tis"), Ok(Name("'tis")));
}

#[test]
fn eight_levels_are_read_and_a_ninth_is_an_error_where_it_opens() {
    let nested = |levels: usize| "[".repeat(levels) + &"]".repeat(levels);
    assert!(any(&nested(MAX_DEPTH.into())).is_ok());
    let error = any(&nested(9)).unwrap_err();
    assert_eq!((error.at, error.kind), (8, GoalErrorKind::TooDeep));
    let error = from_str::<serde::de::IgnoredAny>(&nested(100_000)).unwrap_err();
    assert_eq!((error.at, error.kind), (8, GoalErrorKind::TooDeep));

    #[derive(Debug, Deserialize)]
    enum Onion {
        #[expect(dead_code, reason = "only the nesting matters")]
        Layer(std::boxed::Box<Onion>),
        Core,
    }
    let onion = |levels: usize| "{Layer: ".repeat(levels) + "Core" + &"}".repeat(levels);
    assert!(read::<Onion>(&onion(8)).is_ok());
    assert_eq!(read::<Onion>(&onion(9)).unwrap_err().at, 8 * 8);
    // Siblings do not nest.
    assert!(any(&std::format!("[{}]", "[], ".repeat(1000))).is_ok());
}
