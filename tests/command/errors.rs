//! Error messages of the `ztl` command, its exit codes, its help, and its demo.

use std::net::TcpListener;
use std::process::Command;
use std::time::Duration;

use ztl_tests::lab::{
    Ended, PATIENCE, Process, SCOPE, Scratch, Server, in_time, our_client, reserve_port,
    simulated_gripper, until, ztl,
};

/// `ztl` with these arguments; it must exit by itself.
#[track_caller]
fn run(line: &str) -> Ended {
    let words = line.split(' ').filter(|word| !word.is_empty());
    Process::run(ztl().args(words))
}

/// `ztl` with these arguments fails with one line that contains all of `parts`.
#[track_caller]
fn refuses(line: &str, parts: &[&str]) {
    let ended = run(line);
    assert!(
        ended.code.is_some_and(|code| code != 0),
        "{line}: {ended:?}"
    );
    let says = |line: &str| parts.iter().all(|part| line.contains(part));
    let lines = ended.stderr.lines();
    let lines = lines.filter(|line| !line.starts_with("Usage: ") && says(line));
    assert_eq!(lines.count(), 1, "{line}: {parts:?} in {ended:?}");
    assert!(!ended.stderr.contains("panicked"), "{line}: {ended:?}");
    // It never reached the point of serving.
    assert_eq!(ended.stdout, "", "{line}");
}

#[test]
fn an_invalid_device_is_rejected_with_an_example() {
    for (device, parts) in [
        (
            "gripper=usb:1",
            &["unknown kind of device 'usb'", "serial:/dev/ttyACM0"][..],
        ),
        (
            "gripper=/dev/ttyACM0",
            &["unknown kind of device", "serial:/dev/ttyACM0"],
        ),
        ("gripper=serial:", &["incomplete", "serial:/dev/ttyACM0"]),
        (
            "gripper=serial:/dev/x?baud=fast",
            &["'baud=fast'", "?baud=115200"],
        ),
        (
            "gripper=serial:/dev/x?baud=0",
            &["'baud=0'", "?baud=115200"],
        ),
        (
            "gripper=serial:/dev/x?speed=9600",
            &["'speed=9600'", "?baud=115200"],
        ),
        ("gripper=tcp:7000", &["incomplete", "tcp:HOST:PORT"]),
        (
            "gripper=sim:arm",
            &["no simulated device 'arm'", "gripper, head"],
        ),
        ("gripper", &["'gripper'", "NAME=URL"]),
        ("=sim:gripper", &["not a device name"]),
        ("a:b=sim:gripper", &["'a:b' is not a device name"]),
    ] {
        refuses(&format!("gateway --device {device} -p 0 -s /lab"), parts);
    }
}

#[test]
fn a_gateway_that_cannot_serve_says_why() {
    let sim = "gateway --device gripper=sim:gripper";
    refuses("gateway -p 0 -s /lab", &["--device <NAME=URL>"]);
    refuses(&format!("{sim} -s /lab"), &["--port <PORT>"]);
    refuses(&format!("{sim} -p 0"), &["--scope <SCOPE>"]);
    refuses(&format!("{sim} -p http -s /lab"), &["'http'", "--port"]);
    refuses(&format!("{sim} -p 70000 -s /lab"), &["70000", "65535"]);
    refuses(&format!("{sim} -p 0 -s /l;ab"), &["'/l;ab'", "';'", "/lab"]);
    let twice = format!("{sim} --device gripper=sim:head -p 0 -s /lab");
    refuses(&twice, &["two devices are named 'gripper'"]);
    let elsewhere = format!("{sim} -p 0 -s /lab --bind 192.0.2.1");
    refuses(&elsewhere, &["cannot listen", "192.0.2.1", "127.0.0.1"]);
    for (group, kind) in [
        ("224.0.0.1", "multicast"),
        ("[ff02::1]", "multicast"),
        ("::ffff:239.1.2.3", "multicast"),
        ("255.255.255.255", "broadcast"),
    ] {
        let told = format!("is a {kind} address, where no client can connect; use 127.0.0.1");
        for transport in ["native", "libzmq"] {
            let options = format!("--bind {group} --transport {transport}");
            refuses(&format!("{sim} -p 0 -s /lab {options}"), &[&told]);
        }
    }
    let nonsense = format!("{sim} -p 0 -s /lab --bind nonsense");
    refuses(
        &nonsense,
        &["'nonsense' is not an address of this machine", "127.0.0.1"],
    );
    let bogus = format!("{sim} -p 0 -s /lab --bogus");
    refuses(&bogus, &["unexpected argument '--bogus'"]);
}

