//! Output of the command-line clients: JSON for programs, text on a terminal, and what Ctrl-C prints.

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde_json::Value;
use ztl_std::{ExecutableTask, RunningServer, TaskContext, TaskController, TaskError, TaskRequest};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, SCOPE, Scratch, Server, in_time, our_client,
    our_client_at, ours_named, port_of, reserve_port, serve, until, ztl,
};

/// The names that a program may rely on, as listed in `docs/tools.md`.
const DOCUMENT: &str = include_str!("../../docs/tools.md");

/// Runs a client with `--json --exit-status`; returns its lines and its exit code. Leaves out progress lines
/// without text: on a busy machine a task that ends at once also has one.
#[track_caller]
fn told(line: &str) -> (Vec<Value>, Option<i32>) {
    let mut command = ztl();
    command
        .args(line.split(' '))
        .args(["--json", "--exit-status"]);
    let ended = Process::run(&mut command);
    let mut objects = objects(&ended);
    objects.retain(|object| object["event"] != "progress" || !object["text"].is_null());
    (objects, ended.code)
}

#[track_caller]
fn objects(ended: &Ended) -> Vec<Value> {
    let lines = ended.stdout.lines();
    let objects: Vec<Value> = lines
        .map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}")))
        .collect();
    for object in &objects {
        assert_documented(object);
    }
    objects
}

/// An object's names match the document, including their order.
#[track_caller]
fn assert_documented(object: &Value) {
    let mut names: BTreeMap<_, _> = object
        .as_object()
        .expect("an object")
        .clone()
        .into_iter()
        .collect();
    let event = names.remove("event").expect("an event");
    let event = event.as_str().expect("a name");
    let row = DOCUMENT
        .lines()
        .find(|line| line.starts_with(&format!("| `{event}` |")))
        .unwrap_or_else(|| panic!("`{event}` is not in the document"));
    let with = row.rsplit(" | ").next().expect("a last column");
    for name in names.keys() {
        assert!(with.contains(&format!("`{name}`")), "{name} in {row}");
    }
    if let Some(outcome) = names.get("outcome") {
        let row = format!(
            "| {} | {} |",
            outcome.to_string().replace('"', "`"),
            names["exit_status"]
        );
        assert!(DOCUMENT.contains(&row), "{row}");
    }
}

fn events(objects: &[Value]) -> Vec<&str> {
    objects
        .iter()
        .filter_map(|object| object["event"].as_str())
        .collect()
}

#[test]
fn each_client_reports_a_task_as_json_events() {
    let server = Server::ours();
    let port = server.port;
    for (line, request) in [
        (
            format!("task-client -r localhost -p {port} -s {SCOPE} test:echo:hi"),
            "dGVzdDplY2hvOmhp",
        ),
        (
            format!("remote-task --task robot localhost {port} {SCOPE} robot test:echo:hi"),
            "dGVzdDplY2hvOmhp",
        ),
        (
            format!("simple-client localhost {port} {SCOPE} dGVzdDplY2hvOmhp"),
            "dGVzdDplY2hvOmhp",
        ),
    ] {
        let (objects, code) = told(&line);
        assert_eq!(
            events(&objects),
            ["asking", "started", "over"],
            "{objects:?}"
        );
        let [asking, started, over] = objects.as_slice() else {
            panic!("{objects:?}")
        };
        assert_eq!(asking["host"], "localhost");
        assert_eq!(asking["port"], port);
        assert_eq!(asking["scope"], SCOPE);
        assert_eq!(asking["request"], request);
        assert!(
            started["reply"]
                .as_str()
                .expect("a text")
                .starts_with("Initiated")
        );
        assert_eq!(started["id"], over["id"]);
        assert_eq!(
            (over["outcome"].as_str(), over["text"].as_str()),
            (Some("completed"), Some("hi"))
        );
        assert_eq!((over["exit_status"].as_i64(), code), (Some(0), Some(0)));
    }
}

