//! The examples with our client and the original's, under Python 3 and Python 2.7.

use std::path::Path;
use std::process::Command;

use ztl_std::State::{Completed, Failed, Rejected};
use ztl_std::{Subscriber, TriggerError};
use ztl_tests::lab::{
    ABORTED, COMPLETED, OriginalClient, PATIENCE, Process, Scratch, Server, built, connect_to,
    python, python27, reserve_port, until, verify_unit, ztl,
};

use crate::rig::{
    abort, abort_originally, end, is_starved, progress, project, rejection_of, run_task,
    start_originally, trigger_task,
};

/// The example in its own directory, with this one on the path as `python`.
fn example(python: &Path) -> (Scratch, Server) {
    let scratch = Scratch::new();
    let tools = scratch.path("tools");
    std::fs::create_dir(&tools).expect("a directory");
    std::os::unix::fs::symlink(python, tools.join("python")).expect("a link");
    for name in ["robot.yaml", "speak", "turn.py", "rostopic"] {
        let from = project("examples/serve").join(name);
        std::fs::copy(from, scratch.path(name)).expect("to copy");
    }
    // Slower, so that a busy machine sees its progress, and with more time to stop.
    for (name, part, other) in [
        ("turn.py", "sleep(0.05)", "sleep(1)"),
        (
            "robot.yaml",
            "abort: INT ",
            "abort: {signal: INT, grace: 20 s} ",
        ),
    ] {
        let text = std::fs::read_to_string(scratch.path(name)).expect("a text");
        let changed = text.replace(part, other);
        assert_ne!(changed, text);
        std::fs::write(scratch.path(name), changed).expect("to write");
    }
    let mut path = tools.into_os_string();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    let mut command = ztl();
    command
        .args(["serve", "-p", "0", "--publish", "0"])
        .arg(scratch.path("robot.yaml"))
        .env("PATH", path);
    let process = Process::start(&mut command);
    let port = process.wait_for_port("Serving 5 components at /robot, 1 stream at /robot at ");
    (scratch, Server { process, port })
}

const TASKS: [(&str, &str, &str, &str); 4] = [
    (
        "tts",
        "say",
        "good morning",
        "said 'good morning' at 150 words a minute",
    ),
    ("base", "turn", "-45", "{'turned': -45.0}"),
    (
        "ros",
        "cmd_vel",
        "{x: 0.1, turn: -0.5}",
        "/cmd_vel geometry_msgs/Twist {linear: {x: 0.1}, angular: {z: -0.5}}",
    ),
    (
        "ros",
        "cmd_vel",
        "{'x': -0.2}",
        "/cmd_vel geometry_msgs/Twist {linear: {x: -0.2}, angular: {z: 0}}",
    ),
];

#[test]
fn our_client_runs_the_examples() {
    runs_them(&python());
}

/// The scripts of an old robot are older than Python 3.
#[test]
fn the_examples_run_under_python_2() {
    let Some(python) = python27() else {
        return eprintln!("left out: the examples under Python 2.7, which this machine has not");
    };
    let version = Process::run(Command::new(&python).arg("--version"));
    assert!(version.stderr.starts_with("Python 2.7."), "{version:?}");
    runs_them(&python);
}

#[track_caller]
fn runs_them(python: &Path) {
    let (scratch, server) = example(python);
    let mut remote = connect_to(&server.endpoint(), "/robot");
    for (handler, component, goal, result) in TASKS {
        let ended = run_task(&mut remote, [handler, component, goal]);
        assert_eq!(ended, (Completed, result.to_owned()), "{goal}");
    }
    let said = rejection_of(&mut remote, ["ros", "cmd_vel", "{x: 3}"]);
    assert_eq!(
        said,
        "ros:cmd_vel: '3' for x is not a number from -0.3 to 0.3"
    );
    let said = rejection_of(&mut remote, ["base", "turn", "270"]);
    assert_eq!(
        said,
        "base:turn: the goal '270' is not a number from -180 to 180"
    );
    let turn = trigger_task(&mut remote, ["base", "turn", "180"]);
    progress(&mut remote, turn, " degrees");
    let text = abort(&mut remote, turn);
    assert!(text.starts_with("stopped at "), "{text}");
    std::fs::write(scratch.path("brake"), "").expect("to write");
    // On a busy machine Python starts too slowly to reject in time.
    let (state, reason) = until("a watchdog that confirms in time", PATIENCE, || {
        let ended = match remote.trigger("base", "turn", "10") {
            Err(TriggerError::Rejected { reason, .. }) => (Rejected, reason),
            taken => {
                let id = taken.expect("an answer").id.number();
                end(&mut remote, id.expect("a task id"))
            }
        };
        (!is_starved(&ended.1)).then_some(ended)
    });
    let late = "exit code 2: the brake is on";
    assert!([(Rejected, "the brake is on"), (Failed, late)].contains(&(state, reason.as_str())));
}

