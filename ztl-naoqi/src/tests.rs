//! Values from bytes and back, and the arguments of calls.

use super::*;

fn signature(text: &str) -> Signature {
    Signature::parse(text, 32).expect(text)
}

fn value(goal: &str) -> Value {
    ztl_core::goal::from_str(goal).expect(goal)
}

fn values(goal: &str) -> Vec<Value> {
    match value(goal) {
        Value::List(items) => items,
        _ => panic!("{goal} is not a list"),
    }
}

fn method(id: u32, name: &str, parameters: &str) -> Method {
    Method {
        id,
        name: name.to_owned(),
        parameters: parameters.to_owned(),
        returns: "v".to_owned(),
    }
}

fn motion() -> MetaObject {
    MetaObject {
        methods: vec![
            method(2, "metaObject", "(I)"),
            method(100, "angleInterpolation", "([s][f][f]b)"),
            method(101, "moveTo", "(fff)"),
            method(102, "moveTo", "(fff[(sf)<Setting,name,value>])"),
            method(103, "wakeUp", "()"),
            method(104, "odd", "(s*)"),
            method(105, "setAngles", "(sff)"),
            method(106, "setAngles", "(mmf)"),
            method(107, "any", "m"),
            method(108, "post", "({sm}wC)"),
        ],
        ..MetaObject::default()
    }
}

#[track_caller]
fn refused(name: &str, arguments: &str) -> String {
    let error = motion()
        .check("ALMotion", name, &values(arguments))
        .unwrap_err();
    error.to_string()
}

#[test]
fn arguments_are_written_in_the_types_of_the_signature() {
    let motion = motion();
    let arguments = values("[[HeadYaw], [0.5, 1], [2.0, 3.0], true]");
    let fitted = motion
        .fit("ALMotion", "angleInterpolation", &arguments)
        .unwrap();
    let names = b"\x01\0\0\0\x07\0\0\0HeadYaw".as_slice();
    let angles = b"\x02\0\0\0\0\0\0\x3f\0\0\x80\x3f".as_slice();
    let times = b"\x02\0\0\0\0\0\0\x40\0\0\x40\x40".as_slice();
    assert_eq!(fitted.payload, [names, angles, times, b"\x01"].concat());
}

#[test]
fn a_wrong_argument_is_named() {
    for (name, arguments, expected) in [
        (
            "angleInterpolation",
            "[[HeadYaw], 0.5, [1.0], true]",
            "argument 2 of ALMotion.angleInterpolation must be a list of numbers, not a number",
        ),
        (
            "angleInterpolation",
            "[[HeadYaw], [0.5, up], [1.0], true]",
            "argument 2 of ALMotion.angleInterpolation at [1]: must be a number, not a text",
        ),
        (
            "angleInterpolation",
            "[a]",
            "ALMotion.angleInterpolation takes 4 arguments, not 1",
        ),
        (
            "moveTo",
            "[1, 2]",
            "ALMotion.moveTo does not take these arguments, but (fff) or (fff[(sf)<Setting,name,value>])",
        ),
        (
            "moveTo::(fff)",
            "[1, 2, 1e60]",
            "argument 3 of ALMotion.moveTo::(fff) must be a number of 32 bits, not 1000000000000000000000000000000000000000000000000000000000000",
        ),
        (
            "post",
            "[{a: 1}, 40000, 1]",
            "argument 2 of ALMotion.post must be an integer from -32768 to 32767, not 40000",
        ),
        (
            "post",
            "[{1: 1}, 4, 1]",
            "argument 1 of ALMotion.post at 1: must be a text, not an integer",
        ),
        (
            "odd",
            "[a, b]",
            "the signature of ALMotion.odd cannot be read: \"(s*)\", byte 2: expected a type",
        ),
        (
            "fly",
            "[]",
            "no method ALMotion.fly; there are: angleInterpolation, any, moveTo, odd, post, setAngles, wakeUp",
        ),
    ] {
        assert_eq!(refused(name, arguments), expected);
    }
}

#[test]
fn the_nearest_overload_is_chosen() {
    let motion = motion();
    for (name, arguments, id) in [
        ("moveTo", "[1, 0, 0.5]", 101),
        (
            "moveTo",
            "[1, 0, 0.5, [[a, 1.0], {name: b, value: 2}]]",
            102,
        ),
        ("setAngles", "[HeadYaw, 0.5, 0.1]", 105),
        ("setAngles", "[[HeadYaw], [0.5], 0.1]", 106),
        ("any", "[1, two, [3]]", 107),
    ] {
        let arguments = values(arguments);
        let fitted = motion.fit("ALMotion", name, &arguments).expect(name);
        assert_eq!(fitted.method.id, id, "{name}");
    }
}

/// What a dynamic value is after the way there and back.
#[track_caller]
fn there_and_back(goal: &str) -> String {
    let mut bytes = Vec::new();
    encode::encode(&value(goal), &Signature::Dynamic, &mut bytes).expect(goal);
    let back = decode(&bytes, &Signature::Dynamic, &Limits::default()).expect(goal);
    back.to_string()
}

#[test]
fn a_dynamic_value_is_read_back_as_it_was() {
    for goal in [
        "None",
        "True",
        "-7",
        "18446744073709551615",
        "0.1",
        "hello",
        "[1, 'two', [3.0, None]]",
        "{'a': {'b': [1]}, 2: False}",
    ] {
        assert_eq!(there_and_back(goal), goal);
    }
}

#[test]
fn names_of_fields_are_shown() {
    let point = signature("(sf)<Touch,part,force>");
    let read = decode(b"\x04\0\0\0Head\0\0\x80\x3e", &point, &Limits::default()).unwrap();
    assert_eq!(read.to_string(), "{'part': 'Head', 'force': 0.25}");
}

#[track_caller]
fn unreadable(bytes: &[u8], text: &str) -> String {
    let error = decode(bytes, &signature(text), &Limits::default()).unwrap_err();
    error.to_string()
}

#[test]
fn hostile_values_are_errors_in_bounded_memory() {
    assert_eq!(
        unreadable(b"\x05\0\0\0hell", "s"),
        "it ends within a value, at byte 8"
    );
    assert_eq!(unreadable(b"\x01\x02", "b"), "1 bytes follow the value");
    let many = "it contains more than 68 values";
    assert_eq!(unreadable(b"\xff\xff\xff\xff", "[v]"), many);
    assert_eq!(unreadable(b"\xff\xff\xff\xff", "{sm}"), many);
    let error = "the signature at byte 0 is malformed: byte 1: expected a type";
    assert_eq!(unreadable(b"\x02\0\0\0[?", "m"), error);
    assert_eq!(
        unreadable(b"", "X"),
        "it contains a value of an unknown type"
    );
    let nested = b"\x01\0\0\0m".repeat(40);
    let error = unreadable(&nested, "m");
    assert!(
        error.ends_with("expected fewer levels") || error == "it is nested too deep",
        "{error}"
    );
    let long = [b"\x01\x20\0\0".as_slice(), &[b'v'; 8193]].concat();
    assert_eq!(
        unreadable(&long, "m"),
        "it contains a signature that is too long"
    );
}

#[test]
fn a_method_says_the_types_of_its_arguments() {
    let say = method(100, "say", "(s)").arguments().unwrap().unwrap();
    assert_eq!(say.fields, [Signature::Text]);
    assert_eq!(method(100, "any", "m").arguments(), Ok(None));
}
