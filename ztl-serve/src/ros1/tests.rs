//! Files with and without mistakes, and the messages that goals make.

use std::any::Any;
use std::path::Path;
use std::sync::Arc;

use ztl_core::TaskId;
use ztl_ros1::message::{Definitions, Value};
use ztl_std::describe::CheckGoal;
use ztl_yaml::Document;

use super::action::Action;
use crate::Config;
use crate::call::Call;
use crate::component_config::ComponentConfig;

fn parse(text: &str) -> Result<Config, String> {
    let document = Document::parse("robot.yaml", text.as_bytes()).expect("YAML");
    Config::read(&document, Path::new("/")).map_err(|mistakes| {
        let sentences = mistakes.iter().map(|mistake| mistake.sentence());
        sentences.collect::<Vec<_>>().join("\n")
    })
}

/// The only component of a file.
#[track_caller]
pub(super) fn component(text: &str) -> Arc<ComponentConfig> {
    let config = parse(&format!("scopes: {{/r: {{h: {{c: {text}}}}}}}"));
    let config = config.unwrap_or_else(|mistakes| panic!("{mistakes}"));
    let scope = config.scopes.first().expect("a scope");
    let component = scope.configs().next().expect("a component");
    Arc::clone(component.2)
}

/// The mistakes of a component, each without the file's name.
fn said(text: &str) -> Vec<String> {
    let text = format!("scopes: {{/r: {{h: {{c:\n{text}}}}}}}");
    let mistakes = parse(&text).expect_err(&text);
    let lines = mistakes.lines();
    lines.map(|line| line.replace("robot.yaml:", "")).collect()
}

pub(super) fn call(component: &ComponentConfig, goal: &str) -> Result<Call, String> {
    let needs_fields = component.kind.needs_fields();
    Ok(Call {
        id: TaskId::new(7).expect("an id"),
        scope: "/r".to_owned(),
        handler: "h".to_owned(),
        component: "c".to_owned(),
        goal: component.description.goal.check(goal, needs_fields)?,
        answer: None,
    })
}

/// The goal of actionlib that a task's goal makes.
fn goal_of(text: &str, goal: &str) -> Result<Value, String> {
    let component = component(text);
    let kind: &dyn Any = &*component.kind;
    let action = kind.downcast_ref::<Action>().expect("an action");
    let bytes = action.content(&call(&component, goal)?)?;
    let goals = action.goal_type();
    Ok(goals.decode(&bytes).expect("a goal"))
}

const TWIST: &str = "{ros1-publish: /cmd_vel, type: geometry_msgs/Twist, ";

#[test]
fn every_mistake_in_a_message_has_its_place() {
    for (text, expected) in [
        (
            "message: {liner: {x: 1}}}",
            "2:63: geometry_msgs/Twist has no field 'liner'; did you mean 'linear'?",
        ),
        (
            "message: {linear: {q: 1}}}",
            "2:72: geometry_msgs/Vector3 has no field 'q'; there are: x, y, z",
        ),
        (
            "message: {linear: {x: fast}}}",
            "2:75: 'fast' is not float64",
        ),
        (
            "message: {linear: 3}}",
            "2:71: found a single value; expected a mapping: the fields of geometry_msgs/Vector3: x, y, z",
        ),
        (
            "message: {linear: {x: [1]}}}",
            "2:75: found a list; expected float64",
        ),
        (
            "message: {linear: {x: '{gaol}'}}}",
            "2:75: unknown placeholder '{gaol}'; did you mean '{goal}'?",
        ),
        (
            "message: {linear: {x: 'v{goal}'}}}",
            "2:75: only a text has words beside a placeholder; float64 takes '{goal}' alone",
        ),
        (
            "goal: text, message: {linear: {x: '{goal}'}}}",
            "2:87: the goal does not fit: it is a text, and float64 is needed",
        ),
        (
            "goal: {fields: {x: number}}, message: {linear: {x: '{goal.y}'}}}",
            "2:104: no goal has 'y': it is {x: a number}",
        ),
        (
            "goal: {fields: {x: text}}, message: {linear: '{goal}'}}",
            "2:98: the goal does not fit: x: it is a text, and float64 is needed",
        ),
        (
            "for: soon}",
            "2:58: 'soon' is not a time, as 30 s, 300 ms or 5 min",
        ),
        (
            "rate: 10 Hz, dead-man: 50 ms}",
            "2:76: this must be at least 200 ms, the time of two messages",
        ),
        (
            "dead-man: 1 s}",
            "2:63: dead-man has an effect only with a rate",
        ),
        (
            "stop: {linear: {w: 0}}}",
            "2:69: geometry_msgs/Vector3 has no field 'w'; there are: x, y, z",
        ),
    ] {
        let all = said(&format!("{TWIST}{text}"));
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        // Of a key that is wrong twice only the first is compared.
        assert_eq!(all.first(), Some(&expected), "{text}");
    }
}

