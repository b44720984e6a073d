use std::fs;
use std::path::Path;

use ztl_tests::lab::Scratch;

use super::*;

/// Definitions of a package `p`, each with its text.
fn package(files: &[(&str, &str)]) -> (Scratch, Definitions) {
    let scratch = Scratch::new();
    for (file, text) in files {
        let path = scratch.path("src/p").join(file);
        fs::create_dir_all(path.parent().expect("a directory")).expect("a directory");
        fs::write(path, text).expect("a file");
    }
    let definitions = Definitions::below([scratch.path("")]);
    (scratch, definitions)
}

fn said(text: &str) -> String {
    let (_scratch, mut definitions) = package(&[("msg/A.msg", text)]);
    let error = definitions.message("p/A").expect_err(text).to_string();
    // Without the path of the temporary directory.
    match (error.find(" (/"), error.find("): ")) {
        (Some(start), Some(end)) => format!("{}{}", &error[..start], &error[end + 1..]),
        _ => error,
    }
}

#[test]
fn a_mistake_in_a_definition_has_its_line_and_what_is_wrong() {
    for (text, expected) in [
        ("int32", "line 1: expected TYPE NAME, found 'int32'"),
        (
            "\nint32 a b",
            "line 2: expected TYPE NAME, found 'int32 a b'",
        ),
        ("int32 2a", "line 1: invalid name '2a' of a field"),
        ("int32[3 a", "line 1: invalid type 'int32[3'"),
        ("int32[-3] a", "line 1: invalid type 'int32[-3]'"),
        ("int32[2][2] a", "line 1: invalid type 'int32[2][2]'"),
        ("a/b/C x", "line 1: invalid type 'a/b/C'"),
        ("int32 a\nint8 a", "line 2: the field 'a' is there twice"),
        ("time T=1", "line 1: a constant cannot have the type 'time'"),
        ("int32 =1", "line 1: invalid name '' of a constant"),
    ] {
        assert_eq!(
            said(text),
            format!("the definition of p/A is wrong: {expected}")
        );
    }
    assert_eq!(said("B b"), "p/A: there is no definition of p/B");
    assert_eq!(
        said("wstring b"),
        "p/A: there is no definition of p/wstring"
    );
}

#[test]
fn a_message_that_contains_itself_or_is_too_large_is_an_error() {
    assert_eq!(
        said("int32 x\nA[] a"),
        "a message contains itself: p/A in p/A"
    );
    let (_scratch, mut definitions) = package(&[
        ("msg/A.msg", "B b"),
        ("msg/B.msg", "C c"),
        ("msg/C.msg", "B b"),
    ]);
    let error = definitions.message("p/A").expect_err("B is in itself");
    assert_eq!(
        error.to_string(),
        "a message contains itself: p/B in p/C in p/B"
    );
    let chain: Vec<(String, String)> = (0..40)
        .map(|level| (format!("msg/M{level}.msg"), format!("M{} m", level + 1)))
        .collect();
    let chain: Vec<(&str, &str)> = chain
        .iter()
        .map(|(file, text)| (&**file, &**text))
        .collect();
    let (_scratch, mut definitions) = package(&chain);
    let error = definitions.message("p/M0").expect_err("40 levels");
    assert_eq!(
        error.to_string(),
        "p/M0 has more than 32 levels of messages"
    );
    for text in [
        "float64[4294967295] x",
        "uint8[18446744073709551615] x",
        "std_msgs/Empty[1000000] x",
    ] {
        let error = said(text);
        assert!(error.contains("x: the message has more than"), "{error}");
    }
    let huge = "99999999999999999999";
    let error = said(&format!("int8[{huge}] x"));
    assert!(
        error.ends_with(&format!("invalid type 'int8[{huge}]'")),
        "{error}"
    );
    // Each contains ten of the next.
    let nested: Vec<(String, String)> = (0..20)
        .map(|level| (format!("msg/M{level}.msg"), format!("M{}[10] m", level + 1)))
        .chain([("msg/M20.msg".to_owned(), String::new())])
        .collect();
    let nested: Vec<(&str, &str)> = nested
        .iter()
        .map(|(file, text)| (&**file, &**text))
        .collect();
    let (_scratch, mut definitions) = package(&nested);
    let error = definitions.message("p/M0").expect_err("10^20 messages");
    assert!(
        error.to_string().contains("m: the message has more than"),
        "{error}"
    );
}

