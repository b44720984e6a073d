//! Calls: arguments by the method's signature, results and errors.

use ztl_naoqi::{Call, CallError, Value};
use ztl_tests::lab::PATIENCE;

use crate::robot::{Connected, Robot};

#[track_caller]
fn shown(result: Result<Value, CallError>) -> String {
    result.expect("a result").to_string()
}

#[test]
fn methods_of_nao_are_called_with_typed_arguments() {
    let mut robot = Robot::start(&["ALTextToSpeech", "ALMotion", "ALLeds"]);
    let nao = Connected::to(&robot);
    assert_eq!(
        nao.call("ALTextToSpeech", "say", "[hello]"),
        Ok(Value::Nothing)
    );
    robot.line_with("say hello");
    let angles = "[[HeadYaw, HeadPitch], [0.5, 1], [1.0, 2.0], true]";
    assert_eq!(
        nao.call("ALMotion", "angleInterpolation", angles),
        Ok(Value::Nothing)
    );
    robot.line_with("angles ['HeadYaw', 'HeadPitch'] [0.5, 1.0] [1.0, 2.0] True");
    assert_eq!(
        nao.call("ALMotion", "moveTo", "[1, 0, -0.5]"),
        Ok(Value::Bool(true))
    );
    robot.line_with("move 1.0 0.0 -0.5");
    assert_eq!(
        nao.call("ALMotion", "killTask", "[7]"),
        Ok(Value::Bool(true))
    );
    assert_eq!(
        shown(nao.call("ALMotion", "getAngles", "[[a, b], false]")),
        "[0.5, 0.5]"
    );
    assert_eq!(
        shown(nao.call("ALLeds", "fadeRGB", "[FaceLeds, 255, 0.5]")),
        "number 255"
    );
    assert_eq!(
        shown(nao.call("ALLeds", "fadeRGB", "[FaceLeds, red, 0.5]")),
        "name red"
    );
    assert_eq!(
        shown(nao.call("ALLeds", "anything", "[1, two]")),
        "(1, 'two')"
    );
    assert_eq!(
        shown(nao.call("ALLeds", "touch", "[]")),
        "{'part': 'Head', 'force': 0.25}"
    );
}

#[test]
fn dynamic_values_are_those_that_python_sees() {
    let robot = Robot::start(&["ALLeds"]);
    let nao = Connected::to(&robot);
    for value in [
        "7",
        "-9223372036854775808",
        "0.1",
        "True",
        "'text'",
        "[1, 'two', [3.5]]",
        "[]",
        "{'a': 1, 'b': [2]}",
    ] {
        assert_eq!(
            shown(nao.call("ALLeds", "shown", &format!("[{value}]"))),
            value
        );
        let echo = shown(nao.call("ALLeds", "echo", &format!("[[{value}]]")));
        assert_eq!(echo, format!("[{value}]"));
    }
    // What Python cannot send back.
    for value in ["None", "18446744073709551615"] {
        assert_eq!(
            shown(nao.call("ALLeds", "shown", &format!("[{value}]"))),
            value
        );
    }
}

#[test]
fn errors_say_what_is_wrong_and_whether_something_was_sent() {
    let robot = Robot::start(&["ALTextToSpeech", "ALMotion", "Odd"]);
    let nao = Connected::to(&robot);
    let error = |service: &str, method: &str, arguments: &str| {
        nao.call(service, method, arguments).expect_err(method)
    };
    let failed = error("ALTextToSpeech", "setLanguage", "[Klingon]");
    let CallError::Failed(text) = failed else {
        panic!("{failed:?}");
    };
    assert!(text.contains("language Klingon is not installed"), "{text}");
    let absent = format!("no service ALFly at {}", robot.endpoint);
    assert_eq!(error("ALFly", "fly", "[]"), CallError::NotSent(absent));
    for (arguments, expected) in [
        (
            "[[HeadYaw], 1.0, [1.0], true]",
            "argument 2 of ALMotion.angleInterpolation must be a list of numbers, not a number",
        ),
        ("[]", "ALMotion.angleInterpolation takes 4 arguments, not 0"),
    ] {
        let wrong = error("ALMotion", "angleInterpolation", arguments);
        assert!(matches!(wrong, CallError::Arguments(_)), "{wrong:?}");
        assert_eq!(wrong.to_string(), expected);
    }
    let missing = error("ALMotion", "fly", "[]").to_string();
    let expected =
        "no method ALMotion.fly; there are: angleInterpolation, getAngles, killAll, killTask";
    assert!(missing.starts_with(expected), "{missing}");
    let unknown = error("Odd", "takes", "[1]").to_string();
    let expected =
        "argument 1 of Odd.takes must be of an unknown type, which cannot be given, not an integer";
    assert_eq!(unknown, expected);
}

#[test]
fn properties_are_read_and_set() {
    let mut robot = Robot::start(&["ALMotion"]);
    let nao = Connected::to(&robot);
    let set = Call::set_property("ALMotion", "stiffness", Value::Double(0.5));
    assert_eq!(nao.client.call_and_wait(set, PATIENCE), Ok(Value::Nothing));
    robot.process.write_line("stiffness");
    robot.line_with("stiffness 0.5");
    let get = Call::property("ALMotion", "stiffness");
    assert_eq!(
        nao.client.call_and_wait(get, PATIENCE),
        Ok(Value::Float(0.5))
    );
    let get = Call::property("ALMotion", "weight");
    let error = nao.client.call_and_wait(get, PATIENCE).unwrap_err();
    assert!(matches!(error, CallError::Failed(_)), "{error:?}");
}

#[test]
fn a_service_says_what_it_is() {
    let robot = Robot::start(&["ALMotion"]);
    let nao = Connected::to(&robot);
    let motion = nao
        .client
        .describe("ALMotion", PATIENCE)
        .expect("a description");
    let move_to = motion.overloads("moveTo").next().expect("moveTo");
    assert_eq!((&*move_to.parameters, &*move_to.returns), ("(fff)", "b"));
    assert_eq!(motion.properties[0].name, "stiffness");
    let goal = [Value::Text("forward".to_owned())];
    let error = motion.check("ALMotion", "moveTo", &goal).unwrap_err();
    assert_eq!(
        error.to_string(),
        "ALMotion.moveTo takes 3 arguments, not 1"
    );
    assert!(
        nao.client
            .describe("ALFly", std::time::Duration::ZERO)
            .is_err()
    );
    let services = nao.client.services();
    assert_eq!(services, ["ALMotion", "ServiceDirectory"]);
}
