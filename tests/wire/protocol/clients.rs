//! The clients in other languages, each run as its first lines say.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use ztl_std::{
    ExecutableTask, RunningServer, TaskContext, TaskController, TaskError, TaskRequest, TaskServer,
};
use ztl_tests::lab::{Process, Server, javascript_packages, python, reserve_port};

use super::parallel::{side_by_side, socket};
use crate::socket::TIMEOUT;

/// A client: its source, and the program that it is, without arguments.
#[derive(Clone, Copy)]
struct Client {
    source: &'static str,
    program: fn() -> Command,
}

const CLIENTS: [Client; 3] = [
    Client {
        source: include_str!("../../../examples/clients/client.c"),
        program: c,
    },
    Client {
        source: include_str!("../../../examples/clients/client.mjs"),
        program: javascript,
    },
    Client {
        source: include_str!("../../../examples/clients/client.py"),
        program: || {
            let mut command = Command::new(python());
            command.arg(source("client.py"));
            command
        },
    },
];

fn source(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../examples/clients")
        .join(name)
}

fn c() -> Command {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    let program = PROGRAM.get_or_init(|| {
        let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("client");
        made(&program, |path| {
            let mut cc = Command::new("cc");
            cc.args(["-Wall", "-Wextra", "-Werror", "-o"]).arg(path);
            let ended = Process::run(cc.arg(source("client.c")).arg("-lzmq"));
            assert_eq!(
                ended.code,
                Some(0),
                "libzmq for C is missing: run `cargo xtask setup`\n{}",
                ended.stderr
            );
        })
    });
    Command::new(program)
}

fn javascript() -> Command {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    let program = PROGRAM.get_or_init(|| {
        // Node looks for packages beside the program.
        made(&javascript_packages().join("client.mjs"), |path| {
            std::fs::copy(source("client.mjs"), path).expect("a copy");
        })
    });
    let mut node = Command::new("node");
    node.arg(program);
    node
}

/// Replaces a file as a whole, because another run of these tests may be using it.
fn made(path: &Path, make: impl FnOnce(&Path)) -> PathBuf {
    let fresh = path.with_file_name(format!("{}-being-made", std::process::id()));
    make(&fresh);
    std::fs::rename(&fresh, path).expect("to put it there");
    path.to_owned()
}

/// The output of a client whose INIT is not answered.
const UNKNOWN: &str = "UNKNOWN: no answer, the task may run";

/// Runs a client to its end: it prints this line, and nothing more.
#[track_caller]
fn prints(command: &mut Command, line: &str, code: i32) {
    let what = format!("{command:?}");
    let ended = Process::run(command);
    assert_eq!(
        (ended.stdout, ended.code),
        (format!("{line}\n"), Some(code)),
        "{what}: {}",
        ended.stderr
    );
}

/// Runs every client with these arguments concurrently: returns output and exit code.
#[track_caller]
fn each_prints(endpoint: &str, scope: &str, task: &str, end: &str, code: i32) {
    let run = |client: Client| {
        let [endpoint, scope, task, end] = [endpoint, scope, task, end].map(str::to_owned);
        let run = move || prints((client.program)().args([endpoint, scope, task]), &end, code);
        Box::new(run) as Box<dyn FnOnce() + Send>
    };
    side_by_side(CLIENTS.map(run).into());
}

/// A robot whose `base` ends as the goal says; it has no other component.
fn robot() -> RunningServer {
    struct Robot;
    impl TaskController for Robot {
        fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
            if request.component != "base" {
                let component = &request.component;
                return Err(format!("no component '{component}'; it has: base").into());
            }
            let goal = request.goal.clone();
            Ok(Box::new(move |context: &TaskContext| match goal.as_str() {
                "forward" => {
                    // Longer than a client's pause.
                    context.sleep(Duration::from_millis(150))?;
                    Ok("arrived".to_owned())
                }
                "fall" => Err("fell".into()),
                "stop" => Err(TaskError::aborted("stopped")),
                _ => Ok(goal),
            }))
        }
    }
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").expect("a port");
    server.register("/robot", Robot);
    server.spawn().expect("a thread")
}