#[test]
fn numbers_out_of_range_and_arrays_of_a_wrong_length_are_mistakes() {
    for (name, message, expected) in [
        (
            "std_msgs/UInt8",
            "{data: 256}",
            "'256' is not uint8, a whole number from 0 to 255",
        ),
        (
            "std_msgs/UInt8",
            "{data: -1}",
            "'-1' is not uint8, a whole number from 0 to 255",
        ),
        (
            "std_msgs/Int32",
            "{data: 1.5}",
            "'1.5' is not int32, a whole number from -2147483648 to 2147483647",
        ),
        (
            "std_msgs/Bool",
            "{data: 2}",
            "'2' is not bool: true or false",
        ),
        ("std_msgs/Float32", "{data: 1e39}", "'1e39' is not float32"),
        (
            "std_msgs/Duration",
            "{data: soon}",
            "'soon' is not duration: seconds, or as 500 ms",
        ),
        (
            "std_msgs/Time",
            "{data: -1}",
            "'-1' is not time: now, or seconds",
        ),
        (
            "geometry_msgs/PoseWithCovariance",
            "{covariance: [1, 2]}",
            "found 2 values; float64[36] has 36",
        ),
    ] {
        let all = said(&format!(
            "{{ros1-publish: /t, type: {name}, message: {message}}}"
        ));
        let first = all.first().expect("a mistake");
        assert!(first.ends_with(expected), "{name} {message}: {first}");
    }
    for (goal, field, expected) in [
        (
            "{type: number}",
            "std_msgs/Int32",
            "int32 takes whole numbers; write type: whole",
        ),
        (
            "{type: whole, least: 0, most: 300}",
            "std_msgs/UInt8",
            "it may be 300, and uint8 takes 0 to 255",
        ),
        (
            "nothing",
            "std_msgs/String",
            "it is nothing, and string is needed",
        ),
        (
            "{list-of: number}",
            "std_msgs/Float64",
            "it is a list, each a number, and float64 is needed",
        ),
    ] {
        let all = said(&format!(
            "{{ros1-publish: /t, type: {field}, goal: {goal}, message: {{data: '{{goal}}'}}}}"
        ));
        let first = all.first().expect("a mistake");
        assert!(first.contains("the goal does not fit: "), "{goal}: {first}");
        assert!(first.ends_with(expected), "{goal}: {first}");
    }
}

