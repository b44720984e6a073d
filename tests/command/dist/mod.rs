//! The static `ztl` runs on a bare kernel.
//!
//! `cargo xtask dist --check` selects the program and how it runs through the environment: in an
//! emulator of its processor in an empty root (`ZTL_DIST_EMULATOR`), or as on an old kernel (`ZTL_DIST_KERNEL`).
//! The other end is this machine's own build.

mod http;
mod names;
mod naoqi;
mod place;

use std::io::{Read as _, Write as _};
use std::net::TcpStream;

use ztl_std::{RemoteTask, State, Status};
use ztl_tests::lab::{PATIENCE, Process, SCOPE, Server, reserve_port, ztl};

use place::Place;

/// Whether the program has all that runs beside robots: for 64-bit processors.
fn is_full() -> bool {
    let target = std::env::var("ZTL_DIST_TARGET").expect("a target");
    ["x86_64", "aarch64"]
        .iter()
        .any(|processor| target.starts_with(processor))
}

/// The outcome of a healthy run.
#[track_caller]
fn run(remote: &mut RemoteTask, task: [&str; 3]) -> Status {
    let [handler, component, goal] = task;
    let id = remote.trigger(handler, component, goal);
    let id = id.unwrap_or_else(|error| panic!("{task:?}: {error}")).id;
    remote.wait(id, Some(PATIENCE)).expect("its end")
}