#[test]
fn a_port_in_use_is_reported() {
    let taken = TcpListener::bind(("0.0.0.0", 0)).expect("a port");
    let port = taken.local_addr().expect("its address").port();
    let named = format!(":{port}: the port is in use");
    let gateway = format!("gateway --device gripper=sim:gripper -p {port} -s /lab");
    refuses(&gateway, &["cannot listen", &named]);
    refuses(
        &format!("demo --once --port {port}"),
        &["cannot listen", &named, "--port"],
    );
    refuses(
        &format!("device sim:head --on tcp:{port}"),
        &["cannot listen", &port.to_string()],
    );

    // This one logs first, as the original does.
    let ended = run(&format!("task-server -p {port} -s /test"));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    let last = ended.stderr.lines().last().unwrap_or_default();
    assert!(last.contains(&named), "{ended:?}");
}

#[test]
fn a_port_of_another_ztl_server_is_reported_as_in_use() {
    let server = Server::ours();
    let gateway = Server::simulated();
    for port in [server.port, gateway.port] {
        let parts = ["cannot listen", "the port is in use"];
        let line = format!("gateway --device gripper=sim:gripper -p {port} -s /lab");
        refuses(&line, &parts);
        refuses(&format!("task-server -p {port} -s /lab"), &parts);
        refuses(&format!("demo --once -p {port}"), &parts);
    }
}

#[test]
fn an_unknown_simulated_device_is_rejected_with_the_known_ones() {
    let places = ["tcp:PORT", "tcp:HOST:PORT", "pty:LINK"];
    for place in [
        "usb",
        "tcp",
        "tcp:",
        "tcp:http",
        "tcp:localhost:",
        "",
        "serial:/dev/x",
    ] {
        let on = format!("--on={place}");
        refuses(&format!("device sim:gripper {on}"), &places);
    }
    refuses("device sim:arm --on pty", &["'arm'", "gripper, head"]);
    refuses("device arm --on pty", &["'arm'", "gripper, head"]);
    refuses("device sim:gripper", &["--on <WHERE>"]);
    refuses("device --on pty", &["<DEVICE>"]);
    let nowhere = "/no/such/directory/gripper";
    refuses(
        &format!("device sim:gripper --on pty:{nowhere}"),
        &[nowhere],
    );

    // A link is replaced, a user's file is not.
    let scratch = Scratch::new();
    let file = scratch.path("file");
    std::fs::write(&file, "precious").expect("to write");
    let name = file.display().to_string();
    refuses(
        &format!("device sim:gripper --on pty:{name}"),
        &["cannot make the link", &name],
    );
    assert_eq!(
        std::fs::read_to_string(&file).expect("the file"),
        "precious"
    );
}

/// The exit code of our client that tells a task's outcome.
#[track_caller]
fn outcome(server: &Server, args: &[&str]) -> (Option<i32>, String) {
    let mut client = our_client();
    client.arg("--exit-status");
    let ended = server.start_client(client, args).end(PATIENCE);
    let last = ended.stdout.lines().last().unwrap_or_default();
    (ended.code, last.to_owned())
}