#[test]
fn json_reports_each_outcome_with_its_exit_code() {
    let server = Server::ours();
    let at = |port: u16| format!("-r localhost -p {port} -s {SCOPE}");
    let here = at(server.port);
    for (line, names, outcome, code) in [
        (
            format!("{here} test:nothing:x"),
            "asking started over",
            "failed",
            3,
        ),
        (format!("{here} other:echo:x"), "asking over", "rejected", 1),
        (
            format!("{} test:echo:x", at(reserve_port())),
            "asking over",
            "not_started",
            5,
        ),
        // It rejects the abort and sleeps longer than the client waits.
        (
            format!("{here} -t 1 test:sleep:30"),
            "asking started aborting not_aborted over",
            "unknown",
            5,
        ),
    ] {
        let (objects, exit) = told(&format!("task-client {line}"));
        assert_eq!(events(&objects).join(" "), names, "{line}: {objects:?}");
        let over = objects.last().expect("a last line");
        assert_eq!(over["outcome"], outcome, "{over}");
        assert_eq!(
            (over["exit_status"].as_i64(), exit),
            (Some(code), Some(code as i32))
        );
    }
}

#[test]
fn progress_is_reported_when_it_changes() {
    let gateway = Server::simulated();
    // It takes 6 s then.
    gateway.set_speed("gripper", "speed", 0.1);
    let line = format!(
        "task-client -r localhost -p {} -s {SCOPE} gripper:finger:30",
        gateway.port
    );
    let (objects, code) = told(&line);
    assert_eq!(code, Some(0));
    let mut texts: Vec<_> = objects
        .iter()
        .filter(|o| o["event"] == "progress")
        .collect();
    assert!(texts.len() >= 3, "{objects:?}");
    let count = texts.len();
    texts.dedup();
    assert_eq!(texts.len(), count, "{objects:?}");
    assert!(
        texts.iter().all(|object| object["text"].is_string()),
        "{texts:?}"
    );
}

/// A controller that decides only on request; its tasks run until they are aborted.
struct Slow {
    asked: Sender<()>,
    decide: Mutex<Receiver<()>>,
    ended: Sender<bool>,
}

impl TaskController for Slow {
    fn assign(&self, _request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let _ = self.asked.send(());
        let _ = self
            .decide
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .recv();
        let ended = self.ended.clone();
        Ok(Box::new(move |context: &TaskContext| {
            let aborted = context.sleep(PATIENCE);
            let _ = ended.send(aborted.is_err());
            aborted?;
            Ok(String::new())
        }))
    }
}

struct SlowServer {
    asked: Receiver<()>,
    /// Dropped before the server, whose controller may wait for it.
    decide: Sender<()>,
    /// For each task whether it was aborted.
    ended: Receiver<bool>,
    server: RunningServer,
}

fn slow() -> SlowServer {
    let (asked, was_asked) = channel();
    let (decide, decided) = channel();
    let (ended, ends) = channel();
    let controller = Slow {
        asked,
        decide: Mutex::new(decided),
        ended,
    };
    SlowServer {
        asked: was_asked,
        decide,
        ended: ends,
        server: serve(controller),
    }
}

/// A server holds its answers about an undecided task for this time, so a shorter attempt gets none that says so.
const HELD: Duration = Duration::from_millis(1500);

impl SlowServer {
    fn client(&self, options: &[&str]) -> Process {
        let mut command = our_client_at(port_of(self.server.endpoint()));
        Process::start(command.args(options).arg("robot:base:forward"))
    }
}

/// Waits until a client has said one of these.
#[track_caller]
fn wait_for_any(client: &Process, parts: &[&str]) {
    until(&parts.join(", "), PATIENCE, || {
        let said = client.stdout();
        parts.iter().any(|part| said.contains(part)).then_some(())
    });
}

#[test]
fn ctrl_c_before_the_answer_finds_the_task_and_aborts_it() {
    for (options, code) in [(&[][..], 130), (&["--json", "--exit-status"], 4)] {
        let (lab, ended) = in_time(HELD, || {
            let lab = slow();
            let client = lab.client(options);
            lab.asked.recv_timeout(PATIENCE).expect("its INIT");
            client.signal("INT");
            wait_for_any(
                &client,
                &["Interrupted", "interrupted", "Initialised", "started"],
            );
            lab.decide.send(()).expect("it waits");
            let ended = client.end(PATIENCE);
            (lab, ended)
        });
        assert_eq!(ended.code, Some(code), "{ended:?}");
        assert_eq!(lab.ended.recv_timeout(PATIENCE), Ok(true), "it was aborted");
        if options.is_empty() {
            assert!(
                ended.stdout.contains("aborted. Reply is 'True'."),
                "{ended:?}"
            );
        } else {
            let names = ["asking", "interrupted", "started", "aborting", "over"];
            let objects = objects(&ended);
            assert_eq!(events(&objects), names);
            assert_eq!(objects[3]["interrupted"], true);
            assert_eq!(objects[4]["outcome"], "aborted");
        }
    }
}