#[test]
fn wrong_types_names_and_keys_are_mistakes() {
    for (text, expected) in [
        (
            "{ros1-action: /test, type: actionlib/Test}",
            "2:28: there is no definition of actionlib/Test; did you mean 'actionlib/TestAction'?",
        ),
        (
            "{ros1-publish: /cmd_vel, type: geometry_msgs/Twits}",
            "2:32: there is no definition of geometry_msgs/Twits; did you mean 'geometry_msgs/Twist'?",
        ),
        (
            "{ros1-action: /test, type: geometry_msgs/Twist}",
            "2:28: geometry_msgs/Twist is the type of a message; expected that of an action; write the type as move_base_msgs/MoveBaseAction",
        ),
        (
            "{ros1-publish: /dock, type: std_srvs/Trigger}",
            "2:29: std_srvs/Trigger is the type of a service; expected that of a message; write the type as geometry_msgs/Twist",
        ),
        (
            "{ros1-publish: /cmd_vel, type: Twist}",
            "2:32: 'Twist' is not a type, as geometry_msgs/Twist",
        ),
        (
            "{ros1-publish: /cmd_vel, type: geometry_msgs/msg/Twist}",
            "2:32: 'geometry_msgs/msg/Twist' is not a type, as geometry_msgs/Twist; in ROS 1, it is geometry_msgs/Twist",
        ),
        (
            "{ros1-action: /move, type: control_msgs/action/PointHead}",
            "2:28: 'control_msgs/action/PointHead' is not a type, as geometry_msgs/Twist; in ROS 1, it is control_msgs/PointHeadAction",
        ),
        (
            "{ros1-publish: /cmd vel, type: geometry_msgs/Twist}",
            "2:16: '/cmd vel' is not a name in ROS, as /cmd_vel",
        ),
        (
            "{ros1-publish: 0/cmd, type: geometry_msgs/Twist}",
            "2:16: '0/cmd' is not a name in ROS, as /cmd_vel",
        ),
        (
            "{ros1-publish: /motor/0/_cmd, type: Twist}",
            "2:37: 'Twist' is not a type, as geometry_msgs/Twist",
        ),
        (
            "{ros1-service: /dock}",
            "2:1: 'type' is missing; write type: std_srvs/Trigger",
        ),
        (
            "{ros1-service: /dock, type: std_srvs/Trigger, result: '{response.mesage}'}",
            "2:55: std_srvs/TriggerResponse has no field 'mesage'; did you mean 'message'?",
        ),
        (
            "{ros1-action: /test, type: actionlib/TestAction, progress: '{result.result}'}",
            "2:60: unknown placeholder '{result.result}'; write '{feedback}' or '{feedback.x}'",
        ),
        (
            "{ros1-action: /test, type: actionlib/TestAction, joints: [a]}",
            "2:58: joints has an effect only with type: control_msgs/FollowJointTrajectoryAction, without message",
        ),
        (
            "{ros1-trajectory: /arm/command, joints: [a, b], poses: {home: [0, 1, 2]}}",
            "2:63: found 3 positions; there are 2 joints",
        ),
        (
            "{ros1-trajectory: /arm/command, joints: [a, a]}",
            "2:45: the joint a is there twice",
        ),
        (
            "{ros1-trajectory: /arm/command, joints: [a], tolerance: 0}",
            "2:57: '0' is not a tolerance in rad or m from 0.0001 to 10, as 0.05",
        ),
        (
            "{ros1-parameter: /a b}",
            "2:18: '/a b' is not a name in ROS, as /robot_description",
        ),
    ] {
        let all = said(text);
        assert_eq!(all.first().map(String::as_str), Some(expected), "{text}");
    }
    let mistakes =
        parse("ros1: {master: 'localhost:11311', host: 'a b', x: 1}\nscopes: {/r: {h: {c: echo}}}");
    let mistakes = mistakes.expect_err("three mistakes");
    assert_eq!(mistakes.lines().count(), 3, "{mistakes}");
}

#[test]
fn goals_fill_messages_by_name_and_type() {
    let test = "{ros1-action: /test, type: actionlib/TestAction, message: {goal: '{goal}'}}";
    let goal = goal_of(test, "5").expect("a goal");
    assert_eq!(goal.field("goal"), Some(&Value::Signed(5)));
    let error = goal_of(test, "five").expect_err("a word");
    assert_eq!(
        error,
        "the goal 'five' is not a whole number from -2147483648 to 2147483647"
    );
    // Without a message, the goal is the message, or its only field.
    let plain = "{ros1-action: /test, type: actionlib/TestAction}";
    assert_eq!(
        goal_of(plain, "-1").expect("a goal").field("goal"),
        Some(&Value::Signed(-1))
    );
    let head = "{ros1-action: /head, type: control_msgs/PointHeadAction, message: \
                {target: {header: {frame_id: base_link, stamp: now}, point: '{goal.point}'}, min_duration: 500 ms, \
                max_velocity: .inf, pointing_frame: 'camera_{handler}_{goal.side}'}}";
    let goal = goal_of(head, "{point: {x: 1, z: 2.5}, side: left}").expect("a goal");
    assert_eq!(goal.at("target.point.x"), Some(&Value::Float(1.0)));
    assert_eq!(goal.at("target.point.y"), Some(&Value::Float(0.0)));
    assert_eq!(goal.at("target.point.z"), Some(&Value::Float(2.5)));
    assert!(matches!(
        goal.at("target.header.stamp"),
        Some(Value::Time { secs: 1.., .. })
    ));
    let half = Value::Duration {
        secs: 0,
        nsecs: 500_000_000,
    };
    assert_eq!(goal.field("min_duration"), Some(&half));
    assert_eq!(
        goal.field("max_velocity"),
        Some(&Value::Float(f64::INFINITY))
    );
    assert_eq!(
        goal.at("pointing_frame").and_then(Value::as_text),
        Some("camera_h_left")
    );
    for (text, expected) in [
        (
            "{point: {x: far}, side: left}",
            "goal.point.x: 'far' is not float64",
        ),
        (
            "{point: {q: 1}, side: left}",
            "goal.point: geometry_msgs/Point has no field 'q'",
        ),
        (
            "{point: {x: inf}, side: left}",
            "goal.point.x: 'inf' is not float64",
        ),
        (
            "{point: 5, side: left}",
            "goal.point: '5' is not geometry_msgs/Point",
        ),
    ] {
        let error = goal_of(head, text).expect_err(text);
        assert!(
            error.contains(expected) || error.contains("point is not"),
            "{text}: {error}"
        );
    }
    assert!(
        goal_of(head, "{side: left}")
            .expect_err("no point")
            .contains("point is missing")
    );
}