#[test]
fn the_exit_status_reports_the_outcome() {
    let gateway = Server::simulated();
    // From 0 to 100 it takes 20 s then, and is aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    let tests = Server::ours();
    for (server, args, code, part) in [
        (
            &gateway,
            &["gripper:finger:1"][..],
            0,
            "'COMPLETED' while waiting. Result is '1.0'",
        ),
        (
            &gateway,
            &["arm:finger:40"],
            1,
            "no device 'arm'; there are: gripper, head",
        ),
        (
            &gateway,
            &["gripper:thumb:40"],
            1,
            "no component 'thumb'; it has: finger",
        ),
        (
            &gateway,
            &["gripper:finger:140"],
            1,
            "finger takes 0 to 100 percent",
        ),
        (
            &gateway,
            &["-s", "/x", "gripper:finger:1"],
            1,
            "No controller for scope: /x",
        ),
        (
            &tests,
            &["robot:echo:hi"],
            1,
            "No such handler 'robot', try 'test'.",
        ),
        (
            &tests,
            &["test:dance:waltz"],
            3,
            "No such component 'dance'",
        ),
        (
            &gateway,
            &["-t", "1", "gripper:finger:100"],
            4,
            "aborted. Reply is 'True'",
        ),
    ] {
        let (ended, last) = outcome(server, args);
        assert!(last.contains(part), "{args:?}: '{part}' in '{last}'");
        assert_eq!(ended, Some(code), "{args:?}: {last}");
        // Without the option: always 0, like the original.
        let ended = server.start_client(our_client(), args).end(PATIENCE);
        assert_eq!(ended.code, Some(0), "{args:?}: {ended:?}");
    }
}

#[test]
fn an_unreachable_server_is_reported_with_nothing_sent() {
    let nobody = reserve_port();
    let words = format!("task-client --exit-status -r localhost -p {nobody} -s {SCOPE} a:b:c");
    let ended = in_time(Duration::from_secs(5), || run(&words));
    let server = format!("no answer from tcp://localhost:{nobody}");
    assert!(ended.stdout.contains(&server), "{ended:?}");
    assert!(ended.stdout.contains("nothing was sent"), "{ended:?}");
    assert_eq!(ended.code, Some(5), "{ended:?}");
}

#[test]
fn a_killed_server_leaves_its_task_with_an_unknown_outcome() {
    let mut server = Server::ours_at(reserve_port());
    let mut client = our_client();
    client.arg("--exit-status");
    let client = server.start_client(client, &["-t", "1", "test:sleep:60"]);
    client.wait_for("Initialised task with ID");
    server.process.kill();
    let ended = client.end(PATIENCE);
    let last = ended.stdout.lines().last().unwrap_or_default();
    assert!(last.ends_with("may still run."), "{ended:?}");
    assert!(!ended.stdout.contains("FAILED"), "{ended:?}");
    assert_eq!(ended.code, Some(5), "{ended:?}");
}

#[test]
fn ctrl_c_aborts_what_the_client_started() {
    let gateway = Server::simulated();
    // To the left it takes 10 s then.
    gateway.set_speed("head", "speed", 0.1);
    for (option, code) in [("--timeout=-1", 130), ("--exit-status", 4)] {
        let mut client = our_client();
        client.arg(option);
        let client = gateway.start_client(client, &["head:pan:left"]);
        client.wait_for("Initialised task with ID");
        client.signal("INT");
        let ended = client.end(PATIENCE);
        let last = ended.stdout.lines().last().unwrap_or_default();
        assert!(last.ends_with("aborted. Reply is 'True'."), "{ended:?}");
        assert_eq!(ended.code, Some(code), "{ended:?}");
        let (code, last) = outcome(&gateway, &["head:pan:straight"]);
        assert_eq!(code, Some(0), "{last}");
    }
}