#[test]
fn bytes_that_are_no_message_are_errors_with_their_field() {
    let mut definitions = Definitions::carried();
    let mut decode = |name: &str, bytes: &[u8]| {
        let message = definitions.message(name).expect(name);
        message.decode(bytes).map_err(|error| error.to_string())
    };
    let said = decode("geometry_msgs/Vector3", &[0; 23]);
    assert_eq!(
        said,
        Err("z: 8 bytes are needed, and 7 are left".to_owned())
    );
    let said = decode("geometry_msgs/Vector3", &[0; 25]);
    assert_eq!(said, Err("1 bytes are left after the message".to_owned()));
    let said = decode("std_msgs/String", &[5, 0, 0, 0, b'a']);
    assert_eq!(
        said,
        Err("data: 5 bytes are needed, and 1 are left".to_owned())
    );
    let text = decode("std_msgs/String", &[2, 0, 0, 0, b'a', 0xff]).expect("a text");
    assert_eq!(
        text.field("data").and_then(Value::as_text),
        Some("a\u{fffd}")
    );
    let mut bytes = vec![0; 16];
    bytes.extend([1, 0, 0, 0, 2, 0, 0, 0, 9]);
    let said = decode("trajectory_msgs/JointTrajectory", &bytes);
    assert_eq!(
        said,
        Err("joint_names.0: 2 bytes are needed, and 1 are left".to_owned()),
    );
    let said = decode("std_msgs/Float64MultiArray", &u32::MAX.to_le_bytes());
    let needed = u64::from(u32::MAX) * 12;
    assert_eq!(
        said,
        Err(format!(
            "layout.dim: {needed} bytes are needed, and 0 are left"
        )),
    );
}

#[test]
fn lists_of_messages_without_bytes_take_bounded_memory() {
    let (_scratch, mut definitions) = package(&[
        ("msg/A.msg", "B[] b"),
        ("msg/B.msg", "std_msgs/Empty[] e\nstd_msgs/Empty[] f"),
    ]);
    let message = definitions.message("p/A").expect("A");
    let many = 400_000_u32.to_le_bytes();
    let bytes = [[2, 0, 0, 0], many, many, many, many].concat();
    let error = message.decode(&bytes).expect_err("1,600,000 values");
    assert_eq!(error.kind, DecodeErrorKind::TooManyValues);
    assert_eq!(error.field, "b.0.f");
    let few = 4_000_u32.to_le_bytes();
    let bytes = [[2, 0, 0, 0], few, few, few, few].concat();
    let value = message.decode(&bytes).expect("16,000 values");
    assert_eq!(message.encode(&value).expect("the same"), bytes);
}

#[test]
fn random_bytes_and_definitions_never_panic() {
    let mut random = ztl_tests::lab::Random::new(ztl_tests::lab::seed());
    let mut definitions = Definitions::carried();
    let names = definitions.message_names();
    assert!(names.len() > 80, "{names:?}");
    for name in &names {
        let message = definitions.message(name).expect(name);
        let zero = message.encode(&message.zero()).expect(name);
        for _ in 0..20 {
            let mut bytes = zero.clone();
            for _ in 0..random.below(4) {
                if let Some(place) = random
                    .below(bytes.len().max(1))
                    .checked_rem(bytes.len().max(1))
                    && let Some(byte) = bytes.get_mut(place)
                {
                    *byte = random.bits() as u8;
                }
            }
            bytes.truncate(random.below(bytes.len() + 1));
            bytes.extend((0..random.below(9)).map(|_| random.bits() as u8));
            if let Ok(value) = message.decode(&bytes) {
                message.encode(&value).expect("a decoded value");
            }
        }
    }
    let words = [
        "int32",
        "string",
        "Header",
        "std_msgs/Empty",
        "x",
        "[",
        "]",
        "[3]",
        "=",
        "#",
        "\n",
        " ",
        "\t",
        "---",
        "é",
        "9",
        "/",
    ];
    for _ in 0..2000 {
        let text: String = (0..random.below(12)).map(|_| random.pick(&words)).collect();
        if let Ok(definition) = definition::Definition::parse("p", &text) {
            assert!(definition.fields.len() + definition.constants.len() <= 12);
        }
    }
}

