//! The exit codes of every command, as `docs/tools.md` lists them.

use std::collections::{BTreeMap, BTreeSet};
use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use ztl_pickle::Pickle;
use ztl_record::{Formats, Recording, Source, Written};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Scratch, Server, ours_named, reserve_port, ztl};

const DOCUMENT: &str = include_str!("../../docs/tools.md");

/// The rows of the table: command and code.
fn rows() -> BTreeSet<(String, i32)> {
    let (_, section) = DOCUMENT.split_once("\n## Exit codes\n").expect("a section");
    let (section, _) = section.split_once("\n## ").expect("another section");
    let row = |line: &str| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        let command = cells.next()?.trim_matches('`').to_owned();
        Some((command, cells.next()?.parse().ok()?))
    };
    section.lines().filter_map(row).collect()
}

/// The subcommands, as `ztl --help` lists them.
fn commands() -> Vec<String> {
    let help = Process::run(ztl().arg("--help")).stdout;
    let (_, list) = help.split_once("Commands:\n").expect("a list");
    let (list, _) = list.split_once("\n\n").expect("its end");
    let names = list
        .lines()
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "));
    let names = names.filter_map(|line| line.split_whitespace().next());
    names
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

/// Writes a recording of a task.
fn record_a_task(file: &Path) {
    let fields = ["state", "handler", "component", "goal"].into_iter();
    let fields = fields.zip(["INITIATED", "test", "echo", "hi"]);
    let text = |text| Pickle::text(text).expect("text");
    let fields = fields.map(|(key, value)| (key, text(value)));
    let event = Pickle::dict(fields.chain([("id", 1.into())])).expect("a dict");
    let topic = format!("{SCOPE}/$tasks/1");
    let robot = Source::named("robot");
    let message = Formats::default().prepare(&robot, &topic, &event.to_bytes());
    let mut recording = Recording::create(file).expect("a file");
    let written = recording.write(&robot, message.expect("a message"), Instant::now());
    assert_eq!(written.expect("room"), Written::Yes);
    recording.finish().expect("room");
}

#[test]
fn each_command_exits_with_the_documented_codes() {
    let tests = Server::ours();
    let scratch = Scratch::new();
    let file = |name: &str, text: &str| {
        std::fs::write(scratch.path(name), text).expect("a file");
    };
    file("wrong.yaml", "scope: /lab\nprot: 1\n");
    file("show.yaml", "scene: {step: {robot: {arm: up}}}\n");
    file("bad.yaml", "scene: {step: 7}\n");
    file("empty.yaml", "scene: {step(delay=0): {}}\n");
    file("none.jsonl", "");
    let listener = TcpListener::bind(("0.0.0.0", 0)).expect("a port");
    let taken = listener.local_addr().expect("its address").port();
    file(
        "serve.yaml",
        &format!("port: {taken}\nscopes: {{/r: {{h: {{c: echo}}}}}}\n"),
    );
    file(
        "remotes.yaml",
        &format!(
            "remotes: {{tests: {{host: localhost, port: {}, scope: {SCOPE}}}}}\n",
            tests.port
        ),
    );
    record_a_task(&scratch.path("tasks.mcap"));
    let values = BTreeMap::from([
        ("TESTS", tests.port),
        ("TAKEN", taken),
        ("NOBODY", reserve_port()),
    ]);
    let rows = rows();
    let mut seen = BTreeSet::new();
    let mut fails = BTreeSet::new();
    for (line, code, documented) in [
        ("ps -p TESTS", 0, "every"),
        ("describe -p TESTS", 0, "every"),
        ("abort -p TESTS --all", 0, "every"),
        (
            "task-client --exit-status -r localhost -p TESTS -s /test test:echo:hi",
            0,
            "every",
        ),
        (
            "task-client --exit-status -r localhost -p TESTS -s /test x:echo:hi",
            1,
            "every",
        ),
        ("ps --bogus", 2, "every"),
        ("ps", 2, "every"),
        ("completions tcsh", 2, "every"),
        ("nonsense", 2, "every"),
        ("abort -p TESTS 7", 1, "abort"),
        ("abort -p TESTS -s /test 7", 1, "abort"),
        ("abort -p TESTS -s /tset --all", 1, "abort"),
        ("check bad.yaml", 1, "check"),
        ("demo --once -p TAKEN", 1, "demo"),
        ("describe -p NOBODY", 1, "describe"),
        ("devices -p NOBODY", 1, "devices"),
        ("devices -p TESTS", 1, "devices"),
        ("param list hand -p NOBODY", 1, "param"),
        ("doctor -p NOBODY", 1, "doctor"),
        ("firmware show none.jsonl", 1, "firmware"),
        ("firmware update hand none.jsonl -p NOBODY", 2, "firmware"),
        ("gateway -d a=sim:gripper -p TAKEN -s /lab", 1, "gateway"),
        ("gateway wrong.yaml", 2, "gateway"),
        ("gateway wrong.yaml --check", 2, "gateway"),
        (
            "gateway -d a=sim:gripper -p TAKEN -s /lab --check",
            1,
            "gateway",
        ),
        ("keys no/such/directory/mine", 1, "keys"),
        ("line tcp-listen:TAKEN pty", 1, "line"),
        ("man none.jsonl", 1, "man"),
        ("device sim:gripper --on tcp:TAKEN", 1, "device"),
        ("ps -p NOBODY", 1, "ps"),
        ("record none.jsonl tcp://localhost:NOBODY", 1, "record"),
        ("record new.mcap nobody -c remotes.yaml", 2, "record"),
        ("replay no-such.mcap -p 0", 1, "replay"),
        ("replay tasks.mcap --tasks -c remotes.yaml", 2, "replay"),
        ("report none.jsonl", 1, "report"),
        ("report no-such.jsonl", 1, "report"),
        (
            "run-script -s bad.yaml -c remotes.yaml --yes",
            1,
            "run-script",
        ),
        (
            "run-script -s show.yaml -c remotes.yaml --yes",
            1,
            "run-script",
        ),
        ("serve serve.yaml", 1, "serve"),
        ("serve wrong.yaml", 2, "serve"),
        ("serve wrong.yaml --check", 2, "serve"),
        ("task-server -p TAKEN -s /x", 1, "task-server"),
        ("simple-server TAKEN /x", 1, "simple-server"),
        (
            "task-client -r localhost -p TESTS -s /test x:echo:hi",
            0,
            "task-client",
        ),
        (
            "task-client -r localhost -p TESTS -s /test echo",
            255,
            "task-client",
        ),
        (
            "remote-task -c remotes.yaml tests x:echo:hi",
            0,
            "remote-task",
        ),
        ("remote-task -c remotes.yaml other x:echo:hi", 2, "every"),
        ("run-script -s empty.yaml --yes", 0, "run-script"),
        (
            "simple-client localhost TESTS /test nonsense",
            0,
            "simple-client",
        ),
        ("publish -p TAKEN /x 1", 1, "publish"),
        ("publish -p 0 /x [1", 2, "publish"),
        ("simple-publisher -p TAKEN -s /x", 1, "simple-publisher"),
        (
            "simple-subscriber -r ipc:///x -p TESTS -s /x",
            1,
            "simple-subscriber",
        ),
        (
            "subscribe tcp://localhost:NOBODY -n 1 -t 100ms",
            1,
            "subscribe",
        ),
        ("subscribe nobody", 2, "subscribe"),
        ("web -c remotes.yaml -p TAKEN", 1, "web"),
        ("web -c none.jsonl", 2, "web"),
    ] {
        let words = line.split(' ').map(|word| {
            let value = |(name, value): (&&str, &u16)| {
                word.contains(*name)
                    .then(|| word.replace(*name, &value.to_string()))
            };
            values
                .iter()
                .find_map(value)
                .unwrap_or_else(|| word.to_owned())
        });
        let mut command = ztl();
        command
            .current_dir(scratch.path(""))
            .env("HOME", scratch.path("home"));
        for name in ["ZTL_HOST", "ZTL_PORT", "ZTL_SCOPE", "XDG_CONFIG_HOME"] {
            command.env_remove(name);
        }
        let ended = Process::run(command.args(words));
        assert_eq!(ended.code, Some(code), "{line}: {ended:?}");
        // Every failure prints a reason, except in a client that reports the task's outcome like the original.
        let silent = ended.stdout.is_empty() && ended.stderr.is_empty();
        assert!(!silent, "{line}");
        let row = (documented.to_owned(), code);
        assert!(rows.contains(&row), "{row:?} is not in the document");
        seen.insert(row);
        if code != 0 {
            fails.extend(line.split(' ').next().map(str::to_owned));
        }
    }
    let untried: Vec<_> = rows.difference(&seen).collect();
    assert!(untried.is_empty(), "nothing here shows {untried:?}");
    // The simple client and its siblings always exit with 0, like the original's.
    let excused = ["simple-client"];
    for command in commands() {
        let tried = fails.contains(&command) || excused.contains(&command.as_str());
        assert!(tried, "nothing here shows that `ztl {command}` fails");
    }
}

/// A mistake that is found before anything is sent ends with 2, and never with what `--exit-status` gives a rejected task.
#[test]
fn a_client_that_sends_nothing_because_of_a_mistake_exits_with_2() {
    let scratch = Scratch::new();
    let file = |name: &str, text: &str| {
        std::fs::write(scratch.path(name), text).expect("a file");
    };
    file("show.yaml", "scene: {step: {robot: {arm: up}}}\n");
    file("bad.yaml", "timeout: soon\n");
    // Keys in the file go before those of the options.
    file(
        "remotes.yaml",
        "remotes: {robot: {host: localhost, port: 1, scope: /lab, key: none.key_secret, server-key: none.key}}\n",
    );
    let keys = "--key none.key_secret --server-key none.key";
    let tools = [
        "task-client --exit-status -r localhost -p 1 -s SCOPE a:b:c",
        "task-client --exit-status --json -r localhost -p 1 -s SCOPE a:b:c",
        "simple-client --exit-status localhost 1 SCOPE 1",
        "remote-task --exit-status --task robot localhost 1 SCOPE robot a:b:c",
        "run-script -s show.yaml --yes --task robot localhost 1 SCOPE",
        "abort -p 1 -s SCOPE 7",
        "abort -p 1 -s SCOPE --all",
    ];
    let mut lines: Vec<String> = Vec::new();
    for tool in tools {
        lines.push(tool.replace("SCOPE", "/a;3"));
        let fine = tool.replace("SCOPE", "/lab");
        let (command, rest) = fine.split_once(' ').expect("words");
        lines.push(format!("{command} {keys} {rest}"));
        lines.push(format!("ZTL_TRANSPORT=pigeon {fine}"));
    }
    for line in [
        "ps -p 1 --key none.key_secret --server-key none.key",
        "describe -p 1 --key none.key_secret --server-key none.key",
        "devices -p 1 --key none.key_secret --server-key none.key",
        "ps -r robot -c remotes.yaml",
        "task-client --exit-status -r robot -c remotes.yaml a:b:c",
        "task-client --exit-status -r tcp://localhost -p 1 -s /lab a:b:c",
        "task-client --exit-status -p 1 -s /lab a:b",
        "task-client --exit-status --json -p 1 -s /lab a:b",
        "remote-task --exit-status --task robot localhost 1 /lab robot a:b",
        "ZTL_SCOPE=/a;3 task-client --exit-status -p 1 a:b:c",
        "remote-task --exit-status -c remotes.yaml robot a:b:c",
        "remote-task --exit-status -c remotes.yaml other a:b:c",
        "remote-task --exit-status --task robot localhost http /lab robot a:b:c",
        "remote-task --exit-status --task robot localhost -1 /lab robot a:b:c",
        "run-script -s show.yaml --yes --task robot localhost http /lab",
        "run-script -s show.yaml --yes --task robot localhost 1 /lab --scene other",
        "run-script -s show.yaml --yes --task robot localhost 1 /lab --defaults bad.yaml",
    ] {
        lines.push(line.to_owned());
    }
    for line in &lines {
        let mut command = ztl();
        command
            .current_dir(scratch.path(""))
            .env("HOME", scratch.path("home"));
        for name in [
            "ZTL_HOST",
            "ZTL_PORT",
            "ZTL_SCOPE",
            "ZTL_TRANSPORT",
            "XDG_CONFIG_HOME",
        ] {
            command.env_remove(name);
        }
        let mut words = line.split(' ');
        let mut first = words.next().expect("a word");
        if let Some((name, value)) = first.split_once('=') {
            command.env(name, value);
            first = words.next().expect("a command");
        }
        let ended = Process::run(command.arg(first).args(words));
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert!(!ended.stderr.is_empty(), "{line}");
        assert!(!ended.stdout.contains("Triggering"), "{line}: {ended:?}");
        // Stdout is for events.
        assert!(
            !line.contains("--json") || ended.stdout.is_empty(),
            "{line}: {ended:?}"
        );
    }
}

/// Commands that serve until they are stopped, and their first output.
fn servers(scratch: &Scratch) -> Vec<(Command, &'static str, i32)> {
    let file = scratch.path("serve.yaml");
    std::fs::write(&file, "port: 0\nscopes: {/r: {h: {c: echo}}}\n").expect("a file");
    let file = file.display().to_string();
    let link = scratch.path("a").display().to_string();
    let other = scratch.path("b").display().to_string();
    let on = format!("pty:{link}");
    let ends = [format!("pty:{link}2"), format!("pty:{other}")];
    let demo = reserve_port().to_string();
    let command = |mut command: Command, (words, says, code): (&[&str], _, _)| {
        command.args(words).env("HOME", scratch.path("home"));
        (command, says, code)
    };
    let all: [(&[&str], _, _); 8] = [
        (&["task-server", "-p", "0", "-s", SCOPE], "Registering", 1),
        (&["simple-server", "0", SCOPE], "Registering", 1),
        (&["serve", &file], "Serving", 0),
        (
            &["gateway", "-p", "0", "-s", "/lab", "-d", "a=sim:gripper"],
            "Serving",
            0,
        ),
        (&["device", "sim:gripper", "--on", &on], "Simulated", 0),
        (&["line", &ends[0], &ends[1]], "Seed", 0),
        (&["demo", "-p", &demo], "The gateway goes on serving", 0),
        (
            &["web", "-p", "0", "--task", "a", "localhost", "1", "/a"],
            "http://",
            0,
        ),
    ];
    let named = ["ztl_task_server", "ztl_simple_server"].map(|name| ours_named(scratch, name));
    let named = named.into_iter().zip(all);
    let named = named.map(|(tool, (words, says, code))| command(tool, (&words[1..], says, code)));
    let named: Vec<_> = named.collect();
    let ours = all.into_iter().map(|rest| command(ztl(), rest));
    ours.chain(named).collect()
}

#[test]
fn sigterm_ends_every_server_with_143_and_ctrl_c_as_before() {
    let scratch = Scratch::new();
    for (signal, by_signal) in [("TERM", Some(143)), ("INT", None)] {
        for (mut command, says, usual) in servers(&scratch) {
            let process = Process::start(&mut command);
            process.wait_for(says);
            process.signal(signal);
            let ended = process.end(PATIENCE);
            let code = by_signal.unwrap_or(usual);
            assert_eq!(ended.code, Some(code), "{signal} {command:?}: {ended:?}");
        }
    }
}

#[test]
fn a_demo_that_is_stopped_during_its_scene_fails_only_with_once() {
    for (options, signal, code) in [
        (&[][..], "INT", 0),
        (&[], "TERM", 143),
        (&["--once"], "INT", 130),
        (&["--once"], "TERM", 143),
    ] {
        let mut command = ztl();
        let process = Process::start(command.args(["demo", "-p", "0"]).args(options));
        process.wait_for("open the gripper");
        process.signal(signal);
        let ended = process.end(PATIENCE);
        assert!(!ended.stdout.contains("look straight"), "{ended:?}");
        assert_eq!(ended.code, Some(code), "{options:?} {signal}: {ended:?}");
    }
}
