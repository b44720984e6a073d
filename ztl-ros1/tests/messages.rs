//! Each type that is installed on this machine, against genpy: md5 sum, full text, and random messages.
#![expect(
    clippy::expect_used,
    clippy::indexing_slicing,
    reason = "helpers of tests may panic"
)]

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::process::Command;

use serde_json::Value as Json;
use ztl_ros1::message::{Definitions, MessageType};
use ztl_tests::lab::seed;

/// What `messages.py` prints of each type.
fn known_to_genpy() -> Vec<Json> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/messages.py");
    // Debian's modules are those of its own Python.
    let mut python = Command::new("/usr/bin/python3");
    let output = python.arg(script).arg(seed().to_string()).output();
    let output = output.expect("/usr/bin/python3 is there: apt install python3");
    assert!(
        output.status.success(),
        "genpy fails; if it is not there: apt install ros-core\n{}",
        String::from_utf8_lossy(&output.stderr),
    );
    let lines = String::from_utf8(output.stdout).expect("UTF-8");
    let told = lines
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"));
    told.collect()
}

fn text<'j>(json: &'j Json, key: &str) -> &'j str {
    json.get(key).and_then(Json::as_str).expect(key)
}

fn list<'j>(json: &'j Json, key: &str) -> &'j [Json] {
    json.get(key).and_then(Json::as_array).expect(key)
}

fn bytes(digits: &str) -> Vec<u8> {
    let digit = |at: usize| u8::from_str_radix(&digits[at..at + 2], 16).expect("digits");
    (0..digits.len()).step_by(2).map(digit).collect()
}

/// Compares a message's full text and its samples with those of genpy.
fn compare(message: &MessageType, told: &Json) {
    let name = text(told, "name");
    assert_eq!(message.full_text(), text(told, "text"), "{name}");
    for sample in list(told, "samples") {
        let bytes = bytes(text(sample, "bytes"));
        let value = message.decode(&bytes).expect(name);
        let json = serde_json::to_value(&value).expect(name);
        assert_eq!(Some(&json), sample.get("value"), "{name}");
        assert_eq!(message.encode(&value).expect(name), bytes, "{name}");
        for end in 0..bytes.len() {
            assert!(
                message.decode(&bytes[..end]).is_err(),
                "{name}: {end} bytes"
            );
        }
    }
}

#[test]
fn all_installed_types_are_those_of_genpy() {
    let mut definitions = Definitions::below([PathBuf::from("/usr/share")]);
    let (mut messages, mut services, mut actions) = (0, 0, BTreeSet::new());
    for told in known_to_genpy() {
        let (name, md5) = (text(&told, "name"), text(&told, "md5"));
        match text(&told, "kind") {
            "msg" => {
                let message = definitions.message(name).expect(name);
                assert_eq!(message.md5(), md5, "{name}");
                compare(&message, &told);
                messages += 1;
                if let Some(action) = name.strip_suffix("ActionGoal") {
                    actions.insert(format!("{action}Action"));
                }
            }
            _ => {
                let service = definitions.service(name).expect(name);
                assert_eq!(service.md5, md5, "{name}");
                let [request, response] = list(&told, "halves") else {
                    panic!("{name} has two halves");
                };
                compare(&service.request, request);
                compare(&service.response, response);
                services += 1;
            }
        }
    }
    for name in &actions {
        let action = definitions.action(name).expect(name);
        let parts = [
            &action.action_goal,
            &action.action_result,
            &action.action_feedback,
        ];
        for part in parts {
            let zero = part.encode(&part.zero()).expect(name);
            assert_eq!(part.decode(&zero).expect(name), part.zero(), "{name}");
        }
    }
    assert!(
        messages >= 60 && !actions.is_empty(),
        "{messages}, {actions:?}"
    );
    println!(
        "{messages} messages, {services} services, {} actions",
        actions.len()
    );
}

#[test]
fn the_carried_definitions_have_the_md5_sums_of_the_installed_ones() {
    let mut installed = Definitions::below([PathBuf::from("/usr/share")]);
    let mut carried = Definitions::carried();
    let mut compared = 0;
    for name in carried.message_names() {
        let ours = carried.message(&name).expect(&name);
        let theirs = installed.message(&name).expect(&name);
        assert_eq!(ours.md5(), theirs.md5(), "{name}");
        compared += usize::from(ours.full_text() != theirs.full_text());
    }
    for name in carried.service_names() {
        let (ours, theirs) = (carried.service(&name), installed.service(&name));
        assert_eq!(ours.expect(&name).md5, theirs.expect(&name).md5, "{name}");
    }
    for name in carried.action_names() {
        carried.action(&name).expect(&name);
    }
    assert!(
        compared > 20,
        "the installed definitions have comments, and were compared: {compared}"
    );
}

/// No package of Debian has `control_msgs`. These sums are those that robots with ROS 1 announce.
#[test]
fn the_carried_control_msgs_have_the_md5_sums_of_ros() {
    let mut carried = Definitions::carried();
    let trajectory = carried.action("control_msgs/FollowJointTrajectoryAction");
    let trajectory = trajectory.expect("the action");
    assert_eq!(
        trajectory.action_goal.md5(),
        "cff5c1d533bf2f82dd0138d57f4304bb"
    );
    assert_eq!(
        trajectory.action_result.md5(),
        "c4fb3b000dc9da4fd99699380efcc5d9"
    );
    assert_eq!(
        trajectory.action_feedback.md5(),
        "d8920dc4eae9fc107e00999cce4be641"
    );
    let gripper = carried
        .action("control_msgs/GripperCommandAction")
        .expect("the action");
    assert_eq!(
        gripper.action_goal.md5(),
        "aa581f648a35ed681db2ec0bf7a82bea"
    );
    let head = carried
        .action("control_msgs/PointHeadAction")
        .expect("the action");
    assert_eq!(head.action_goal.md5(), "b53a8323d0ba7b310ba17a2d3a82a6b8");
}
