use super::*;
use ztl_tests::garbage::Garbage;

/// The doubts about a script that can be played, as they are shown.
#[track_caller]
fn doubts(file: &str) -> (Script, Vec<String>) {
    let (script, findings) = Script::examine("f", file.as_bytes(), Defaults::default());
    assert!(findings.iter().all(Finding::is_doubt), "{findings:?}");
    let doubts = findings.iter().map(ToString::to_string).collect();
    (script.expect("a script"), doubts)
}

#[test]
fn no_input_makes_the_reader_panic() {
    let mut numbers = Garbage::new(0x2545_f491_4f6c_dd1d);
    let rounds = std::env::var("ZTL_ROUNDS")
        .ok()
        .and_then(|n| n.parse().ok());
    for _ in 0..rounds.unwrap_or(10_000) {
        let mut bytes = b"s: {a(delay=1;x): {r(".to_vec();
        let rest = numbers.bytes();
        let from = numbers.below(bytes.len() + 1);
        bytes.truncate(from);
        bytes.extend(rest);
        let (script, findings) = Script::examine("f", &bytes, Defaults::default());
        let placed = |finding: &Finding| finding.to_string().starts_with("f:");
        assert!(findings.iter().all(placed), "{bytes:?}");
        if let Some(script) = script {
            assert_eq!(script.outline().scenes.len(), script.scenes.len());
        }
    }
}

#[test]
fn parameters_take_blanks_and_semicolons() {
    let file = b"s: {step(wait = False; delay = 2.5): {h: {c (delay=.5): 1}}, t(on_failure=go on;parallel;timeout=0): {h: {c: 1}}}";
    let script = Script::read(
        "f",
        file,
        Defaults {
            timeout: Some(std::time::Duration::from_secs(9)),
            ..Defaults::default()
        },
    );
    let script = script.expect("a script");
    let [one, other] = script.scenes[0].steps.as_slice() else {
        panic!("{script:?}")
    };
    assert_eq!(
        (one.wait, one.delay.as_millis(), one.parallel),
        (false, 2500, false)
    );
    assert_eq!(
        (
            one.tasks[0].delay.as_millis(),
            one.tasks[0].limit.map(|limit| limit.as_secs())
        ),
        (500, Some(9))
    );
    assert_eq!(
        (other.parallel, other.on_failure, other.tasks[0].limit),
        (true, OnFailure::GoOn, None)
    );
}

#[test]
fn mistakes_in_a_replaced_entry_are_doubts() {
    let (script, doubts) = doubts("s: {a: {h: {c(delay=soon): no}}, a: {h: {c: 1}}}");
    assert_eq!(doubts.len(), 3, "{doubts:?}");
    assert!(
        doubts[0].starts_with("f:1:21: 'soon' is not a number of seconds"),
        "{doubts:?}"
    );
    assert_eq!(script.scenes[0].steps[0].tasks[0].goal, "1");
}

#[test]
fn aliases_cannot_expand_without_limit() {
    let mut laughs =
        "s: {a: {h: {c: 1}}}\na0: &a0 {h: {x: [x, x, x, x, x, x, x, x, x, x]}}\n".to_owned();
    for level in 1..12 {
        let below = format!("*a{}, ", level - 1).repeat(10);
        laughs += &format!("a{level}: &a{level} {{h: {{x: [{below}]}}}}\n");
    }
    let mistakes = Script::read("f", laughs.as_bytes(), Defaults::default()).expect_err("too much");
    assert!(
        mistakes.to_string().contains("more than 100000 values"),
        "{mistakes}"
    );
}

#[test]
fn wrong_parentheses_are_doubtful() {
    let (_, doubts) = doubts("s: {t（wait=no）: {h: {c(delay=1, wait=no): 1}}}");
    assert!(
        doubts[0].contains("f:1:5: these are not the parentheses"),
        "{doubts:?}"
    );
    assert!(doubts[1].contains("within { } write ';'"), "{doubts:?}");
}

#[test]
fn scenes_or_steps_that_differ_only_in_parameters_are_doubtful() {
    let (script, doubts) = doubts(
        "a(delay=1): {s: {h: {c: 1}}}\na:\n  s(wait=no): {h: {c: 1}}\n  t: {h: {c(delay=1): 1, c: 2}}\n  's ': {h: {c: 1}}\n",
    );
    assert_eq!((script.scenes.len(), script.scenes[1].steps.len()), (2, 3));
    assert_eq!(doubts.len(), 2, "{doubts:?}");
    for (doubt, start) in doubts.iter().zip([
        "f:2:1: the scene in line 1 is named 'a', too: both are played",
        "f:5:3: the step in line 3 is named 's', too: both are played",
    ]) {
        assert!(doubt.starts_with(start), "{doubt}");
    }
}