#[test]
fn ctrl_c_without_a_server_exits_at_once() {
    let mut command = our_client_at(reserve_port());
    command.args(["--json", "a:b:c"]);
    // A whole attempt takes 2 s.
    let ended = in_time(Duration::from_millis(1900), || {
        let mut client = Process::start(&mut command);
        client.next_line(PATIENCE);
        client.signal("INT");
        client.end(PATIENCE)
    });
    assert_eq!(ended.code, Some(130));
    let objects = objects(&ended);
    assert_eq!(
        objects.last().expect("a line")["outcome"],
        "not_started",
        "{ended:?}"
    );
}

#[test]
fn a_second_ctrl_c_leaves_at_once() {
    let (_lab, ended) = in_time(HELD, || {
        let lab = slow();
        let client = lab.client(&[]);
        lab.asked.recv_timeout(PATIENCE).expect("its INIT");
        client.signal("INT");
        wait_for_any(&client, &["Interrupted", "Initialised"]);
        let ended = client.signal_until_end("INT", PATIENCE);
        (lab, ended)
    });
    assert_eq!(ended.code, Some(130));
    assert!(!ended.stdout.contains("Aborting"), "{ended:?}");
}

#[test]
fn sigterm_aborts_the_task_reports_its_outcome_and_exits_with_143() {
    let scratch = Scratch::new();
    let naps = Server::naps();
    let server = Server::ours();
    let stops = ["aborted. Reply is 'True'."];
    // This task cannot be aborted, and the sender of SIGTERM does not wait for its end.
    let goes_on = [
        "Could not abort Task with ID '",
        "'. Reply is 'False'.",
        "may still run.",
    ];
    for (server, task, said) in [
        (&naps, "nap:for:600", &stops[..]),
        (&server, "test:sleep:600", &goes_on),
    ] {
        for client in [our_client(), ours_named(&scratch, "ztl_task_client")] {
            let client = server.start_client(client, &[task]);
            client.wait_for("Initialised task with ID");
            client.signal("TERM");
            let ended = client.end(PATIENCE);
            assert_eq!(ended.code, Some(143), "{ended:?}");
            for part in said {
                assert!(ended.stdout.contains(part), "{part}: {ended:?}");
            }
            for part in ["waiting for completion", "finished in state"] {
                assert!(!ended.stdout.contains(part), "{part}: {ended:?}");
            }
        }
    }
    for (options, code) in [(&["--json"][..], 143), (&["--json", "--exit-status"], 5)] {
        let mut client = our_client();
        client.args(options);
        let client = server.start_client(client, &["test:sleep:600"]);
        client.wait_for("started");
        client.signal("TERM");
        let ended = client.end(PATIENCE);
        let mut objects = objects(&ended);
        objects.retain(|object| object["event"] != "progress");
        let names = ["asking", "started", "aborting", "not_aborted", "over"];
        assert_eq!(events(&objects), names);
        assert_eq!(objects[4]["outcome"], "unknown");
        assert_eq!(ended.code, Some(code), "{ended:?}");
    }
}

#[test]
fn sigterm_ends_the_wait_after_an_abort_too() {
    let server = Server::ours();
    // It waits for 5 s, because a busy machine may deliver the signal late.
    let ended = until("the signal comes in time", PATIENCE, || {
        let client = server.start_client(our_client(), &["-t", "1", "test:sleep:600"]);
        client.wait_for("waiting for completion");
        client.signal("TERM");
        let ended = client.end(PATIENCE);
        (ended.code == Some(143)).then_some(ended)
    });
    assert!(ended.stdout.ends_with("may still run.\n"), "{ended:?}");
}

