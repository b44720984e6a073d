//! A stdout that cannot be written, as on a full disk. Needs `/dev/full` of Linux.

use std::process::Command;

use ztl_tests::lab::{
    Ended, PATIENCE, Process, SCOPE, Scratch, Server, built, our_client_at, reserve_port, until,
    ztl,
};

const MESSAGE: &str = "ztl: cannot write the output: No space left on device";

/// `ztl` with these arguments; its stdout cannot be written.
#[track_caller]
fn onto_full_disk(line: &str) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", r#"exec "$0" "$@" > /dev/full"#]);
    command.arg(built("ztl")).args(line.split(' '));
    command
}

/// It has told once that its output was lost, and has this exit code.
#[track_caller]
fn assert_told(line: &str, ended: &Ended, code: i32) {
    assert_eq!(ended.code, Some(code), "{line}: {ended:?}");
    let told = ended.stderr.lines().filter(|line| line.contains(MESSAGE));
    assert_eq!(told.count(), 1, "{line}: {ended:?}");
}

#[test]
fn every_command_fails_when_its_output_cannot_be_written() {
    let server = Server::naps();
    let files = Scratch::new();
    let script = "one: {a: {test: {echo: 1}}}\n";
    std::fs::write(files.path("show.yaml"), script).expect("a file");
    let port = server.port;
    for line in [
        "--help".to_owned(),
        "--version".to_owned(),
        "ps --help".to_owned(),
        "completions bash".to_owned(),
        format!("ps -p {port}"),
        format!("ps --json -p {port}"),
        format!("describe --json -p {port}"),
        format!("abort --all -p {port}"),
        format!("check show.yaml --task test localhost {port} {SCOPE}"),
        format!("run-script -s show.yaml --dry-run --task test localhost {port} {SCOPE}"),
        "run-script -s show.yaml --yes --simulate=0.1".to_owned(),
        format!("task-client --exit-status -r localhost -p {port} -s {SCOPE} nap:for:0"),
        format!("task-client --json -r localhost -p {port} -s {SCOPE} nap:for:0"),
    ] {
        let mut command = onto_full_disk(&line);
        command.current_dir(files.path(""));
        let ended = Process::run(&mut command);
        assert_told(&line, &ended, 120);
    }
    // Another failure keeps its code: a rejected task.
    let line = format!("task-client --exit-status -r localhost -p {port} -s {SCOPE} x:y:z");
    assert_told(&line, &Process::run(&mut onto_full_disk(&line)), 1);
}

#[test]
fn a_task_is_aborted_though_the_output_is_lost() {
    let server = Server::naps();
    let port = server.port.to_string();
    let tasks = || Process::run(ztl().args(["ps", "-p", &port])).stdout;
    let line = format!("task-client -r localhost -p {port} -s {SCOPE} nap:for:100");
    let client = Process::start(&mut onto_full_disk(&line));
    until("the task", PATIENCE, || {
        tasks().contains("nap:for:100").then_some(())
    });
    client.signal("INT");
    assert_told(&line, &client.end(PATIENCE), 130);
    assert_eq!(tasks(), "No task is running.\n");
    // All tasks of others are, too. On a busy machine one may end too late for the answer to its ABORT, which is another failure.
    let (line, ended) = until("the answer to the ABORT tells the end", PATIENCE, || {
        let server = Server::naps();
        let port = server.port.to_string();
        let mut other = our_client_at(server.port);
        let other = Process::start(other.arg("nap:for:100"));
        until("the task", PATIENCE, || {
            let tasks = Process::run(ztl().args(["ps", "-p", &port])).stdout;
            tasks.contains("nap:for:100").then_some(())
        });
        let line = format!("abort --all -p {port}");
        let ended = Process::run(&mut onto_full_disk(&line));
        if ended.code == Some(1) {
            return None;
        }
        assert!(other.end(PATIENCE).stdout.contains("ABORTED"));
        Some((line, ended))
    });
    assert_told(&line, &ended, 120);
}

#[test]
fn a_gateway_goes_on_serving_though_its_output_is_lost() {
    let port = reserve_port();
    let line = format!("gateway -d gripper=sim:gripper -p {port} -s {SCOPE}");
    let gateway = Process::start(&mut onto_full_disk(&line));
    until("a task of its device", PATIENCE, || {
        let mut client = our_client_at(port);
        let ended = Process::run(client.args(["--exit-status", "gripper:finger:10"]));
        (ended.code == Some(0)).then_some(())
    });
    gateway.signal("INT");
    assert_told(&line, &gateway.end(PATIENCE), 120);
}

#[test]
fn a_closed_pipe_is_not_an_error() {
    let mut command = Command::new("bash");
    command.args([
        "-c",
        r#""$0" completions bash | true; exit ${PIPESTATUS[0]}"#,
    ]);
    let ended = Process::run(command.arg(built("ztl")));
    assert_eq!((ended.code, ended.stderr.as_str()), (Some(0), ""));
}