/// What is said about a step with this parameter.
#[track_caller]
fn said_of(parameter: &str) -> Vec<String> {
    let file = format!("s: {{a ({parameter}): {{h: {{c: 1}}}}}}");
    let (_, findings) = Script::examine("f", file.as_bytes(), Defaults::default());
    let mistaken = findings.iter().any(|finding| !finding.is_doubt());
    let played = Script::read("f", file.as_bytes(), Defaults::default()).is_ok();
    assert_eq!(played, !mistaken, "{parameter}: {findings:?}");
    findings.iter().map(ToString::to_string).collect()
}

#[test]
fn a_retry_count_is_a_whole_number_from_1_to_100() {
    for count in ["1", "2", "007", "100"] {
        let said = said_of(&format!("on_failure=retry {count}"));
        assert_eq!(said, [""; 0], "{count}");
    }
    for count in [
        "-5",
        "-1",
        "- 1",
        "0",
        "101",
        "4294967297",
        "1.5",
        "+2",
        "two",
        "2 3",
        "_2",
        "٣",
    ] {
        let said = said_of(&format!("on_failure=retry {count}"));
        let rule = "a number of retries is a whole number from 1 to 100; write retry 2";
        let wrong = format!("f:1:19: '{count}': {rule}");
        assert!(
            matches!(&said[..], [said] if said.starts_with(&wrong)),
            "{said:?}"
        );
    }
    for other in ["retry-5", "retry_5", "-retry 5", "go--on", "-ask"] {
        let said = said_of(&format!("on_failure={other}"));
        let wrong = format!("f:1:19: '{other}' is not known here");
        assert!(
            matches!(&said[..], [said] if said.starts_with(&wrong)),
            "{said:?}"
        );
    }
    for known in ["retry", "go on", "go-on", "Go_On", "ask", "stop"] {
        assert_eq!(said_of(&format!("on_failure={known}")), [""; 0], "{known}");
    }
}

#[test]
fn a_time_that_is_rounded_to_nothing_is_found() {
    for time in ["1e-9", "1e-10", "1e-300", "0.0009"] {
        let said = said_of(&format!("timeout={time}"));
        let wrong = format!("f:1:16: '{time}' seconds are less than a millisecond");
        assert!(
            matches!(&said[..], [said] if said.starts_with(&wrong)),
            "{said:?}"
        );
        // The original plays it without a delay.
        let said = said_of(&format!("delay={time}"));
        let doubt = "f:1:8: this waits less than a millisecond";
        assert!(
            matches!(&said[..], [said] if said.starts_with(doubt)),
            "{said:?}"
        );
    }
    for time in ["timeout=0.001", "delay=0.001", "delay=0", "timeout=none"] {
        assert_eq!(said_of(time), [""; 0], "{time}");
    }
}

#[test]
fn cues_are_read_as_steps_and_are_no_scene() {
    let file = "a(operator_gone=stop 20): {s: {h: {c: 1}}}\ncues:\n  wave (key=W, operator_gone=go on): {h(remote=r): {arm: up, eye(timeout=3): on}}\n  plain: {h: {c: 2}}\ncues (delay=1): {s: {h: {c: 1}}}\n";
    let (script, doubts) = doubts(file);
    assert_eq!(doubts.len(), 1, "{doubts:?}");
    assert!(doubts[0].contains("True"), "{doubts:?}");
    let names: Vec<_> = script
        .scenes
        .iter()
        .map(|scene| scene.name.trim())
        .collect();
    assert_eq!(names, ["a", "cues"], "with parameters it is a scene");
    let gone = OperatorGone::Stop(std::time::Duration::from_secs(20));
    assert_eq!(script.scenes[0].operator_gone, gone);
    let [wave, plain] = script.cues.as_slice() else {
        panic!("{script:?}")
    };
    assert_eq!((wave.key, plain.key), (Some('w'), None));
    assert_eq!(wave.step.tasks.len(), 2);
    assert_eq!(
        wave.step.tasks[1].limit.map(|limit| limit.as_secs()),
        Some(3)
    );
    assert_eq!(script.remotes(), ["h", "r"]);
    assert_eq!(script.outline().cues[0].name, "wave");
}

#[test]
fn mistakes_and_doubts_in_cues_have_their_places() {
    let file = "s: {a: {h: {c: 1}}}\ncues: {a(key=ab): {h: {c: 1}}, b(key=x): {h: {c(delay=2): 1}}, c(key=X): {h: {c: 1}}, d(wait=no): {h: {c: 1}}, e(operator_gone=stop 2): {h: {c: 1}}, f: 7}";
    let (_, findings) = Script::examine("f", file.as_bytes(), Defaults::default());
    let said: Vec<String> = findings.iter().map(ToString::to_string).collect();
    for (said, wanted) in said.iter().zip([
        "f:2:14: 'ab' is not a key of a cue",
        "f:2:47: a cue starts its tasks at once",
        "f:2:64: the cue in line 2 has the same key",
        "f:2:89: a cue has no parameter 'wait'",
        "f:2:128: 'stop 2' is not known here; write go on, or stop 10",
        "f:2:153: cue 'f' is a mapping of handlers",
    ]) {
        assert!(said.starts_with(wanted), "{wanted}: {said}");
    }
    assert_eq!(said.len(), 6, "{said:?}");
}
