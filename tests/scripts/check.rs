//! `ztl check`: mistakes with their places, and questions to servers whether they would accept the goals.

use crate::directory::{PLAY, ScriptDirectory};
use std::fs;
use std::path::PathBuf;
use std::time::Duration;
use ztl_tests::lab::{Process, SCOPE, Server, in_time, reserve_port, ztl};

/// The example's script and its configuration of servers.
fn example(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../examples/scripts")
        .join(name)
}

#[test]
fn the_example_plays_on_the_devices_of_the_demo() {
    let gateway = Server::simulated();
    let script = fs::read_to_string(example("welcome.yaml")).unwrap();
    let directory = ScriptDirectory::new(&script);
    let remotes = fs::read_to_string(example("zmq-remotes.yaml")).unwrap();
    let remotes = remotes.replace("12345", &gateway.port.to_string());
    let remotes = remotes.replace("/lab", SCOPE);
    fs::write(directory.files.path("remotes.yaml"), remotes).unwrap();

    let checked = directory.run("check show.yaml -c remotes.yaml --live");
    assert_eq!(checked.code, Some(0), "{checked:?}");
    assert!(
        checked.stdout.ends_with("Nothing is wrong.\n"),
        "{checked:?}"
    );
    let played = directory.run(PLAY);
    assert_eq!(played.code, Some(0), "{played:?}");
    for line in [
        "EXECUTING SCENE 'welcome'...",
        "STARTING STEP 'look at the hand' WITH DELAY 1s...",
        "STARTING STEP 'close a little' IN BACKGROUND WITH DELAY 0.5s...",
        "STARTING STEP 'let go'...",
    ] {
        assert!(
            played.stdout.lines().any(|said| said == line),
            "{line}: {played:?}"
        );
    }
}

#[test]
fn a_check_shows_each_mistake_at_its_position_with_a_suggestion() {
    let directory = ScriptDirectory::with(
        "\
greeting:
  hello (wait=ture; dealy=2):
    robto: {say: no, at: 12:30}
    robot: {on: 010, x(delay=soon): [1e3]}
  hello (wait=ture; dealy=2):
    - a
  last:
",
        &[("robot", 1, "/r")],
    );
    let ended = directory.run("check show.yaml -c remotes.yaml");
    assert_eq!(ended.code, Some(1));
    let found: Vec<&str> = ended
        .stdout
        .lines()
        .filter(|line| line.contains("show.yaml:"))
        .collect();
    for (place, words) in [
        (
            "doubtful: show.yaml:2:15:",
            "'ture' is neither yes nor no, and is taken for no; did you mean 'true'?",
        ),
        (
            "doubtful: show.yaml:2:21:",
            "a step has no parameter 'dealy': it has no effect; did you mean 'delay'?",
        ),
        (
            "doubtful: show.yaml:3:18:",
            "YAML reads 'no' as False; if you mean the text, put it in quotes: 'no'",
        ),
        ("doubtful: show.yaml:3:26:", "YAML reads '12:30' as 750"),
        ("doubtful: show.yaml:4:13:", "YAML reads 'on' as True"),
        ("doubtful: show.yaml:4:17:", "YAML reads '010' as 8"),
        (
            "doubtful: show.yaml:4:30:",
            "'soon' is not a number of seconds; write 2 or 1.5",
        ),
        (
            "doubtful: show.yaml:4:38:",
            "YAML reads '1e3' as a text, which is sent in quotes; if you mean the number, write 1000.0",
        ),
        (
            "doubtful: show.yaml:5:3:",
            ": this one is played, in the place of the first (line 2)",
        ),
        (
            "mistake: show.yaml:6:5:",
            "step 'hello' is a mapping of handlers; found a list",
        ),
        (
            "mistake: show.yaml:7:3:",
            "step 'last' is a mapping of handlers; found nothing",
        ),
    ] {
        let told = found
            .iter()
            .any(|line| line.starts_with(place) && line.contains(words));
        assert!(told, "{place} {words}: {}", ended.stdout);
    }
    // The marker is below the text that it refers to.
    let marked = "  2 |   hello (wait=ture; dealy=2):\n    |               ^^^^\n";
    assert!(ended.stdout.contains(marked), "{}", ended.stdout);
    assert!(
        ended.stdout.ends_with("2 mistakes, 11 doubtful places.\n"),
        "{}",
        ended.stdout
    );
    // A script with mistakes is not played, and the output says why.
    let played = directory.run(PLAY);
    assert_eq!((played.code, played.stdout.as_str()), (Some(1), ""));
    assert!(
        played
            .stderr
            .contains("show.yaml:6:5: step 'hello' is a mapping"),
        "{}",
        played.stderr
    );
}

