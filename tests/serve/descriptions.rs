//! What components say of themselves: `describe`.

use std::time::Duration;

use serde_json::{Value, json};
use ztl_std::describe::{GoalValue, ScopeDescriptions, parse};
use ztl_std::{ExecutableTask, TaskController, TaskError, TaskRequest, encoded};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, Random, SCOPE, Scratch, Server, busy, in_time, port_of,
    run_python, seed, serve, until, ztl,
};

use crate::rig::Rig;

const COMPONENTS: &str = "
    open: {built-in: echo, goal: {least: 0, most: 80, step: 5, unit: mm}, about: opens the gripper, examples: [40, 0x10], returns: how far it is, usually: 1500 ms}
    count: {built-in: echo, goal: {type: whole, most: 7}, streams: [/count]}
    say: {built-in: echo, goal: {type: text, longest: 5}}
    turn: {built-in: echo, goal: {one-of: [left, right]}}
    light: {built-in: echo, goal: truth}
    path: {built-in: echo, goal: {list-of: {least: -1, most: 1}}}
    pose: {built-in: echo, goal: {fields: {z: {most: 3}, a: truth, side: {one-of: [left, right], default: left}}}}
    free: echo
";

/// A value that may be a goal. Texts are words, because the server takes the goal `'5'` for a number.
fn value(random: &mut Random, depth: usize) -> Value {
    match random.below(if depth > 1 { 5 } else { 7 }) {
        0 => json!(random.pick(&[-2, -1, 0, 1, 3, 7, 8, 80, 81])),
        1 => json!(random.pick(&[-1.5, -0.25, 0.5, 2.75, 80.5, 1e9 + 0.5])),
        2 => json!(random.pick(&["left", "right", "straight", "abcde", "äöüßé"])),
        3 => json!(random.pick(&[true, false])),
        4 => json!({"z": random.pick(&[0.5, 3.5]), "a": random.pick(&[true, false])}),
        5 => {
            let items = (0..random.below(4)).map(|_| value(random, depth + 1));
            items.collect()
        }
        _ => {
            let mut map = serde_json::Map::new();
            for key in ["z", "a", "side", "more"] {
                if random.once_in(2) {
                    map.insert(key.to_owned(), value(random, depth + 1));
                }
            }
            Value::Object(map)
        }
    }
}

/// Whether the value is what JSON Schema calls it. A goal is text, so that the server also takes a number for
/// a text, and the list or mapping of a text goal.
fn is_plain(component: &str, value: &Value) -> bool {
    !matches!(component, "say" | "turn") || value.is_string()
}

#[test]
fn the_server_and_the_json_schema_take_the_same_goals() {
    let rig = Rig::new(COMPONENTS);
    let port = rig.server.port.to_string();
    let told = Process::run(ztl().args(["describe", "--json", "-p", &port]));
    let told: Value = serde_json::from_str(&told.stdout).expect("JSON");
    let components = told["components"].as_array().expect("components");
    assert_eq!(components.len(), 8, "{told}");
    let mut remote = rig.remote();
    let mut random = Random::new(seed());
    let (mut asked, mut verdicts) = (Vec::new(), Vec::new());
    for component in components {
        let name = component["component"].as_str().expect("a name");
        for _ in 0..60 {
            let value = value(&mut random, 0);
            if !is_plain(name, &value) {
                continue;
            }
            let goal: GoalValue = serde_json::from_value(value.clone()).expect("a goal");
            let goal = goal.to_text().expect("a goal");
            let question = format!("takes {}", encoded("p", name, &goal));
            let answer = remote.ask_server(&question).expect("an answer");
            let answer: Value = serde_json::from_str(&answer.expect("known")).expect("JSON");
            verdicts.push((format!("{name}:{goal}"), answer[SCOPE].is_null()));
            asked.push(json!([component["schema"], value]));
        }
    }
    let check = "import json, sys, jsonschema\n\
        print(json.dumps([jsonschema.Draft202012Validator(s).is_valid(v) for s, v in json.load(sys.stdin)]))";
    let valid = run_python(&["-c", check], &Value::from(asked).to_string());
    let valid: Vec<bool> = serde_json::from_str(&valid).expect("verdicts");
    assert_eq!(valid.len(), verdicts.len());
    for (valid, (goal, taken)) in valid.iter().zip(&verdicts) {
        assert_eq!(
            valid,
            taken,
            "JSON Schema and server, seed {}: {goal}",
            seed()
        );
    }
    for expected in [true, false] {
        assert!(valid.iter().filter(|it| **it == expected).count() > 50);
    }
}

