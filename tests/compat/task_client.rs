//! Compares `ztl task-client` and `ztl task-server` with the original's tools: each client prints the same for each server, and
//! exits with the same code.

use std::process::Command;

use ztl_tests::lab::{
    ClientOutput, PATIENCE, Process, SCOPE, Scratch, Server, installed, original_client,
    our_client, ours_named, until,
};

use crate::{Clients, same_output, same_output_in_time};

#[track_caller]
fn servers() -> [Server; 2] {
    [Server::original(), Server::ours()]
}

/// Runs both clients against both servers with the same `args`, and checks that all four tell the
/// same, which ends with `last`.
#[track_caller]
fn same(servers: &[Server; 2], args: &[&str], last: &str) -> String {
    same_by(same_output, &our_client, servers, args, last)
}

/// The same with this check, and this client of this project.
#[track_caller]
fn same_by(
    check: fn(&[Server; 2], Clients<'_>, &str) -> String,
    ours: &dyn Fn() -> Command,
    servers: &[Server; 2],
    args: &[&str],
    last: &str,
) -> String {
    let original = |server: &Server| server.start_client(original_client(), args);
    let ours = |server: &Server| server.start_client(ours(), args);
    check(servers, [&original, &ours], last)
}

#[test]
fn tasks_that_end_at_once_are_reported_identically() {
    let servers = servers();
    for goal in ["hi", "", "a:b;c", "it's \"quoted\" — grüße 👍"] {
        let task = format!("test:echo:{goal}");
        let last = format!("finished in state 'COMPLETED' while waiting. Result is '{goal}'.");
        let text = same(&servers, &[&task], &last);
        assert_eq!(text.lines().count(), 4, "{text}");
    }
}

#[test]
fn the_server_prints_a_tasks_output() {
    let servers = servers();
    let last = "finished in state 'COMPLETED' while waiting. Result is 'True'.";
    same(&servers, &["test:print:hello"], last);
    for server in &servers {
        until("the goal printed for both clients", PATIENCE, || {
            let printed = "component: print\ngoal: hello\n".repeat(2);
            (server.process.stdout() == printed).then_some(())
        });
    }
}

#[test]
fn long_tasks_are_reported_identically() {
    let last = "finished in state 'COMPLETED' while waiting. Result is 'True'.";
    let servers = servers();
    same(&servers, &["test:sleep:1"], last);
    same(&servers, &["-t", "5", "test:sleep:1"], last);
}

#[test]
fn a_rejected_abort_is_reported_identically() {
    let last = "finished in state 'COMPLETED' after unsuccessful abort signal. Reply is 'True'.";
    let args = ["-t", "1", "test:sleep:3"];
    let text = same_by(same_output_in_time, &our_client, &servers(), &args, last);
    assert!(text.contains("\nAborting task with ID 'ID'...\n"), "{text}");
}

#[test]
fn a_task_beyond_its_clients_timeout_is_reported_identically() {
    // The original waits 5 s after a rejected abort and then reports the task as finished. So does ours under the
    // original's name.
    let files = Scratch::new();
    let ours = || ours_named(&files, "ztl_task_client");
    let last = "finished in state 'ACCEPTED' after unsuccessful abort signal. Reply is 'None'.";
    let args = ["-t", "1", "test:sleep:9"];
    same_by(same_output_in_time, &ours, &servers(), &args, last);
}

#[test]
fn failed_and_rejected_tasks_are_reported_identically() {
    let servers = servers();
    let unknown = "No such component 'dance', try 'echo/print/sleep'.";
    let number = "invalid literal for int() with base 10: 'soon'";
    let handler = "Controller threw exception: No such handler 'robot', try 'test'.";
    for (task, last) in [
        ("test:dance:waltz", format!("Result is '{unknown}'.")),
        ("test:sleep:soon", format!("Result is '{number}'.")),
        ("robot:echo:hi", format!("triggered: '{handler}'.")),
    ] {
        same(&servers, &[task], &last);
    }
    let last = "triggered: 'No controller for scope: /elsewhere'.";
    same(&servers, &["-s", "/elsewhere", "test:echo:hi"], last);
}

#[test]
fn an_incomplete_task_is_rejected_before_anything_is_sent() {
    let servers = servers();
    for payload in ["test:echo", "test", ""] {
        let text = same(&servers, &[payload], "e.g. 'handler:component:goal'");
        assert!(text.starts_with("Error: Invalid task specification."));
        let client = servers[0].start_client(our_client(), &[payload]);
        let ended = client.end(PATIENCE);
        assert_eq!(ended.code, Some(255));
        assert!(ended.stderr.contains("--scope"), "no help: {ended:?}");
    }
}

#[test]
fn both_clients_report_a_gateway_identically() {
    let gateway = Server::simulated();
    let run = |client, args: &[&str]| gateway.start_client(client, args).end(PATIENCE);
    let both_tell = |args: &[&str]| {
        let clients: [fn() -> Command; 2] = [original_client, our_client];
        clients.map(|client| {
            // From the same place each time.
            for home in ["gripper:finger:0", "head:pan:right"] {
                let there = run(our_client(), &["--exit-status", home]);
                assert_eq!(there.code, Some(0), "{there:?}");
            }
            ClientOutput::of(&run(client(), args), gateway.port)
        })
    };
    for (args, last) in [
        (
            ["gripper:finger:40"],
            "finished in state 'COMPLETED' while waiting. Result is '40.0'.",
        ),
        (
            ["gripper:finger:140"],
            "'gripper:finger:140' refused: finger takes 0 to 100 percent'.",
        ),
        (
            ["arm:finger:40"],
            "'no device 'arm'; there are: gripper, head'.",
        ),
    ] {
        let [original, ours] = both_tell(&args);
        original.assert_ends_with(last);
        assert_eq!(ours, original, "{args:?}");
    }
    // It takes 20 s then, so it still runs when it is aborted.
    gateway.set_speed("head", "speed", 0.1);
    let [original, ours] = both_tell(&["-t", "1", "head:pan:left"]);
    original.assert_ends_with("aborted. Reply is 'True'.");
    assert_eq!(ours, original);
}

#[test]
fn lost_output_has_the_originals_exit_code() {
    let files = Scratch::new();
    let server = Server::ours();
    let port = server.port.to_string();
    // As it is installed: with buffered output.
    let original = installed("ZTL_PYTHON", "venv/bin/python").with_file_name("ztl_task_client");
    ours_named(&files, "ztl_task_client");
    for client in [original, files.path("ztl_task_client")] {
        let mut command = Command::new("sh");
        command.args(["-c", r#"exec "$0" "$@" > /dev/full"#]);
        command.arg(&client).args(["-r", "localhost", "-p", &port]);
        command.args(["-s", SCOPE, "test:echo:hi"]);
        let ended = Process::run(command.env_remove("PYTHONUNBUFFERED"));
        assert_eq!(ended.code, Some(120), "{client:?}: {ended:?}");
        assert!(
            ended.stderr.contains("No space left on device"),
            "{client:?}: {ended:?}"
        );
    }
}