#[test]
fn server_names_are_checked_against_the_configuration() {
    let directory = ScriptDirectory::with("s: {a: {robto: {say: hi}}}\n", &[("robot", 1, "/r")]);
    let ended = directory.run("check show.yaml -c remotes.yaml");
    assert_eq!(ended.code, Some(1));
    let line = "mistake: show.yaml:1:9: no remote 'robto' in remotes.yaml; did you mean 'robot'?";
    assert!(ended.stdout.starts_with(line), "{ended:?}");
    let ended = directory.run("check show.yaml");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended
            .stdout
            .contains("the names of servers are not checked (-c FILE)"),
        "{ended:?}"
    );
}

#[test]
fn one_cause_is_one_finding() {
    let mut script = "s:\n".to_owned();
    for step in 0..26 {
        script += &format!("  step {step}: {{robto: {{say: hi}}, lamp: {{light: 1}}}}\n");
    }
    let directory = ScriptDirectory::with(&script, &[("robot", 1, "/r")]);
    let write = |name: &str, text: &str| fs::write(directory.files.path(name), text).unwrap();
    write("empty.yaml", "");
    write("broken.yaml", "remotes:\n  a: {host: h\n  b: {host: h}\n");
    write(
        "wrong.yaml",
        "remotes:\n  robto: &r {host: h, prot: 1, scope: /r}\n  lamp: *r\n",
    );
    for (config, found) in [
        (
            "missing.yaml",
            ["mistake: missing.yaml: cannot read it:"].as_slice(),
        ),
        (
            "empty.yaml",
            &[
                "mistake: empty.yaml: it names no server under 'remotes'; the script uses: robto, lamp",
            ],
        ),
        (
            "broken.yaml",
            &[
                "mistake: broken.yaml:2:6: this '{' is not closed, or a ',' is missing before line 3",
            ],
        ),
        (
            "wrong.yaml",
            &["mistake: wrong.yaml:2:23: unknown key 'prot'; did you mean 'port'?"],
        ),
        (
            "remotes.yaml",
            &[
                "mistake: show.yaml:2:12: no remote 'robto' in remotes.yaml; did you mean 'robot'? \
                 (also in line 3, 4, 5, 6, 7, 8, 9, 10, 11, 12 and 15 more)",
                "mistake: show.yaml:2:30: no remote 'lamp' in remotes.yaml; there are: robot (also in line 3,",
            ],
        ),
    ] {
        let ended = directory.run(&format!("check show.yaml -c {config}"));
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let lines: Vec<&str> = ended
            .stdout
            .lines()
            .filter(|line| line.starts_with("mistake") || line.starts_with("doubtful"))
            .collect();
        assert_eq!(lines.len(), found.len(), "{config}: {}", ended.stdout);
        for (line, found) in lines.iter().zip(found) {
            assert!(line.starts_with(found), "{config}: {line}");
        }
        assert_eq!(ended.stderr, "", "{config}");
    }
}