#[test]
fn the_originals_client_runs_the_examples() {
    let (_scratch, server) = example(&python());
    let mut client = OriginalClient::connect(server.port, "/robot");
    let mut remote = connect_to(&server.endpoint(), "/robot");
    for (handler, component, goal, result) in TASKS {
        let id = start_originally(&mut client, &mut remote, [handler, component, goal]);
        let end = client.end(id);
        assert_eq!(end, (COMPLETED, result), "{goal}");
    }
    let turn = abort_originally(&mut client, &mut remote, ["base", "turn", "180"]);
    assert_eq!(client.trigger("base", "turn", "270").number, -1);
    assert_eq!(client.status(turn).number, ABORTED);
}

#[test]
fn a_subscriber_hears_the_stream_of_the_examples() {
    let (_scratch, server) = example(&python());
    let port = server.process.wait_for_port("Publishing ");
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let mut load = Subscriber::connect(&endpoint, "/robot/load").expect("an address");
    let heard = load.next_within(PATIENCE).expect("it can wait");
    let value = heard.expect("a message").value().expect("a value");
    assert!(value.value().as_f64() >= Some(0.0), "{value:?}");
}

#[test]
fn the_example_configuration_is_valid() {
    let file = project("examples/serve/robot.yaml");
    let ended = Process::run(ztl().arg("serve").arg(file).arg("--check"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended
            .stdout
            .ends_with(": 5 components at /robot, 1 stream at /robot, at 127.0.0.1:12345.\n"),
        "{ended:?}"
    );
}

#[test]
fn systemd_accepts_the_unit() {
    verify_unit(&project("examples/systemd/ztl-serve.service"));
}

#[test]
fn the_manuals_first_example_runs_as_pasted() {
    let manual = std::fs::read_to_string(project("docs/serve.md")).expect("the manual");
    let block = manual
        .split("```")
        .nth(1)
        .and_then(|block| block.strip_prefix("sh\n"));
    let block = block.expect("commands");
    let scratch = Scratch::new();
    std::os::unix::fs::symlink(built("ztl"), scratch.path("ztl")).expect("a link");
    std::fs::copy(project("examples/serve/speak"), scratch.path("espeak-ng")).expect("a copy");
    let mut path = scratch.path("").into_os_string();
    path.push(":");
    path.push(std::env::var_os("PATH").unwrap_or_default());
    // The clients may give up before a server that starts slowly listens.
    let ended = until("the server listens in time", PATIENCE, || {
        let script = block.replace("12345", &reserve_port().to_string());
        let mut shell = Command::new("sh");
        shell.args(["-ec", &format!("{script}kill $!\nwait")]);
        let ended = Process::run(shell.current_dir(scratch.path("")).env("PATH", &path));
        let is_late = ended.stdout.contains("no answer from ") || is_starved(&ended.stdout);
        (!is_late).then_some(ended)
    });
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended
            .stdout
            .starts_with("Nothing is wrong: 2 components at /robot"),
        "{ended:?}"
    );
    assert_eq!(
        ended
            .stdout
            .matches("finished in state 'COMPLETED'")
            .count(),
        2,
        "{ended:?}"
    );
    assert!(ended.stdout.ends_with("Stopped.\n"), "{ended:?}");
}

#[test]
fn init_prints_a_file_for_a_known_robot() {
    for (robot, file) in [
        ("nao", "nao.yaml"),
        ("pepper", "pepper.yaml"),
        ("misty", "misty.yaml"),
        ("reachy-mini", "reachy-mini.yaml"),
        ("fetch", "ros1/fetch.yaml"),
        ("care-o-bot-4", "ros1/care-o-bot-4.yaml"),
        ("turtlebot3", "ros1/turtlebot3.yaml"),
    ] {
        let ended = Process::run(ztl().args(["serve", "--init", robot]));
        let example = std::fs::read_to_string(project("examples/serve").join(file));
        assert_eq!(
            (ended.code, ended.stdout),
            (Some(0), example.expect("an example"))
        );
    }
    let ended = Process::run(ztl().args(["serve", "--init", "pepper2"]));
    assert_eq!(ended.code, Some(2));
    assert!(
        ended.stderr.contains("care-o-bot-4, turtlebot3"),
        "{ended:?}"
    );
    // Without it, a file is required.
    assert_eq!(Process::run(ztl().arg("serve")).code, Some(2));
}