/// The terminal output of `ztl` with these arguments.
fn to_a_terminal(words: &[&str], environment: &[(&str, &str)]) -> Ended {
    let program = ztl().get_program().to_string_lossy().into_owned();
    let quoted = |word: &&str| format!("'{}'", word.replace('\'', "'\\''"));
    let words: Vec<String> = [program.as_str()].iter().chain(words).map(quoted).collect();
    let mut command = Command::new("script");
    command.args([
        "--quiet",
        "--return",
        "--command",
        &words.join(" "),
        "/dev/null",
    ]);
    command.env("TERM", "xterm").env_remove("NO_COLOR");
    command.envs(environment.iter().copied());
    Process::run(&mut command)
}

/// The text visible on a terminal.
fn on_a_terminal(server: &Server, environment: &[(&str, &str)], task: &str) -> String {
    let line = format!("task-client -r localhost -p {} -s {SCOPE}", server.port);
    let words: Vec<&str> = line.split(' ').chain([task]).collect();
    let ended = to_a_terminal(&words, environment);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    ended.stdout
}

/// Text that controls a terminal: its title, a cleared screen (also by an 8-bit control), an overwritten
/// line, the bell, DEL, and reordered text.
const COMMANDS: &str = "a\x1b]0;owned\x07\x1b[2J\u{9b}2J\rb\x7f\u{202e}c\u{2066}";
/// The same, escaped for a terminal.
const SHOWN: &str = "a\\u001b]0;owned\\u0007\\u001b[2J\\u009b2J\\rb\\u007f\\u202ec\\u2066";

#[test]
fn received_text_cannot_control_the_terminal() {
    let server = Server::ours();
    let port = server.port.to_string();
    let at = ["-r", "localhost", "-p", &port];
    let echo = format!("test:echo:{COMMANDS}");
    let refused = format!("{COMMANDS}:echo:x");
    let plain = [("NO_COLOR", "1")];
    let mut said = vec![
        on_a_terminal(&server, &plain, &echo),
        on_a_terminal(&server, &plain, &refused),
    ];
    for words in [
        &["ps", "--all"][..],
        &["ps", "--all", "--json"],
        &["describe"],
        &["abort", "--scope", COMMANDS, "5"],
        &["task-client", "--json", "-s", SCOPE, &echo],
        // On stderr.
        &["devices", COMMANDS],
    ] {
        said.push(to_a_terminal(&[words, &at[..]].concat(), &plain).stdout);
    }
    said.push(to_a_terminal(&["ps", "-r", COMMANDS, "-c", "/dev/null"], &plain).stdout);
    said.push(to_a_terminal(&["check", COMMANDS], &plain).stdout);
    said.push(to_a_terminal(&["ps", COMMANDS], &plain).stdout);
    for text in &said {
        // Where the client overwrites its progress.
        let text = text.replace("\r\x1b[K", "").replace("\r\n", "\n");
        let command = |c: char| {
            (c.is_control() && c != '\n')
                || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
        };
        assert!(!text.contains(command), "{text:?}");
    }
    for shown in [
        &said[0], &said[1], &said[2], &said[3], &said[6], &said[8], &said[9],
    ] {
        assert!(shown.contains(SHOWN), "{shown:?}");
    }

    // A program gets the bytes unchanged, as from the original.
    let ended = server.start_client(our_client(), &[&echo]).end(PATIENCE);
    let result = format!("Result is '{COMMANDS}'.\n");
    assert!(ended.stdout.ends_with(&result), "{ended:?}");
}