#[test]
fn a_misspelt_key_for_encryption_is_found_in_every_entry_of_the_configuration() {
    let robot = ("robot", 1, "/r");
    let directory = ScriptDirectory::with("s: {step: {robot: {say: hi}}}\n", &[robot]);
    let write = |text: &str| fs::write(directory.files.path("remotes.yaml"), text).unwrap();
    let used = "remotes:\n  robot: {host: h, port: 1, scope: /r, server_key: r.key}\n";
    let unused = "remotes:\n  robot: {host: h, port: 1, scope: /r}\n  \
                  lamp: {host: h, port: 1, scope: /r, keys: a}\npublishers:\n  \
                  eyes: {host: h, port: 1, scope: /r, key: a}\n";
    for (text, found) in [
        (
            used,
            &["remotes.yaml:2:40: unknown key 'server_key'; did you mean 'server-key'?"][..],
        ),
        (
            unused,
            &[
                "remotes.yaml:3:39: unknown key 'keys'; did you mean 'key'?",
                "remotes.yaml:5:44: an encrypted connection needs both: key: robot.key_secret, server-key: far.key",
            ],
        ),
    ] {
        write(text);
        let ended = directory.run("check show.yaml -c remotes.yaml");
        let lines: Vec<&str> = ended
            .stdout
            .lines()
            .filter_map(|line| line.strip_prefix("mistake: "))
            .collect();
        assert_eq!(lines, found, "{ended:?}");
        assert_eq!(ended.code, Some(1), "{ended:?}");
    }
}

#[test]
fn a_mistyped_key_is_one_finding_with_a_suggestion() {
    let colon = "write a space after the colon: echo: 1";
    for (lines, found) in [
        (
            "test: {echo:1}",
            format!("doubtful: show.yaml:3:12: 'echo:1' has no ':' behind it; {colon}"),
        ),
        (
            "test: {echo:1, foo: 2}",
            format!("doubtful: show.yaml:3:12: 'echo:1' has no ':' behind it; {colon}"),
        ),
        (
            "{echo:1}",
            format!("mistake: show.yaml:3:6: 'echo:1' has no ':' behind it; {colon}"),
        ),
        (
            "test: echo:1",
            format!(
                "mistake: show.yaml:3:11: handler 'test' is a mapping of components with their goals; \
                 found a single value; {colon}"
            ),
        ),
        (
            "test:{echo: 1}",
            "mistake: show.yaml:3:17: handler 'test:{echo' is a mapping of components with their goals; \
             found a single value; write a space after the colon: test: {echo"
                .to_owned(),
        ),
        (
            "test:\n      echo:{x: 1}",
            "doubtful: show.yaml:4:7: servers take a component's name to end before the ':'; \
             write a space after the colon: echo: {x"
                .to_owned(),
        ),
        (
            "test (wait=no): {echo: 1}",
            "mistake: show.yaml:3:11: a handler has no parameter 'wait': it has no effect; \
             write it behind the name of a step or component"
                .to_owned(),
        ),
        (
            "test(remot=test): {echo: 1}",
            "mistake: show.yaml:3:10: a handler has no parameter 'remot': it has no effect; did you mean 'remote'?"
                .to_owned(),
        ),
        (
            "delay: -3",
            "mistake: show.yaml:3:12: handler 'delay' is a mapping of components with their goals; \
             if it is a parameter, write it in parentheses, as name (delay=-3)"
                .to_owned(),
        ),
        (
            "- test:{echo: 1}",
            "mistake: show.yaml:3:5: step 'step' is a mapping of handlers; found a list; write scene: "
                .to_owned(),
        ),
    ] {
        let directory = ScriptDirectory::with(
            &format!("scene:\n  step:\n    {lines}\n"),
            &[("test", 1, "/r")],
        );
        let ended = directory.run("check show.yaml -c remotes.yaml");
        let lines = ended.stdout.lines();
        let all: Vec<&str> = lines.filter(|line| line.contains("show.yaml:")).collect();
        assert_eq!(all.len(), 1, "{}", ended.stdout);
        assert!(all[0].starts_with(&found), "{found}\n{}", ended.stdout);
    }
}