#[test]
fn a_constant_of_the_type_may_be_written_by_its_name() {
    let status = |word: &str| {
        format!(
            "{{ros1-publish: /t, type: actionlib_msgs/GoalStatus, message: {{status: {word}}}}}"
        )
    };
    component(&status("SUCCEEDED"));
    let all = said(&status("SUCCESS"));
    assert!(
        all.first()
            .is_some_and(|first| first.contains("'SUCCESS' is not uint8")),
        "{all:?}"
    );
}

#[test]
fn the_short_forms_make_the_whole_goals() {
    let arm = "{ros1-action: /arm, type: control_msgs/FollowJointTrajectoryAction, joints: [shoulder, elbow]}";
    let goal = goal_of(arm, "{positions: [1, -0.5], seconds: 2.5}").expect("a goal");
    let names = goal.at("trajectory.joint_names").expect("names").items();
    assert_eq!(
        names,
        ["shoulder", "elbow"].map(|name| Value::Text(name.to_owned()))
    );
    let positions = goal
        .at("trajectory.points.0.positions")
        .expect("positions")
        .items();
    assert_eq!(positions, [1.0, -0.5].map(Value::Float));
    let time = Value::Duration {
        secs: 2,
        nsecs: 500_000_000,
    };
    assert_eq!(goal.at("trajectory.points.0.time_from_start"), Some(&time));
    let default = goal_of(arm, "{positions: [0, 0]}").expect("a goal");
    let time = Value::Duration { secs: 3, nsecs: 0 };
    assert_eq!(
        default.at("trajectory.points.0.time_from_start"),
        Some(&time)
    );
    let error = goal_of(arm, "{positions: [0]}").expect_err("one position");
    assert_eq!(
        error,
        "the goal has 1 positions; 2 are needed: shoulder, elbow"
    );
    for wrong in [
        "{positions: [0, nan]}",
        "{positions: [0, inf]}",
        "{positions: [0, 0], seconds: 0}",
        "5",
    ] {
        goal_of(arm, wrong).expect_err(wrong);
    }
    let poses = "{ros1-action: /arm, type: control_msgs/FollowJointTrajectoryAction, joints: [a, b], poses: {tucked: [1.5, 0]}, time: 500 ms}";
    let goal = goal_of(poses, "tucked").expect("a goal");
    assert_eq!(
        goal.at("trajectory.points.0.positions.0"),
        Some(&Value::Float(1.5))
    );
    assert_eq!(
        goal_of(poses, "home").expect_err("no pose"),
        "the goal 'home' is not tucked"
    );
    let base = "{ros1-action: /move_base, type: move_base_msgs/MoveBaseAction}";
    let goal = goal_of(base, "{x: 1, y: -2, yaw: 3.141592653589793}").expect("a goal");
    assert_eq!(
        goal.at("target_pose.header.frame_id")
            .and_then(Value::as_text),
        Some("map")
    );
    assert_eq!(
        goal.at("target_pose.pose.position.y"),
        Some(&Value::Float(-2.0))
    );
    assert_eq!(
        goal.at("target_pose.pose.orientation.z"),
        Some(&Value::Float(1.0))
    );
    let straight = goal_of(base, "{x: 0, y: 0}").expect("a goal");
    assert_eq!(
        straight.at("target_pose.pose.orientation.w"),
        Some(&Value::Float(1.0))
    );
}

#[test]
fn a_message_without_fields_needs_no_goal() {
    let dock = component("{ros1-service: /dock, type: std_srvs/Trigger}");
    for goal in ["", "None"] {
        let call = call(&dock, goal).expect("nothing");
        assert_eq!(dock.kind.check(&call), Ok(()));
    }
    call(&dock, "now").expect_err("a goal is not used");
}