#[test]
fn a_value_of_another_type_is_not_encoded() {
    let mut definitions = Definitions::carried();
    let message = definitions
        .message("trajectory_msgs/JointTrajectoryPoint")
        .expect("it");
    let mut point = message.zero();
    *point.field_mut("velocities").expect("a field") =
        Value::List(vec![Value::Float(1.0), Value::Bool(true)]);
    let error = message.encode(&point).expect_err("a truth is not a float");
    assert_eq!(error.to_string(), "velocities.1: expected float64");
    let covariance = definitions
        .message("geometry_msgs/PoseWithCovariance")
        .expect("it");
    let mut pose = covariance.zero();
    *pose.field_mut("covariance").expect("a field") = Value::List(vec![Value::Float(1.0)]);
    let error = covariance.encode(&pose).expect_err("one of 36");
    assert_eq!(error.to_string(), "covariance: expected float64[36]");
    let byte = definitions.message("std_msgs/UInt8").expect("it");
    let mut value = byte.zero();
    *value.field_mut("data").expect("a field") = Value::Unsigned(256);
    assert_eq!(
        byte.encode(&value).expect_err("256").to_string(),
        "data: expected uint8"
    );
    assert_eq!(
        byte.encode(&point).expect_err("a point").to_string(),
        "expected a message of std_msgs/UInt8"
    );
}

#[test]
fn the_robots_files_count_more_than_the_carried_definitions() {
    let (scratch, mut definitions) = package(&[("msg/A.msg", "std_msgs/Bool b\r\n")]);
    let own = scratch.path("src/common/std_msgs/msg");
    fs::create_dir_all(&own).expect("a directory");
    fs::write(own.join("Bool.msg"), "bool data # ours\n").expect("a file");
    let ignored = scratch.path("ignored");
    fs::create_dir_all(ignored.join("std_msgs/msg")).expect("a directory");
    fs::write(ignored.join("CATKIN_IGNORE"), "").expect("a file");
    fs::write(ignored.join("std_msgs/msg/Bool.msg"), "int32 wrong").expect("a file");
    let message = definitions.message("p/A").expect("A");
    let rule = "=".repeat(80);
    assert_eq!(
        message.full_text(),
        format!("std_msgs/Bool b\n\n{rule}\nMSG: std_msgs/Bool\nbool data # ours\n"),
    );
    assert!(definitions.message_names().contains(&"p/A".to_owned()));
    assert!(Path::new(&own).exists());
}

#[test]
fn an_action_is_known_by_its_own_file_or_by_what_was_made_of_it() {
    let mut definitions = Definitions::carried();
    let action = definitions
        .action("actionlib/TestAction")
        .expect("the carried one");
    // As `rosmsg md5` of these.
    assert_eq!(action.action_goal.md5(), "348369c5b403676156094e8c159720bf");
    assert_eq!(
        action.action_result.md5(),
        "3d669e3a63aa986c667ea7b0f46ce85e"
    );
    assert_eq!(
        action.action_feedback.md5(),
        "6d3d0bf7fb3dda24779c010a9f3eb7cb"
    );
    let error = definitions
        .action("actionlib/Test")
        .expect_err("without Action");
    assert_eq!(
        error.to_string(),
        "there is no definition of actionlib/Test"
    );
    assert!(
        definitions
            .action_names()
            .contains(&"control_msgs/FollowJointTrajectoryAction".to_owned())
    );
    let error = definitions
        .action("p/GoAction")
        .expect_err("no such action");
    assert_eq!(error.to_string(), "there is no definition of p/GoAction");
    let (_scratch, mut definitions) = package(&[("action/Go.action", "int32 a\n---\n")]);
    let error = definitions
        .action("p/GoAction")
        .expect_err("two parts")
        .to_string();
    assert!(
        error.contains("expected goal, result and feedback"),
        "{error}"
    );
    for name in ["p", "p/", "/A", "p/A/B", "p/../A", "Go"] {
        let error = definitions.message(name).expect_err(name);
        assert_eq!(
            error.to_string(),
            format!("'{name}' is not a type, as geometry_msgs/Twist")
        );
    }
}
