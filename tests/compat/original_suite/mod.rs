//! The original's own test suite, with only its ports changed: against our servers, and with our client against its servers.

use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    Ended, PATIENCE, Process, SCOPE, Scratch, Server, built, python, reserve_port,
};

/// The suite lasts 11 s by itself.
const LIMIT: Duration = Duration::from_secs(120);

const FIXTURES: &str = include_str!("conftest.py");

/// The ports that the suite and its fixtures name.
const PORTS: [&str; 3] = ["7777", "7778", "7779"];

/// The original's tests, from its archive, which lies beside its Python.
#[track_caller]
fn suite() -> PathBuf {
    let python = python();
    let venv = python.ancestors().nth(2).expect("a virtual environment");
    let suite = venv.join("original/ztl-0.3.3/test");
    assert!(
        suite.exists(),
        "{} is missing: run `cargo xtask setup`",
        suite.display()
    );
    suite
}

/// Runs a copy of the suite with these words for pytest; `change` may alter a file by its name.
#[track_caller]
fn pytest(words: &[&str], change: impl Fn(&str, String) -> String) -> Ended {
    let scratch = Scratch::new();
    let ports = PORTS.map(|port| (port, reserve_port().to_string()));
    let write = |name: &str, text: String| {
        let text = ports
            .iter()
            .fold(text, |text, (named, own)| text.replace(named, own));
        std::fs::write(scratch.path(name), text).expect("to write");
    };
    write("conftest.py", FIXTURES.to_owned());
    for file in std::fs::read_dir(suite()).expect("the suite") {
        let file = file.expect("a file");
        let name = file.file_name().into_string().expect("a name");
        let text = std::fs::read_to_string(file.path()).expect("Python");
        write(&name, change(&name, text));
    }
    let mut command = Command::new(python());
    command.args(["-m", "pytest", "-q", "-p", "no:cacheprovider"]);
    command.args(words).current_dir(scratch.path(""));
    command.env("ZTL_COMMAND", built("ztl"));
    Process::start(&mut command).end(LIMIT)
}

#[test]
fn the_originals_suite_passes_against_our_servers() {
    let abort = "test_4_lifecycle.py::TestLifeCycle::test_abort";
    let ended = pytest(&["--deselect", abort], |_, text| text);
    let last = ended.stdout.lines().last().unwrap_or_default();
    assert!(
        last.starts_with("16 passed, 1 deselected"),
        "{}",
        ended.stdout
    );
    assert_eq!(ended.code, Some(0));
}

/// `test_abort` waits for 5 s for a task of 5 s, which may have ended then, and wants it ABORTED all
/// the same: a final state never changes here. With a longer task it passes.
#[test]
fn the_suites_abort_test_passes_with_a_running_task() {
    let ended = pytest(&["-k", "test_abort"], |name, text| {
        if name != "test_4_lifecycle.py" {
            return text;
        }
        let longer = text.replacen("payload = 5\n", "payload = 60\n", 1);
        let (before, _) = longer.split_once("payload = 60").expect("a task of 5 s");
        assert!(before.contains("def test_abort") && !before.contains("def test_completion"));
        longer
    });
    let last = ended.stdout.lines().last().unwrap_or_default();
    assert!(last.starts_with("1 passed"), "{}", ended.stdout);
    assert_eq!(ended.code, Some(0));
}

/// The suite's checks of the original's client, applied to ours.
#[test]
fn our_client_meets_the_originals_suite_at_the_originals_servers() {
    let tests = Server::original();
    for scope in ["/no", "/none"] {
        let remote = RemoteTask::connect(&tests.endpoint(), scope).expect("an address");
        let mut remote = remote.with_timeout(PATIENCE);
        let refused = remote.trigger_payload("does not matter");
        assert!(
            matches!(&refused, Err(ztl_std::TriggerError::Rejected { id, .. }) if id.as_str() == "-1"),
            "{refused:?}"
        );
    }
    let server = Server::simple_original();
    let remote = RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address");
    let mut remote = remote.with_timeout(PATIENCE);
    let refused = remote.trigger_payload("illegal payload");
    assert!(
        matches!(&refused, Err(ztl_std::TriggerError::Rejected { id, .. }) if !id.names_task()),
        "{refused:?}"
    );
    let task = remote.trigger_payload("60").expect("taken");
    let still = remote.wait(&task.id, Some(Duration::from_millis(300)));
    let last = still.expect_err("it runs").last.expect("an answer");
    assert_eq!(last.state, State::Accepted);
    let aborted = remote.abort(task.id).expect("an answer");
    assert_eq!(aborted.state, State::Aborted);
    let task = remote.trigger_payload("1").expect("taken");
    let end = remote.wait(task.id, Some(PATIENCE)).expect("its end");
    assert_eq!((end.state, end.text.as_str()), (State::Completed, "True"));
}