#[test]
fn people_see_goals_and_what_they_mean() {
    let rig = Rig::new(COMPONENTS);
    let port = rig.server.port.to_string();
    let told = Process::run(ztl().args(["describe", "-p", &port])).stdout;
    for part in [
        "p:open ",
        "a number from 0 to 80 mm",
        "opens the gripper; for example 40 or 0x10; returns how far it is; usually 1s 500ms\n",
        "{z: a number of at most 3, a: True or False, side: left or right}",
    ] {
        assert!(told.contains(part), "{part}: {told}");
    }
    assert!(!told.contains("p:free"), "{told}");
    let reason = rig.rejection("open", "81");
    assert!(
        reason.contains("is not a number from 0 to 80 mm"),
        "{reason}"
    );
}

#[test]
fn hostile_descriptions_end_and_reach_no_terminal() {
    let _busy = busy();
    let probe = "$ztl;5;0;{ztl: 1, version: '0.1.0', boot: 7, scopes: {\"/lab\": {}}, running: {}}";
    let deep = format!("{}{}", "{\"list-of\": ".repeat(100), "}".repeat(100));
    let deep = deep.replace("\"list-of\": }", "\"list-of\": {}}");
    for is in [
        r#"{"goal": {"type": "number", "unit": "\u001b[2J\u0007"}, "about": "\u001b]0;x\u0007\n"}"#
            .to_owned(),
        format!("{{\"goal\": {deep}, \"about\": \"deep\"}}"),
        "[".repeat(1_000),
        "7".to_owned(),
    ] {
        // Each answer promises another one.
        let server = FakeServer::with_questions(move |request| {
            let Some((_, from)) = request.split_once("describe ;") else {
                return probe.as_bytes().to_vec();
            };
            let next = from.parse().unwrap_or(0) + 1;
            let one = format!(
                r#"{{"scope": "/lab", "handler": "a\u001b", "component": "b", "is": {is}}}"#
            );
            let many = vec![one; 600].join(", ");
            format!("$ztl;5;0;{{\"components\": [{many}], \"next\": {next}}}").into_bytes()
        });
        let port = server.port.to_string();
        for options in [&["describe"][..], &["describe", "--yaml"]] {
            let command = Process::start(ztl().args(options).args(["-p", &port]));
            // A second of computing.
            let ended = command.end(PATIENCE * 3);
            assert_eq!(ended.code, Some(0), "{}", ended.stderr);
            let control = |c: char| c.is_control() && c != '\n';
            assert!(!ended.stdout.contains(control), "{options:?}");
        }
    }
}

/// The command in a directory.
fn run(files: &Scratch, words: &str) -> Ended {
    let mut command = ztl();
    command
        .args(words.split(' '))
        .current_dir(files.path(""))
        .env("XDG_CONFIG_HOME", files.path("nothing"));
    Process::run(&mut command)
}

/// The findings of `ztl check` about a script.
fn findings(ended: &Ended) -> Vec<String> {
    let lines = ended.stdout.lines();
    let found = lines.filter_map(|line| line.strip_prefix("mistake: "));
    found.map(str::to_owned).collect()
}