#[track_caller]
fn client(server: &Server) -> RemoteTask {
    let remote = RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address");
    // An emulated processor on a busy machine is slow.
    remote.with_timeout(PATIENCE)
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn version_lists_the_build_inputs() {
    let place = Place::new();
    let ended = Process::run(&mut place.ztl("--version"));
    assert_eq!((ended.code, ended.stderr.as_str()), (Some(0), ""));
    let target = std::env::var("ZTL_DIST_TARGET").expect("a target");
    for part in [
        concat!("ztl ", env!("CARGO_PKG_VERSION")),
        "commit: ",
        &format!("target: {target}"),
        "ZeroMQ: ZMTP 3.1 with encryption; without libzmq",
        "with: rustc ",
        ", zig ",
        ", musl ",
    ] {
        assert!(ended.stdout.contains(part), "{part} in {ended:?}");
    }
    assert!(!ended.stdout.contains("commit: unknown"), "{ended:?}");
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn serve_runs_programs() {
    let place = Place::new();
    if !place.can_catch_signals() {
        return; // The end of a program is one.
    }
    let own = place.words_inside();
    let own = own.join("\", \"");
    let config = format!(
        "port: 0\nscopes:\n  {SCOPE}:\n    own:\n      \
         version: {{run: [\"{own}\", \"-V\"]}}\n      \
         wrong: {{run: [\"{own}\", \"keys\"]}}\n      \
         long: {{run: [\"{own}\", \"device\", \"sim:gripper\", \"--on\", \"tcp:127.0.0.1:0\"]}}\n    \
         test: {{echo: echo, sleep: sleep}}\n"
    );
    place.write("robot.yaml", &config);
    let robot = place.path_inside("robot.yaml");
    let mut command = place.ztl("serve");
    let server = Server::start(command.arg(robot));

    let mut remote = client(&server);
    let end = run(&mut remote, ["own", "version", ""]);
    let version = concat!("ztl ", env!("CARGO_PKG_VERSION"));
    assert_eq!((end.state, end.text.as_str()), (State::Completed, version));
    assert_eq!(run(&mut remote, ["own", "wrong", ""]).state, State::Failed);
    assert_eq!(run(&mut remote, ["test", "echo", "hi"]).text, "hi");
    let id = remote.trigger("own", "long", "").expect("taken").id;
    assert_eq!(
        remote.status(&id).expect("an answer").state,
        State::Accepted
    );
    assert_eq!(remote.abort(id).expect("an answer").state, State::Aborted);
    // The original's client runs tasks, too.
    let mut original = server.original_client();
    let id = original.start("own", "version", "");
    assert_eq!(original.end(id).text, version);
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn a_gateway_moves_a_simulated_device() {
    let place = Place::new();
    let mut command = place.ztl("gateway --device gripper=sim:gripper --no-journal -s");
    let server = Server::start(command.args([SCOPE, "-p", "0"]));
    server.wait_ready("gripper");
    let end = run(&mut client(&server), ["gripper", "finger", "3"]);
    assert_eq!(end.state, State::Completed, "{end:?}");
    let port = server.port.to_string();
    let told = Process::run(ztl().args(["devices", "-p", &port]));
    assert!(told.stdout.contains("sim:gripper: ready"), "{told:?}");
    if !place.can_catch_signals() {
        return;
    }
    server.process.signal("TERM");
    assert_eq!(server.process.end(PATIENCE).code, Some(143));
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn its_client_runs_a_task_on_a_local_server() {
    let place = Place::new();
    let server = Server::ours();
    let port = server.port.to_string();
    let mut command = place.ztl("task-client --exit-status -r localhost -s");
    let ended = Process::run(command.args([SCOPE, "-p", &port, "test:echo:from afar"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(ended.stdout.contains("Result is 'from afar'"), "{ended:?}");
    let mut command = place.ztl("task-client --exit-status -r localhost -s");
    let ended = Process::run(command.args([SCOPE, "-p", &port, "test:dance:waltz"]));
    assert_eq!(ended.code, Some(3), "{ended:?}");
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn its_web_console_and_recordings_work_where_they_are_built_in() {
    let place = Place::new();
    let mut web = place.ztl("web --task robot 127.0.0.1 1 /robot -p");
    let port = reserve_port();
    web.arg(port.to_string());
    let mut record = place.ztl("record");
    record.arg(place.path_inside("run.mcap"));
    if !is_full() {
        for (command, name) in [(&mut web, "web"), (&mut record, "record")] {
            let ended = Process::run(command);
            assert_eq!(ended.code, Some(2), "{ended:?}");
            let left_out = format!("this ztl has no '{name}', as the static files");
            assert!(ended.stderr.contains(&left_out), "{ended:?}");
        }
        return;
    }
    let console = Process::start(&mut web);
    console.wait_for("://");
    let page = TcpStream::connect(("127.0.0.1", port)).and_then(|mut stream| {
        stream.write_all(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")?;
        let mut page = String::new();
        stream.read_to_string(&mut page).map(|_| page)
    });
    let page = page.expect("a page");
    assert!(page.starts_with("HTTP/1.1 200 OK\r\n"), "{page}");
    // There is nothing to record.
    let ended = Process::run(&mut record);
    assert_eq!(ended.code, Some(2), "{ended:?}");
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn its_script_plays_on_a_local_server() {
    let place = Place::new();
    let server = Server::ours();
    let port = server.port.to_string();
    let play = |name: &str, script: &str| {
        place.write(name, script);
        let mut command = place.ztl("run-script --yes --task test 127.0.0.1");
        command.args([&port, SCOPE, "-s", &place.path_inside(name)]);
        Process::run(&mut command)
    };
    let ended = play(
        "good.yaml",
        "scene: {one: {test: {echo: hi}}, two: {test: {sleep: 1}}}\n",
    );
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(ended.stdout.contains("STARTING STEP 'two'"), "{ended:?}");
    let told = Process::run(ztl().args(["ps", "--all", "-p", &port]));
    assert!(told.stdout.contains("test:sleep:1"), "{told:?}");
    let ended = play("bad.yaml", "scene: {one: {test: {dance: hi}}}\n");
    assert_eq!(ended.code, Some(1), "{ended:?}");
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn client_and_gateway_encrypt() {
    let place = Place::new();
    for name in ["robot", "anna"] {
        let path = place.path_inside(name);
        let ended = Process::run(place.ztl("keys").arg(path));
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
    let inside = |name: &str| place.path_inside(name);
    let mut command = place.ztl("gateway --device gripper=sim:gripper --no-journal -s");
    command.args([SCOPE, "-p", "0", "--key", &inside("robot.key_secret")]);
    let server = Server::start(command.args(["--client-key", &inside("anna.key")]));
    let port = server.port.to_string();
    server.wait_ready("gripper");
    let ask = |options: &[&str]| {
        let mut command = place.ztl("task-client --exit-status -r localhost -s");
        command.args([SCOPE, "-p", &port]).args(options);
        Process::run(command.arg("gripper:finger:2"))
    };
    let keys = [
        "--key",
        &inside("anna.key_secret"),
        "--server-key",
        &inside("robot.key"),
    ];
    let ended = ask(&keys);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert_ne!(ask(&[]).code, Some(0));
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn the_doctor_reports_a_healthy_system() {
    let place = Place::new();
    let server = Server::ours();
    let port = server.port.to_string();
    let journal = place.path_inside("journal");
    let mut command = place.ztl("doctor --json --journal");
    let ended = Process::run(command.args([&journal, "-p", &port]));
    let told: serde_json::Value =
        serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {ended:?}"));
    let findings = told["findings"].as_array().expect("findings");
    for about in ["kernel", "timer", "random", "journal", "server"] {
        let finding = findings.iter().find(|finding| finding["about"] == about);
        let finding = finding.unwrap_or_else(|| panic!("{about}: {told}"));
        assert_eq!(finding["health"], "good", "{finding}");
    }
    assert_eq!(ended.code, Some(0), "{told}");
}

#[test]
#[ignore = "for `cargo xtask dist --check`"]
fn an_unsupported_kernel_is_reported_in_one_line() {
    let place = Place::new();
    let Some(mut command) = place.ztl_on_kernel("2.6.18") else {
        return; // Only an emulator can say so.
    };
    let ended = Process::run(&mut command);
    let line = "ztl: Linux 2.6.18 is too old: ztl needs 2.6.32 or newer\n";
    assert_eq!(
        (ended.code, ended.stderr.as_str()),
        (Some(1), line),
        "{ended:?}"
    );
}