#[test]
fn ctrl_c_ends_every_server() {
    let server = Server::ours();
    server.process.signal("INT");
    let ended = server.process.end(PATIENCE);
    // Like the original's.
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended.stderr.ends_with("ERROR:root:Interrupted, exiting.\n"),
        "{ended:?}"
    );

    let scratch = Scratch::new();
    let link = scratch.path("gripper");
    let device = simulated_gripper(&format!("pty:{}", link.display()));
    assert!(link.is_symlink());
    device.signal("TERM");
    assert_eq!(device.end(PATIENCE).code, Some(143));
    assert!(!link.is_symlink(), "the link is left behind");
}

#[test]
fn every_command_has_help() {
    for (line, part) in [
        ("--help", "Usage: ztl <COMMAND>"),
        ("-h", "gateway"),
        ("help", "task-client"),
        ("demo --help", "--once"),
        ("gateway --help", "sim:gripper"),
        ("device --help", "pty:LINK"),
        ("task-server --help", "--scope"),
        ("task-client --help", "--exit-status"),
        ("task-client -h", "--timeout"),
        ("simple-server --help", "<PORT> <SCOPE>"),
        ("simple-client --help", "<HOST> <PORT> <SCOPE> <REQUEST>"),
        ("remote-task --help", "--config"),
        ("--version", env!("CARGO_PKG_VERSION")),
    ] {
        let ended = run(line);
        assert_eq!(ended.code, Some(0), "{line}: {ended:?}");
        assert!(ended.stdout.contains(part), "{line}: {ended:?}");
        assert_eq!(ended.stderr, "", "{line}");
    }
    for line in ["", "frobnicate", "--frobnicate"] {
        let ended = run(line);
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert!(ended.stderr.contains("Usage: ztl <COMMAND>"), "{line}");
    }
}

#[test]
fn the_demo_completes_every_act() {
    let mut command = ztl();
    let demo = Process::start(command.args(["demo", "--once", "--port", "0"]));
    let ended = demo.end(Duration::from_secs(40));
    // The devices that the scene moves, as the README says.
    let devices = ended
        .stdout
        .lines()
        .filter(|line| line.starts_with("device "));
    assert_eq!(devices.count(), 2, "{ended:?}");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let acts: Vec<&str> = ended
        .stdout
        .lines()
        .filter(|line| line.contains(" accepted "))
        .collect();
    let expected = [
        ("gripper:finger:80", "COMPLETED 80.0 percent"),
        ("head:pan:left", "COMPLETED 90.0 degrees"),
        ("gripper:finger:20", "COMPLETED 20.0 percent"),
        ("head:pan:right", "COMPLETED -90.0 degrees"),
        ("head:pan:straight", "COMPLETED 0.0 degrees"),
    ];
    assert_eq!(acts.len(), expected.len(), "{}", ended.stdout);
    for (act, (task, end)) in acts.iter().zip(expected) {
        assert!(act.contains(task) && act.contains(end), "{task}: {act}");
        // Progress is visible, not only the end.
        assert!(act.contains(" % "), "{act}");
    }
    assert!(ended.stdout.contains("Every task completed."));
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
}

#[test]
fn the_demo_keeps_serving_and_its_suggested_command_works() {
    let mut command = ztl();
    let demo = Process::start(command.args(["demo", "--port", "0"]));
    // The command line for another terminal, word by word as printed.
    let words = until("the invitation", Duration::from_secs(40), || {
        let text = demo.stdout();
        let line = text.lines().find(|line| line.contains("task-client -r"))?;
        Some(
            line.split_whitespace()
                .map(str::to_owned)
                .collect::<Vec<_>>(),
        )
    });
    let mut client = Command::new(&words[0]);
    let ended = Process::run(client.args(&words[1..]));
    assert!(
        ended
            .stdout
            .contains("'COMPLETED' while waiting. Result is '40.0'"),
        "{ended:?}"
    );
    demo.signal("INT");
    assert_eq!(demo.end(PATIENCE).code, Some(0));
}
