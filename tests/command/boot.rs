//! How a robot starts `ztl` at boot: runs the files of `examples/boot` as far as this machine allows.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{Ended, PATIENCE, Process, SCOPE, Scratch, reserve_port, until, ztl};

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../examples/boot")
        .join(name)
}

/// A directory with a configuration, and its port.
fn robot() -> (Scratch, u16) {
    let scratch = Scratch::new();
    let port = reserve_port();
    let config = format!("port: {port}\nscopes:\n  {SCOPE}:\n    test: {{echo: echo}}\n");
    std::fs::write(scratch.path("robot.yaml"), config).expect("a file");
    (scratch, port)
}

#[track_caller]
fn assert_serves(port: u16) {
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let remote = RemoteTask::connect(&endpoint, SCOPE).expect("an address");
    // It may listen only after the command has returned.
    let mut remote = remote.with_timeout(PATIENCE);
    let id = remote.trigger("test", "echo", "hi").expect("taken").id;
    let end = remote.wait(id, Some(PATIENCE)).expect("its end");
    assert_eq!(end.state, State::Completed);
}

#[test]
fn the_init_script_starts_reports_status_and_stops() {
    let (scratch, port) = robot();
    let call = |word: &str| -> Ended {
        let mut command = Command::new("sh");
        command.arg(example("ztl.init")).arg(word);
        command.env("ZTL", ztl().get_program());
        command.env("ZTL_CONFIG", scratch.path("robot.yaml"));
        command.env("ZTL_LOG", scratch.path("ztl.log"));
        command.env("ZTL_PID", scratch.path("ztl.pid"));
        Process::run(&mut command)
    };
    let code = |word: &str| call(word).code;
    assert_eq!(code("status"), Some(3));
    assert_eq!(code("start"), Some(0));
    assert_serves(port);
    let told = call("status");
    assert!(told.stdout.contains("ztl runs"), "{told:?}");
    let again = call("start");
    assert!(again.stdout.contains("runs already"), "{again:?}");
    assert_eq!(code("restart"), Some(0));
    assert_serves(port);
    assert_eq!(code("stop"), Some(0));
    assert_eq!(code("status"), Some(3));
    assert_eq!(code("stop"), Some(0));
    // A wrong configuration is reported at once, and starts nothing.
    std::fs::write(scratch.path("robot.yaml"), "port: none\n").expect("a file");
    let wrong = call("start");
    assert_eq!(wrong.code, Some(2), "{wrong:?}");
    assert_eq!(code("status"), Some(3));
    assert_eq!(code("dance"), Some(2));
}

#[test]
fn the_naoqi_wrapper_accepts_naoqis_options() {
    let (scratch, port) = robot();
    let copy = |from: &Path, to: &str| {
        std::fs::copy(from, scratch.path(to)).expect("a copy");
        let all = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(scratch.path(to), all).expect("its mode");
    };
    copy(Path::new(ztl().get_program()), "ztl");
    copy(&example("ztl-nao"), "ztl-nao");
    let mut command = Command::new(scratch.path("ztl-nao"));
    command
        .args(["--pip", "127.0.0.1", "--pport", "9559"])
        .current_dir("/");
    let process = Process::start(&mut command);
    let log = || std::fs::read_to_string(scratch.path("ztl.log")).unwrap_or_default();
    until("its log", PATIENCE, || {
        log().contains("Serving").then_some(())
    });
    assert_serves(port);
    process.signal("TERM");
    assert_eq!(process.end(PATIENCE).code, Some(143));
}

#[test]
fn each_boot_file_explains_its_installation_and_uses_existing_options() {
    let help = Process::run(ztl().args(["serve", "--help"])).stdout;
    for name in ["ztl.conf", "ztl.init", "ztl-nao"] {
        let text = std::fs::read_to_string(example(name)).expect("a file");
        assert!(text.contains("To install"), "{name}");
        let uses = text
            .lines()
            .filter(|line| !line.trim_start().starts_with('#'));
        for word in uses.flat_map(str::split_whitespace) {
            if word.starts_with("--") {
                assert!(help.contains(word), "{name}: {word}");
            }
        }
    }
}