#[test]
fn wrong_goals_of_a_script_are_found_with_the_server_and_without_it() {
    let rig = Rig::new(COMPONENTS);
    let files = &rig.scratch;
    let write = |name: &str, text: &str| std::fs::write(files.path(name), text).expect("a file");
    write(
        "show.yaml",
        "s:\n  a:\n    p:\n      open: 81\n      turn: left\n      path: [0, 2]\n      free: x\n  \
         b: {p: {pose: {z: 1, a: maybe}, trun: left}}\n",
    );
    let port = rig.server.port;
    let remote =
        |port: u16| format!("remotes: {{p: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n");
    write("remotes.yaml", &remote(port));
    write("moved.yaml", &remote(1));
    let port = port.to_string();
    let told = run(files, &format!("describe --json -r localhost -p {port}"));
    write("p.json", &told.stdout);
    let other = std::fs::read_to_string(files.path("p.json")).expect("a file");
    write(
        "other.json",
        &other
            .replace(&port, "2")
            .replace("\"most\":80", "\"most\":90"),
    );

    let live = run(files, "check show.yaml -c remotes.yaml --live");
    assert_eq!(
        findings(&live),
        [
            "show.yaml:4:13: server 'p': the goal '81' is not a number from 0 to 80 mm",
            "show.yaml:6:13: server 'p': the goal '[0, 2]' is not a list, each a number from -1 to 1",
            "show.yaml:8:17: server 'p': 'maybe' for a is not True or False",
            "show.yaml:8:35: server 'p': 'p' has no component 'trun'; did you mean 'turn'?",
        ],
        "{live:?}"
    );
    drop(rig.server);
    let ended = run(files, "check show.yaml -c moved.yaml --descriptions p.json");
    assert_eq!(findings(&ended), findings(&live), "{ended:?}");
    assert_eq!(ended.code, Some(1));
    // The file of the server's address counts.
    let both = "--descriptions p.json --descriptions other.json";
    let ended = run(files, &format!("check show.yaml -c remotes.yaml {both}"));
    assert_eq!(findings(&ended), findings(&live), "{ended:?}");
    let ended = run(files, &format!("check show.yaml -c moved.yaml {both}"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stdout.contains("p: more than one file describes "),
        "{ended:?}"
    );
    for (file, wrong) in [
        (
            "remotes.yaml",
            "remotes.yaml: this is not the description of a server: expected value",
        ),
        ("missing.yaml", "missing.yaml: cannot read it: "),
    ] {
        let ended = run(
            files,
            &format!("check show.yaml -c remotes.yaml --descriptions {file}"),
        );
        assert!(
            ended.stdout.starts_with(&format!("mistake: {wrong}"))
                || ended.stdout.contains(&format!("\nmistake: {wrong}")),
            "{ended:?}"
        );
        assert_eq!(ended.code, Some(1), "{ended:?}");
    }
    let ended = run(files, "check show.yaml --descriptions p.json");
    assert_eq!(ended.code, Some(2), "{ended:?}");
}

/// Describes itself, and does not answer whether it would take a task.
struct Head;

impl TaskController for Head {
    fn assign(&self, _: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        Err("nothing moves".into())
    }

    fn describe(&self) -> ScopeDescriptions {
        let pan = parse("{goal: {one-of: [left, right]}}").expect("a description");
        let pan = [("pan".to_owned(), pan)];
        ScopeDescriptions::from([("head".to_owned(), pan.into())])
    }
}

#[test]
fn goals_for_a_server_that_only_describes_itself_are_checked_live() {
    let server = serve(Head);
    let files = Scratch::new();
    let port = port_of(server.endpoint());
    let write = |name: &str, text: &str| std::fs::write(files.path(name), text).expect("a file");
    write(
        "show.yaml",
        "s: {a: {head: {pan: up, tilt: up}}, b: {head: {pan: left}}}\n",
    );
    write(
        "remotes.yaml",
        &format!("remotes: {{head: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n"),
    );
    let ended = run(&files, "check show.yaml -c remotes.yaml --live");
    let wrong = "show.yaml:1:21: server 'head': the goal 'up' is not left or right";
    assert_eq!(findings(&ended), [wrong], "{ended:?}");
}

#[test]
fn a_server_also_describes_what_it_forwards() {
    let mut far = Rig::new(COMPONENTS);
    let original = Server::original();
    let to = |port: u16| format!("forward: {{to: 'tcp://127.0.0.1:{port}', scope: {SCOPE}");
    let (ours, theirs) = (to(far.server.port), to(original.port));
    let near = Rig::new(&format!(
        "open: {{{ours}}}, about: opens the far gripper}}\n\
         way: {{{ours}, component: path}}}}\n\
         echo: {{{theirs}, handler: test}}}}"
    ));
    let told = || {
        let told = near.remote().describe_scope().expect("an answer");
        let told = told["p"].iter();
        told.map(|(name, is)| format!("{name}: {}", is.json()))
            .collect::<Vec<_>>()
    };
    let alone = [
        r#"echo: {"goal": {"type": "any"}}"#,
        r#"open: {"goal": {"type": "any"}, "about": "opens the far gripper"}"#,
        r#"way: {"goal": {"type": "any"}}"#,
    ];
    let with_far = [
        alone[0],
        r#"open: {"goal": {"type": "number", "least": 0, "most": 80, "step": 5, "unit": "mm"}, "about": "opens the far gripper", "examples": ["40", "0x10"], "result": "how far it is", "usually_ms": 1500}"#,
        r#"way: {"goal": {"list-of": {"type": "number", "least": -1, "most": 1}}}"#,
    ];
    until("the far descriptions", PATIENCE, || {
        (told() == with_far).then_some(())
    });
    // Its own rule is still any goal: the far server decides.
    assert!(
        near.rejection("open", "81")
            .contains("is not a number from 0 to 80 mm")
    );
    let write = |name: &str, text: &str| {
        std::fs::write(near.scratch.path(name), text).expect("a file");
    };
    let port = near.server.port;
    write("show.yaml", "s: {a: {p: {open: 81, way: [0]}}}\n");
    write(
        "remotes.yaml",
        &format!("remotes: {{p: {{host: localhost, port: {port}, scope: {SCOPE}}}}}\n"),
    );
    let ended = run(&near.scratch, "check show.yaml -c remotes.yaml --live");
    let wrong = "show.yaml:1:19: server 'p': the goal '81' is not a number from 0 to 80 mm";
    assert_eq!(findings(&ended), [wrong], "{ended:?}");
    far.server.process.signal("STOP");
    // No answer waits for it.
    until("it is silent", PATIENCE, || {
        in_time(Duration::from_secs(1), || (told() == alone).then_some(()))
    });
    far.server.process.signal("CONT");
    until("the far descriptions again", PATIENCE, || {
        (told() == with_far).then_some(())
    });
    far.server.process.kill();
    until("it is gone", PATIENCE, || (told() == alone).then_some(()));
}