#[test]
fn a_description_has_the_rule_of_the_message() {
    for (text, expected) in [
        (
            "{ros1-action: /t, type: actionlib/TestAction}",
            "a whole number from -2147483648 to 2147483647",
        ),
        ("{ros1-service: /dock, type: std_srvs/Trigger}", "nothing"),
        (
            "{ros1-service: /light, type: std_srvs/SetBool}",
            "True or False",
        ),
        (
            "{ros1-publish: /cmd_vel, type: geometry_msgs/Twist, message: {linear: {x: '{goal.speed}'}}, for: '{goal.seconds}'}",
            "{speed: a number, seconds: a number from 0 to 86400 s}",
        ),
        (
            "{ros1-publish: /cmd_vel, type: geometry_msgs/Twist, message: {}, for: 1 s}",
            "nothing",
        ),
        (
            "{ros1-trajectory: /arm/command, joints: [a], poses: {home: [0], up: [1]}}",
            "home or up",
        ),
        ("{ros1-parameter: /robot_name}", "nothing"),
    ] {
        assert_eq!(
            component(text).description.goal.to_string(),
            expected,
            "{text}"
        );
    }
}

#[test]
fn topics_are_streams_with_their_messages_as_frames() {
    let of = |stream: &str| parse(&format!("publish: 1\nstreams: {{/r: {{s: {stream}}}}}"));
    for (stream, framing) in [
        (
            "{ros1-topic: /joint_states, type: sensor_msgs/JointState}",
            "Json",
        ),
        (
            "{ros1-topic: /battery, type: sensor_msgs/BatteryState, field: percentage, latest: true}",
            "Json",
        ),
        (
            "{ros1-topic: /camera, type: sensor_msgs/CompressedImage, field: data, rate: 5 Hz, when-watched: 2 s}",
            "Length",
        ),
    ] {
        let config = of(stream).expect(stream);
        let stream = config.streams.first().expect("a stream");
        assert_eq!(format!("{:?}", stream.framing), framing);
    }
    for (stream, expected) in [
        (
            "{ros1-topic: /battery, type: sensor_msgs/BatteryState, field: percent}",
            "sensor_msgs/BatteryState has no field 'percent'; did you mean 'present'?",
        ),
        (
            "{ros1-topic: /battery, type: sensor_msgs/BatteryState, frame: json}",
            "each message is a frame; leave this out",
        ),
        (
            "{ros1-topic: /battery}",
            "'type' is missing; write type: sensor_msgs/JointState",
        ),
        (
            "{ros1-topic: /battery, type: std_msgs/Int32, run: [x]}",
            "unknown key 'run'",
        ),
    ] {
        let mistakes = of(stream).expect_err(stream);
        assert!(mistakes.contains(expected), "{stream}: {mistakes}");
    }
}

#[test]
fn any_yaml_for_a_message_is_read_or_is_a_mistake() {
    let mut random = ztl_tests::lab::Random::new(ztl_tests::lab::seed());
    let values = [
        "1",
        "-1",
        "1e400",
        "{}",
        "[]",
        "[1, 2]",
        "'{goal}'",
        "'{goal.x}'",
        "~",
        "''",
        "now",
        "{secs: 1}",
        "{secs: x}",
        "x",
        "{x: {y: [1]}}",
        "'a{goal}'",
    ];
    let mut definitions = Definitions::of_this_machine();
    let names = definitions.message_names();
    for _ in 0..150 {
        let name = &names[random.below(names.len())];
        let message = definitions.message(name).expect(name);
        let fields = message.fields().iter();
        let fields = fields.map(|field| format!("{}: {}", field.name, random.pick(&values)));
        let fields = fields.collect::<Vec<_>>().join(", ");
        let text = format!(
            "scopes: {{/r: {{h: {{c: {{ros1-publish: /t, type: {name}, message: {{{fields}}}}}}}}}}}"
        );
        match parse(&text) {
            Err(mistakes) => assert!(!mistakes.is_empty()),
            Ok(config) => {
                let scope = config.scopes.first().expect("a scope");
                let component = scope.configs().next().expect("a component").2;
                for goal in ["5", "{x: 1}", "[1, 2, 3]", "", "word", "{x: {x: {}}}"] {
                    if let Ok(call) = call(component, goal) {
                        let _ = component.kind.check(&call);
                    }
                }
            }
        }
    }
}