#[test]
fn each_client_matches_its_introduction() {
    let server = robot();
    for client in CLIENTS {
        let line = |part: &str| {
            let line = client.source.lines().find(|line| line.contains(part));
            line.unwrap_or_else(|| panic!("no '{part}' in {}", client.source))
        };
        let called = line("tcp://localhost:12345").split_whitespace().rev();
        let called: Vec<_> = called.take(2).collect();
        assert_eq!(called, ["robot:base:forward", "/robot"]);
        assert!(line("prints the outcome, ").contains("`COMPLETED: arrived`"));
    }
    let endpoint = server.endpoint();
    each_prints(
        endpoint,
        "/robot",
        "robot:base:forward",
        "COMPLETED: arrived",
        0,
    );
}

#[test]
fn each_client_reports_every_final_state_and_text() {
    let server = robot();
    let refused = "FAILED: Controller threw exception: no component 'arm'; it has: base";
    for (task, end, code) in [
        // Of every length modulo base64's groups, and with the separators of a message.
        ("robot:base:a", "COMPLETED: a", 0),
        ("robot:base:ab", "COMPLETED: ab", 0),
        ("robot:base:abc", "COMPLETED: abc", 0),
        ("robot:base: 1; 2:3 größer", "COMPLETED:  1; 2:3 größer", 0),
        ("robot:base:fall", "FAILED: fell", 1),
        ("robot:base:stop", "ABORTED: stopped", 1),
        ("robot:arm:up", refused, 1),
    ] {
        each_prints(server.endpoint(), "/robot", task, end, code);
    }
    let unknown = "REJECTED: No controller for scope: /rover";
    each_prints(server.endpoint(), "/rover", "robot:base:a", unknown, 1);
}

#[test]
fn each_client_drives_the_original() {
    let server = Server::original();
    each_prints(
        &server.endpoint(),
        "/test",
        "test:echo:hi",
        "COMPLETED: hi",
        0,
    );
}

#[test]
fn each_client_reports_a_missing_server() {
    let nobody = format!("tcp://127.0.0.1:{}", reserve_port());
    each_prints(&nobody, "/robot", "robot:base:forward", UNKNOWN, 1);
}

/// A server that leaves the first requests unanswered. Runs one client, and returns its requests.
fn forgetful(client: Client, unanswered: &'static [&'static str], end: &str, code: i32) -> String {
    let context = zmq::Context::new();
    let server = socket(&context, zmq::ROUTER);
    server.bind("tcp://127.0.0.1:*").expect("a port");
    let endpoint = server.get_last_endpoint().unwrap().unwrap();
    server.set_rcvtimeo(20).unwrap();
    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let asked = std::thread::spawn(move || {
        let mut asked = String::new();
        let gone = Err(std::sync::mpsc::TryRecvError::Disconnected);
        while stopped.try_recv() != gone {
            let Ok(mut frames) = server.recv_multipart(0) else {
                continue;
            };
            let body = String::from_utf8(frames.pop().unwrap_or_default()).expect("UTF-8");
            let (request, answer) = if body.starts_with("/robot;1;-1;") {
                ("INIT ", "/robot;1;7;taken")
            } else {
                ("STATUS ", "/robot;5;7;arrived")
            };
            let first = !asked.contains(request);
            asked += request;
            if !(first && unanswered.contains(&request)) {
                frames.push(answer.into());
                server.send_multipart(frames, 0).expect("to send");
            }
        }
        asked
    });
    let mut command = (client.program)();
    prints(
        command.args([&endpoint, "/robot", "robot:base:forward"]),
        end,
        code,
    );
    drop(stop);
    asked.join().expect("what was asked")
}

#[test]
fn each_client_repeats_an_unanswered_status() {
    let run = |client| {
        let run = move || {
            let start = std::time::Instant::now();
            let asked = forgetful(client, &["STATUS "], "COMPLETED: arrived", 0);
            assert_eq!(asked, "INIT STATUS STATUS ");
            assert!(start.elapsed() >= TIMEOUT);
        };
        Box::new(run) as Box<dyn FnOnce() + Send>
    };
    side_by_side(CLIENTS.map(run).into());
}

#[test]
fn each_client_never_sends_an_init_twice() {
    let run = |client| {
        let run = move || assert_eq!(forgetful(client, &["INIT "], UNKNOWN, 1), "INIT ");
        Box::new(run) as Box<dyn FnOnce() + Send>
    };
    side_by_side(CLIENTS.map(run).into());
}
