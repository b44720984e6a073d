//! `ztl check`: one cause is one finding, and no mistake hides another.

use crate::directory::ScriptDirectory;
use std::fs;
use ztl_tests::lab::{Ended, Process, SCOPE, Server, ztl};

/// The first line of each finding.
fn found(ended: &Ended) -> Vec<&str> {
    let lines = ended.stdout.lines();
    lines
        .filter(|line| line.starts_with("mistake") || line.starts_with("doubtful"))
        .collect()
}

#[test]
fn a_name_that_a_server_does_not_have_is_one_finding() {
    let gateway = Server::simulated();
    let mut script = String::new();
    for scene in 0..13 {
        script += &format!("s{scene}:\n  b: {{arm: {{x: 1, y: 2}}}}\n");
        script += &format!("t{scene}:\n  b: {{gripper: {{fingre: 1, finger: 400}}}}\n");
    }
    let servers = [
        ("arm", gateway.port, SCOPE),
        ("gripper", gateway.port, SCOPE),
    ];
    let directory = ScriptDirectory::with(&script, &servers);
    let port = gateway.port.to_string();
    let described = Process::run(ztl().args(["describe", "--json", "-p", &port]));
    fs::write(directory.files.path("robot.json"), described.stdout).unwrap();
    for how in ["--live", "--descriptions robot.json"] {
        let ended = directory.run(&format!("check show.yaml -c remotes.yaml {how}"));
        let found = found(&ended).into_iter();
        let (goals, names): (Vec<&str>, Vec<&str>) =
            found.partition(|line| line.contains("'400' is not"));
        // Each wrong value is a mistake of its own.
        assert_eq!(goals.len(), 13, "{how}: {}", ended.stdout);
        let others = "(also in line 6, 10, 14, 18, 22, 26, 30, 34, 38, 42 and 2 more)";
        let expected = format!(
            "mistake: show.yaml:2:7: server 'arm': it has no handler 'arm' {others}; there are: "
        );
        assert_eq!(names.len(), 2, "{how}: {}", ended.stdout);
        assert!(names[0].starts_with(&expected), "{how}: {}", names[0]);
        let others = "(also in line 8, 12, 16, 20, 24, 28, 32, 36, 40, 44 and 2 more)";
        let expected = format!(
            "mistake: show.yaml:4:17: server 'gripper': 'gripper' has no component 'fingre' {others}; did you mean 'finger'?"
        );
        assert_eq!(names[1], expected, "{how}");
    }
}

#[test]
fn a_sentence_without_quotes_is_one_finding() {
    let cut = "and 'dear' has no ':' behind it; put a text with ',' in it in quotes";
    for (text, places) in [
        (
            "s: {a: {robot: {say: Hello, dear, good, kind, dear, visitors, at: 5}}}\n",
            &[format!("doubtful: show.yaml:1:27: this ',' ends 'Hello', {cut}")][..],
        ),
        (
            "s: {a: {robot: {say: {text: Hello, dear, good}}}}\n",
            &[format!("doubtful: show.yaml:1:34: this ',' ends 'Hello', {cut}")],
        ),
        // Without a component it is no task.
        (
            "s: {a: {robot: Hello, dear, good}}\n",
            &[
                "mistake: show.yaml:1:16: handler 'robot' is a mapping of components with their goals; found a single value; write scene: {step: {handler: {component: goal}}}, each on a line of its own".to_owned(),
                format!("mistake: show.yaml:1:21: this ',' ends 'Hello', {cut}"),
            ],
        ),
        // Each of these is to be mended.
        (
            "s: {a: {robot: {x: {hello, world}, echo:1, more:2}}}\n",
            &[
                "doubtful: show.yaml:1:21: 'hello' has no ':' behind it; a text with ',' in it needs quotes within { }".to_owned(),
                "doubtful: show.yaml:1:28: 'world' has no ':' behind it; a text with ',' in it needs quotes within { }".to_owned(),
                "doubtful: show.yaml:1:36: 'echo:1' has no ':' behind it; write a space after the colon: echo: 1".to_owned(),
                "doubtful: show.yaml:1:44: 'more:2' has no ':' behind it; write a space after the colon: more: 2".to_owned(),
            ],
        ),
    ] {
        let directory = ScriptDirectory::with(text, &[("robot", 1, "/r")]);
        let ended = directory.run("check show.yaml -c remotes.yaml");
        assert_eq!(found(&ended), places, "{text}: {}", ended.stdout);
    }
}

#[test]
fn a_duplicate_key_hides_no_other_mistake() {
    let script = "s: {a: {robto: {say: hi}, robot: {say: no}}, <<: 5}\n";
    let directory = ScriptDirectory::with(script, &[]);
    let remotes = "remotes:
  robot: {host: 127.0.0.1, prt: 7002, scope: test, scope: /test}
  robot: {hots: a, port: 70000}
  arm: {host: lamp, port: 1, scope: /a}
";
    fs::write(directory.files.path("remotes.yaml"), remotes).unwrap();
    fs::write(
        directory.files.path("defaults.yaml"),
        "timeout: 5\ntimeout: 0\nparalel: yes\n",
    )
    .unwrap();
    let ended = directory.run("check show.yaml -c remotes.yaml --defaults defaults.yaml");
    let places = [
        "defaults.yaml:2:1: duplicate key 'timeout'",
        "defaults.yaml:3:1: unknown key 'paralel'; did you mean 'parallel'?",
        "remotes.yaml:2:28: unknown key 'prt'; did you mean 'port'?",
        "remotes.yaml:2:52: duplicate key 'scope'",
        "remotes.yaml:3:3: duplicate key 'robot'",
        "remotes.yaml:3:10: 'scope' is missing; write scope: /lab",
        "remotes.yaml:3:11: unknown key 'hots'; did you mean 'host'?",
        "show.yaml:1:9: no remote 'robto' in remotes.yaml; did you mean 'robot'?",
        "show.yaml:1:50: '<<' takes a mapping or a list of mappings",
    ];
    let mistakes = found(&ended).into_iter();
    let mistakes: Vec<&str> = mistakes
        .filter_map(|line| line.strip_prefix("mistake: "))
        .collect();
    assert_eq!(mistakes, places, "{}", ended.stdout);
    // Nothing is played.
    let played = directory.run("run-script --yes -s show.yaml -c remotes.yaml");
    assert_eq!(played.code, Some(1), "{played:?}");
}