#[test]
fn missing_servers_are_probed_concurrently() {
    let ports: Vec<u16> = (0..12).map(|_| reserve_port()).collect();
    let names: Vec<String> = (0..12).map(|nth| format!("robot{nth}")).collect();
    let mut script = "s:\n  a:\n".to_owned();
    for name in &names {
        script += &format!("    {name}: {{x: 1}}\n");
    }
    let remotes = names.iter().zip(&ports);
    let remotes: Vec<_> = remotes
        .map(|(name, port)| (name.as_str(), *port, "/x"))
        .collect();
    let directory = ScriptDirectory::with(&script, &remotes);
    // In sequence they would take 24 s.
    let ended = in_time(Duration::from_secs(12), || {
        directory.run("check show.yaml -c remotes.yaml --live")
    });
    let found: Vec<&str> = ended
        .stdout
        .lines()
        .filter_map(|line| {
            line.split_once(" does not answer: ")
                .map(|(found, _)| found)
        })
        .collect();
    let expected = names.iter().enumerate();
    let expected =
        expected.map(|(nth, name)| format!("mistake: show.yaml:{}:5: server '{name}'", nth + 3));
    assert_eq!(found, expected.collect::<Vec<_>>());
    let listed = ended
        .stdout
        .lines()
        .filter(|line| line.contains(": MISSING: "));
    let listed: Vec<&str> = listed.filter_map(|line| line.split(':').next()).collect();
    assert_eq!(listed, names);
}

#[test]
fn no_mistake_hides_another() {
    let gateway = Server::simulated();
    let script = "\
s:
  a: [list]
  b: {robto: {say: 2020-02-30}, gripper: {finger: 400}}
  c: {gripper: {fingre: 1}}
";
    let directory = ScriptDirectory::with(script, &[("gripper", gateway.port, SCOPE)]);
    fs::write(directory.files.path("defaults.yaml"), "timeuot: 3\n").unwrap();
    let ended = directory.run("check show.yaml -c remotes.yaml --defaults defaults.yaml --live");
    for words in [
        "defaults.yaml:1:1: unknown key 'timeuot'",
        "show.yaml:2:6: step 'a' is a mapping of handlers; found a list",
        "show.yaml:3:7: no remote 'robto' in remotes.yaml",
        "show.yaml:3:20: '2020-02-30' looks like a date",
        "show.yaml:3:51: server 'gripper': '400' is not a number",
        "show.yaml:4:17: server 'gripper': 'gripper' has no component 'fingre'",
        "6 mistakes.",
    ] {
        assert!(ended.stdout.contains(words), "{words}: {}", ended.stdout);
    }
}

#[test]
fn implausible_values_are_reported_as_doubtful() {
    let script = "\
s(delay=-3):
  delay: 2
  a(delay=99999, timeout=0):
    robot: {say: “hello, world”, delay: -3, wait: 5}
    lamp(remote=robot): {'delay': 7}
  b(timeout=none, delay=600):
    robot: {say(timeout=-5): “hi”, tell: ’tis fine, 'x': '“quoted”', list: {hello, world}}
";
    let directory = ScriptDirectory::with(script, &[("robot", 1, "/r")]);
    let ended = directory.run("check show.yaml -c remotes.yaml");
    let found: Vec<&str> = ended
        .stdout
        .lines()
        .filter(|line| line.contains("show.yaml:"))
        .collect();
    let expected = [
        "doubtful: show.yaml:1:3: a delay cannot be negative; write the seconds to wait, as delay=3",
        "mistake: show.yaml:2:10: step 'delay' is a mapping of handlers; if it is a parameter, write it in parentheses, as name (delay=2)",
        "doubtful: show.yaml:3:5: this waits 27 h 46 min; a delay is in seconds, as delay=1.5",
        "doubtful: show.yaml:3:18: a limit must be above 0 seconds; write timeout=30, or timeout=none for no limit",
        "doubtful: show.yaml:4:18: YAML takes these quotes for a part of the text; write straight quotes: 'hello'",
        "doubtful: show.yaml:4:24: this ',' ends '“hello', and 'world”' has no ':' behind it; put a text with ',' in it in quotes",
        "doubtful: show.yaml:4:34: this is sent as a task of a component 'delay'; if it is a parameter, write it in parentheses, as name (delay=-3)",
        "mistake: show.yaml:7:25: '-5' is below 0; write seconds, as 30, or none",
        "doubtful: show.yaml:7:30: YAML takes these quotes for a part of the text; write straight quotes: 'hi'",
        "doubtful: show.yaml:7:77: 'hello' has no ':' behind it; a text with ',' in it needs quotes within { }",
        "doubtful: show.yaml:7:84: 'world' has no ':' behind it; a text with ',' in it needs quotes within { }",
    ];
    assert_eq!(found, expected, "{}", ended.stdout);
}