#[test]
fn names_of_devices_and_scopes_stay_on_their_lines() {
    let gateway = Server::gateway(&["gripper=sim:gripper"]);
    gateway.wait_described(&["opens the finger"]);
    let port = gateway.port.to_string();
    let told = Process::run(ztl().args(["devices", "--json", "-p", &port])).stdout;
    let mut told: Value = serde_json::from_str(&told).expect("JSON");
    let device = &mut told[SCOPE]["gripper"];
    device["components"][0]["loss"] = "hold".into();
    let ready = told.clone();
    let device = &mut told[SCOPE]["gripper"];
    device["ready"] = false.into();
    device["problem"] = "the gripper is missing".into();
    let hostile = Value::from(format!("{COMMANDS}\nforged")).to_string();
    let probe =
        format!(r#"{{ztl: 1, version: '9', boot: 7, scopes: {{"{SHOWN}\nforged": {{}}}}}}"#);
    for (told, rest) in [
        (
            ready,
            "without link it goes to its safe state and keeps its position, also when idle",
        ),
        (told, ": not ready: the a\\u001b]0;owned"),
    ] {
        let mut told = told.to_string();
        for name in ["gripper", "finger", "percent"] {
            told = told.replace(name, hostile.trim_matches('"'));
        }
        let probe = probe.clone();
        let server = FakeServer::with_questions(move |request| {
            let (_, question) = request.split_once("-1;").expect("a question");
            let answer = match question {
                "probe" => &probe,
                "devices" => &told,
                _ => r#"{"tasks": [], "more": 0}"#,
            };
            format!("$ztl;5;0;{answer}").into_bytes()
        });
        let port = server.port.to_string();
        let seen = to_a_terminal(&["devices", "-p", &port], &[]);
        let missing = [
            &["devices", "other"][..],
            &["param", "list", "other"],
            &["abort", "--all", "-s", "/other"],
        ];
        let missing = missing.map(|words| to_a_terminal(&[words, &["-p", &port]].concat(), &[]));
        for ended in missing.iter().chain([&seen]) {
            let text = ended.stdout.replace("\r\n", "\n");
            assert!(
                !text.contains(|c: char| c.is_control() && c != '\n'),
                "{text:?}"
            );
            assert!(!text.contains("\nforged"), "{text:?}");
            assert!(text.contains(&format!("{SHOWN}\\nforged")), "{text:?}");
        }
        assert!(seen.stdout.contains(rest), "{seen:?}");
        assert_eq!(seen.code, Some(0), "{seen:?}");
        let codes = missing.map(|ended| ended.code);
        assert_eq!(codes, [Some(1); 3]);
    }
}

#[test]
fn a_log_event_is_one_line_without_control_characters() {
    let scratch = Scratch::new();
    let file = scratch.path("serve.yaml");
    // A program's stderr becomes the reason of its failure, which is logged.
    let says = r"printf 'a\\033[2J\\302\\233b\\342\\200\\256\\r' >&2; exit 3";
    let text = format!("port: 0\nscopes: {{/test: {{h: {{c: {{shell: \"{says}\"}}}}}}}}\n");
    std::fs::write(&file, text).expect("a file");
    for format in ["text", "json"] {
        let mut command = ztl();
        command
            .arg("serve")
            .arg(&file)
            .args(["--log-format", format]);
        let server = Server::start(&mut command);
        let client = server.start_client(our_client(), &["--exit-status", "h:c:x"]);
        assert_eq!(client.end(PATIENCE).code, Some(3));
        let line = server.process.wait_for("has ended as FAILED");
        assert!(line.contains("a\\u001b[2J\\u009bb\\u202e"), "{line:?}");
        let log = server.process.stderr();
        let commands = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
        assert!(!log.contains(commands), "{log:?}");
    }
}

#[test]
fn a_person_sees_progress_and_colours_unless_declined() {
    let gateway = Server::simulated();
    let mut goals = ["100", "0"].into_iter().cycle();
    let seen = until("progress in the first second", PATIENCE, || {
        let goal = goals.next().expect("one after the other");
        let seen = on_a_terminal(&gateway, &[], &format!("gripper:finger:{goal}"));
        seen.contains("\r\x1b[KACCEPTED 0 s: ").then_some(seen)
    });
    assert!(
        seen.contains("finished in state '\x1b[32mCOMPLETED\x1b[0m'"),
        "{seen:?}"
    );
    let plain = on_a_terminal(&gateway, &[("NO_COLOR", "1")], "gripper:finger:0");
    assert!(plain.contains("finished in state 'COMPLETED'"), "{plain:?}");
    let dumb = on_a_terminal(&gateway, &[("TERM", "dumb")], "gripper:finger:10");
    assert!(dumb.contains("finished in state 'COMPLETED'"), "{dumb:?}");
}