#[test]
fn servers_are_asked_about_each_task_without_starting_any() {
    let gateway = Server::simulated();
    let original = Server::original();
    let script = "\
s:
  a:
    gripper: {finger: 400, fingre: 1}
    hand(remote=gripper): {x: 1}
    head: {pan: lift}
    nobody: {x: 1}
    other: {x: 1}
    lost: {x: 1}
";
    let directory = ScriptDirectory::with(
        script,
        &[
            ("gripper", gateway.port, SCOPE),
            ("head", gateway.port, SCOPE),
            ("nobody", reserve_port(), "/x"),
            ("other", original.port, SCOPE),
            ("lost", original.port, "/lost"),
        ],
    );
    let ended = directory.run("check show.yaml -c remotes.yaml --live");
    assert_eq!(ended.code, Some(1));
    for words in [
        "show.yaml:3:23: server 'gripper': '400' is not a number from 0 to 100 percent",
        "show.yaml:3:28: server 'gripper': 'gripper' has no component 'fingre'; did you mean 'finger'?",
        "show.yaml:4:5: server 'gripper': it has no handler 'hand'; there are: gripper, head",
        "show.yaml:5:17: server 'head': 'lift' is not a number from -90 to 90 degrees, or left, straight, right",
        "show.yaml:6:5: server 'nobody' does not answer: no answer from tcp://127.0.0.1:",
        "one of the original's: it answers, but cannot be asked which tasks it accepts",
        "show.yaml:8:5: the server at tcp://127.0.0.1:",
        "6 mistakes.",
    ] {
        assert!(ended.stdout.contains(words), "{words}: {}", ended.stdout);
    }
    let port = gateway.port.to_string();
    let tasks = Process::run(ztl().args(["ps", "--all", "-p", &port]));
    assert_eq!(tasks.stdout, "No task is running.\n", "{tasks:?}");
}

#[test]
fn an_oversized_goal_is_reported_before_and_during_the_run() {
    let gateway = Server::gateway_with(&["gripper=sim:gripper"], &["--limit", "message=2 KiB"]);
    gateway.wait_ready("gripper");
    let script = format!(
        "s: {{a: {{gripper: {{finger: '{}'}}}}}}\n",
        "5".repeat(2000)
    );
    let directory = ScriptDirectory::with(&script, &[("gripper", gateway.port, SCOPE)]);
    let reason =
        "takes at most 2048; a goal can have somewhat less than 1536, because it is sent as base64";
    let ended = directory.run("check show.yaml -c remotes.yaml --live");
    assert_eq!(ended.code, Some(1));
    for words in [
        "mistake: show.yaml:1:27: server 'gripper': the message has ",
        reason,
    ] {
        assert!(ended.stdout.contains(words), "{words}: {}", ended.stdout);
    }
    let ended = directory.run("run-script --yes -s show.yaml -c remotes.yaml");
    assert_eq!(ended.code, Some(1), "{ended:?}");
    for words in ["COULD NOT BE TRIGGERED. REPLY: 'the message has ", reason] {
        assert!(ended.stderr.contains(words), "{words}: {ended:?}");
    }
}

/// The query is longer than the INIT and may itself be too long.
#[test]
fn a_goal_at_the_servers_limit_is_not_a_mistake() {
    let gateway = Server::gateway_with(&["gripper=sim:gripper"], &["--limit", "message=2 KiB"]);
    gateway.wait_ready("gripper");
    for (goal, mistake) in [(1511, false), (1513, true)] {
        // As a message: the scope, `;1;-1;`, and the task in base64.
        let bytes = SCOPE.len() + 6 + ("gripper:finger:".len() + goal).div_ceil(3) * 4;
        assert_eq!(bytes > 2048, mistake, "{bytes}");
        let script = format!("s: {{a: {{gripper: {{finger: {}}}}}}}\n", "x".repeat(goal));
        let directory = ScriptDirectory::with(&script, &[("gripper", gateway.port, SCOPE)]);
        let ended = directory.run("check show.yaml -c remotes.yaml --live");
        let told = ended.stdout.contains("the message has ");
        assert_eq!(told, mistake, "{goal}: {}", ended.stdout);
    }
}
