//! Options by the rules of Python's argparse, and the names under which the original's tools are called.

use std::net::TcpListener;
use std::process::Command;

use ztl_tests::lab::{
    ClientOutput, Ended, PATIENCE, Process, SCOPE, Scratch, Server, original_client, original_tool,
    our_client, ours_named, ztl,
};

/// The arguments of a command line; `PORT` is replaced by this server's port.
fn words(line: &str, server: &Server) -> Vec<String> {
    let port = server.port.to_string();
    let words = line.split(' ').map(|word| word.replace("PORT", &port));
    words.collect()
}

/// Both clients, ours under the original's name, print the same for these arguments and end with the echo of
/// `hi`; returns what ours wrote to stderr.
#[track_caller]
fn both_run(words: &[String], server: &Server) -> String {
    let scratch = Scratch::new();
    let [original, ours] = [original_client(), ours_named(&scratch, "ztl_task_client")]
        .map(|mut client| Process::run(client.args(words)));
    let expected = ClientOutput::of(&original, server.port);
    expected.assert_ends_with("finished in state 'COMPLETED' while waiting. Result is 'hi'.");
    assert_eq!(
        ClientOutput::of(&ours, server.port),
        expected,
        "{words:?}: {ours:?}"
    );
    ours.stderr
}

#[test]
fn options_may_be_shortened_joined_and_repeated() {
    let server = Server::ours();
    for line in [
        "--remote localhost --port PORT --scope /test test:echo:hi",
        "--rem localhost --po PORT --sc /test test:echo:hi",
        "--remote=localhost --port=PORT --scope=/test test:echo:hi",
        "--rem=localhost --po=PORT --sc=/test --ti=-1 test:echo:hi",
        // Ours has more options with this prefix.
        "--r localhost --p PORT --s /test --t 5 test:echo:hi",
        "-rlocalhost -pPORT -s/test -t-1 test:echo:hi",
        // The last one wins.
        "-p 1 -r nowhere.invalid -s /x -p PORT -r localhost -s /test test:echo:hi",
        "--po=1 -p PORT --rem=nowhere.invalid -r localhost -s /test test:echo:hi",
        "test:echo:hi -t 5 -s /test -p PORT -r localhost",
    ] {
        let stderr = both_run(&words(line, &server), &server);
        assert!(!stderr.contains("warning"), "{line}: {stderr}");
    }
}

#[test]
fn numbers_are_read_as_python_reads_them() {
    let server = Server::ours();
    let mut spaced = words("-r localhost -s /test test:echo:hi -p", &server);
    spaced.push(format!(" {} ", server.port));
    both_run(&spaced, &server);
    let line = "-r localhost -s /test -t +5 -p +PORT test:echo:hi";
    both_run(&words(line, &server), &server);
}

#[test]
fn under_the_originals_name_unknown_arguments_are_ignored_with_a_warning() {
    let server = Server::ours();
    for (line, ignored) in [
        ("--verbose test:echo:hi", "--verbose"),
        ("--verbose=3 test:echo:hi", "--verbose=3"),
        ("-v test:echo:hi", "-v"),
        ("test:echo:hi surplus", "surplus"),
        ("test:echo:hi --config file", "file"),
        ("--exit-staus test:echo:hi", "--exit-staus"),
    ] {
        let line = format!("-r localhost -p PORT -s /test {line}");
        let stderr = both_run(&words(&line, &server), &server);
        let warning = format!("ztl_task_client: warning: ignored {ignored}\n");
        assert!(stderr.contains(&warning), "{line}: {stderr}");
    }
}

#[test]
fn under_the_originals_name_nothing_is_ignored_beside_an_option_of_ours() {
    let names = Scratch::new();
    for (tool, line, unknown, ours) in [
        (
            "ztl_run_script",
            "-s SCRIPT -c CONFIG --yes --simualte",
            "--simualte",
            "--yes",
        ),
        (
            "run_script.py",
            "--dryrun -s SCRIPT -c CONFIG --ye",
            "--dryrun",
            "--yes",
        ),
        (
            "ztl_run_script",
            "-s SCRIPT -c CONFIG --scene=scene surplus",
            "surplus",
            "--scene",
        ),
        (
            "ztl_task_client",
            "-r localhost -p ROBOT -s /test --json --exit-staus a:b:c",
            "--exit-staus",
            "--json",
        ),
        (
            "ztl_remote_task",
            "-c CONFIG --timout 3 --exit-status robot a:b:c",
            "--timout",
            "--exit-status",
        ),
    ] {
        let ended = sends_nothing_as(ours_named(&names, tool), line);
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert_eq!(ended.stdout, "", "{line}");
        let error = format!(
            "{tool}: error: unexpected argument '{unknown}'; beside {ours}, which the original does not have, nothing is ignored"
        );
        assert!(ended.stderr.contains(&error), "{line}: {ended:?}");
    }
}

/// Runs `ztl` with these arguments; `ROBOT` is replaced by a port that notices every connection.
#[track_caller]
fn sends_nothing(line: &str) -> Ended {
    sends_nothing_as(ztl(), line)
}

#[track_caller]
fn sends_nothing_as(mut command: Command, line: &str) -> Ended {
    let robot = TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    robot.set_nonblocking(true).expect("to ask it");
    let port = robot.local_addr().expect("its address").port().to_string();
    let scratch = Scratch::new();
    let [script, config] = ["show.yaml", "remotes.yaml"].map(|name| scratch.path(name));
    std::fs::write(&script, "scene: {step: {robot: {arm: up}}}\n").expect("a file");
    let remotes = format!("remotes: {{robot: {{host: localhost, port: {port}, scope: /test}}}}\n");
    std::fs::write(&config, remotes).expect("a file");
    let words = line.split(' ').map(|word| match word {
        "ROBOT" => port.clone(),
        "SCRIPT" => script.display().to_string(),
        "CONFIG" => config.display().to_string(),
        word => word.to_owned(),
    });
    let ended = Process::run(command.args(words));
    let connected = robot.accept().map(|(_, who)| who);
    assert!(connected.is_err(), "{line}: {connected:?} {ended:?}");
    ended
}

#[test]
fn our_tools_reject_unknown_arguments_and_send_nothing() {
    for (line, wrong, meant) in [
        (
            "run-script -s SCRIPT -c CONFIG --yes --dryrun",
            "--dryrun",
            "--dry-run",
        ),
        (
            "run-script -s SCRIPT -c CONFIG --yes --simualte",
            "--simualte",
            "--simulate",
        ),
        (
            "run-script -s SCRIPT -c CONFIG --yes --simualte=2",
            "--simualte",
            "--simulate",
        ),
        (
            "run-script -s SCRIPT -c CONFIG --yes surplus",
            "surplus",
            "",
        ),
        ("run-script -s SCRIPT -c CONFIG --yes -x", "-x", ""),
        (
            "task-client --exit-staus -r localhost -p ROBOT -s /test a:b:c",
            "--exit-staus",
            "--exit-status",
        ),
        (
            "task-client -r localhost -p ROBOT -s /test a:b:c surplus",
            "surplus",
            "",
        ),
        (
            "task-client -r localhost -p ROBOT -s /test -x a:b:c",
            "-x",
            "",
        ),
        (
            "remote-task -c CONFIG --timout 3 robot a:b:c",
            "--timout",
            "--timeout",
        ),
        ("remote-task -c CONFIG robot a:b:c surplus", "surplus", ""),
        (
            "simple-client localhost ROBOT /test --jsno",
            "--jsno",
            "--json",
        ),
        (
            "simple-client localhost ROBOT /test 5 surplus",
            "surplus",
            "",
        ),
        (
            "task-server -p 0 -s /test --limt running=1",
            "--limt",
            "--limit",
        ),
        ("simple-server 0 /test surplus", "surplus", ""),
        ("abort -p ROBOT 5 --scop=/test --forec", "--forec", ""),
        ("ps -p ROBOT surplus", "surplus", ""),
    ] {
        let ended = sends_nothing(line);
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert_eq!(ended.stdout, "", "{line}");
        let error = format!("error: unexpected argument '{wrong}' found");
        assert!(ended.stderr.starts_with(&error), "{line}: {ended:?}");
        let tip = format!("did you mean {meant}?");
        assert!(
            meant.is_empty() || ended.stderr.contains(&tip),
            "{line}: {ended:?}"
        );
    }
}

#[test]
fn under_the_originals_name_help_omits_unused_variables() {
    let scratch = Scratch::new();
    let mut client = ours_named(&scratch, "ztl_task_client");
    let told = Process::run(client.arg("-h")).stdout;
    assert!(told.contains("Port of the server"), "{told}");
    assert!(!told.contains("$ZTL_"), "{told}");
    // As the help says, all of them are required.
    let variables = [
        ("ZTL_HOST", "localhost"),
        ("ZTL_PORT", "1"),
        ("ZTL_SCOPE", "/x"),
    ];
    let mut client = ours_named(&scratch, "ztl_task_client");
    let ended = Process::run(client.arg("test:echo:1").envs(variables));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(
        Process::run(ztl().args(["task-client", "-h"]))
            .stdout
            .contains("$ZTL_PORT")
    );
}

#[test]
fn under_the_originals_name_clients_send_their_payload_unchanged() {
    let server = Server::simple_original();
    let port = server.port.to_string();
    let scratch = Scratch::new();
    for request in ["-h", "--json", "--exit-status", "-x y:y:z", "--"] {
        let [original, ours] = [
            original_tool("ztl_simple_client"),
            ours_named(&scratch, "ztl_simple_client"),
        ]
        .map(|mut tool| {
            let ended = Process::run(tool.args(["localhost", &port, SCOPE, request]));
            ClientOutput::of(&ended, server.port)
        });
        original.assert_ends_with(&format!("int() with base 10: '{request}''."));
        assert_eq!(ours, original, "{request}");
    }

    let server = Server::ours();
    for payload in ["-x y:y:z", "-5", "- :a:b"] {
        let told = [original_client(), ours_named(&scratch, "ztl_task_client")].map(|client| {
            let ended = server.start_client(client, &[payload]).end(PATIENCE);
            ClientOutput::of(&ended, server.port)
        });
        let [original, ours] = told;
        assert_eq!(ours, original, "{payload}");
    }
    let line = "-r localhost -p PORT -s /test -- test:echo:hi";
    both_run(&words(line, &server), &server);
}

#[test]
fn invalid_addresses_give_the_originals_exit_codes() {
    let scratch = Scratch::new();
    for (tool, line, code) in [
        ("ztl_task_client", "-r localhost -p 99999 -s /test a:b:c", 0),
        ("ztl_task_client", "-r localhost -p 65536 -s /test a:b:c", 0),
        ("ztl_task_client", "-r localhost -p -1 -s /test a:b:c", 1),
        (
            "ztl_task_client",
            "-r localhost -p -99999 -s /test a:b:c",
            1,
        ),
        ("ztl_task_client", "-r localhost -p http -s /test a:b:c", 2),
        ("ztl_simple_client", "localhost 99999 /test x", 0),
        ("ztl_simple_client", "localhost -1 /test x", 1),
        ("ztl_simple_client", "localhost http /test x", 1),
        ("ztl_task_client", "-r ipc:///x -p 1 -s /test a:b:c", 1),
        ("ztl_simple_client", "tcp://localhost 1 /test x", 1),
    ] {
        let [original, ours] = [original_tool(tool), ours_named(&scratch, tool)]
            .map(|mut tool| Process::run(tool.args(line.split(' '))));
        assert_eq!(
            (original.code, ours.code),
            (Some(code), Some(code)),
            "{line}: {ours:?}"
        );
        // Except for the reason, which ours gives in English.
        let said = |ended: &Ended| -> Vec<String> {
            let lines = ended.stdout.lines().map(|line| line.split(": '").next());
            lines.flatten().map(str::to_owned).collect()
        };
        if !line.contains("http") {
            assert_eq!(said(&ours), said(&original), "{line}");
        }
        assert!(!ours.stderr.contains("panicked"), "{ours:?}");
    }
    for port in ["99999", "-1"] {
        let ended = sends_nothing(&format!(
            "task-client -r localhost -p={port} -s /test a:b:c"
        ));
        assert_eq!(ended.code, Some(2), "{ended:?}");
        assert!(ended.stderr.contains("65535"), "{ended:?}");
    }
}

#[test]
fn a_server_without_a_valid_address_never_starts() {
    let names = Scratch::new();
    for (line, code, said) in [
        ("ztl task-server -p 99999 -s /x", 2, "65535"),
        ("ztl task-server -p=-1 -s /x", 2, "65535"),
        ("ztl simple-server 99999 /x", 2, "65535"),
        ("ztl gateway -p 99999 -s /x -d a=sim:gripper", 2, "65535"),
        ("ztl_task_server -p 99999 -s /x", 2, "65535"),
        ("ztl_task_server -p -1 -s /x", 2, "65535"),
        ("ztl_simple_server 99999 /x", 1, "65535"),
        ("ztl_simple_server -1 /x", 1, "65535"),
        ("ztl task-server -p 0 -s /x;3", 2, "';'"),
        ("ztl simple-server 0 /x;3", 2, "';'"),
        ("ztl gateway -p 0 -s /x;3 -d a=sim:gripper", 2, "';'"),
        ("ztl_task_server -p 0 -s /x;3", 2, "';'"),
        ("ztl_simple_server 0 /x;3", 1, "';'"),
    ] {
        let (tool, rest) = line.split_once(' ').expect("arguments");
        let mut command = match tool {
            "ztl" => ztl(),
            named => ours_named(&names, named),
        };
        let ended = Process::run(command.args(rest.split(' ')));
        assert_eq!(ended.code, Some(code), "{line}: {ended:?}");
        assert!(ended.stderr.contains(said), "{line}: {ended:?}");
    }
}

#[test]
fn an_endpoint_is_not_taken_for_a_host() {
    let written = "'tcp://lamp:7' is not a host; write lamp as the host, and 7 as the port";
    let other = "'ipc:///x' is not a host; a host is a name or an address, as 192.168.1.7";
    for (line, told) in [
        ("ps -r tcp://lamp:7", written),
        ("ps -r tcp://lamp:7 -p 1", written),
        ("describe -r ipc:///x", other),
        ("abort --all -r ipc:///x -p 1", other),
        ("doctor -r ipc:///x -p 1", other),
        ("task-client -r ipc:///x -p 1 -s /test a:b:c", other),
        ("simple-client ipc:///x 1 /test x", other),
    ] {
        let ended = sends_nothing(line);
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert!(ended.stderr.contains(told), "{line}: {ended:?}");
    }
}

/// Both clients, ours under the original's name, reject these arguments in the same way: with the usage
/// and then the error.
#[track_caller]
fn both_refuse(line: &str) {
    let scratch = Scratch::new();
    let words: Vec<&str> = line.split(' ').filter(|word| !word.is_empty()).collect();
    let tools = [original_client(), ours_named(&scratch, "ztl_task_client")];
    for ended in tools.map(|mut client| Process::run(client.args(&words))) {
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert_eq!(ended.stdout, "", "{line}");
        let last = ended.stderr.lines().last().unwrap_or_default();
        assert!(
            last.starts_with("ztl_task_client: error: "),
            "{line}: {ended:?}"
        );
        assert!(
            ended.stderr.contains("usage: ztl_task_client "),
            "{line}: {ended:?}"
        );
    }
}

#[test]
fn a_missing_argument_is_rejected_with_the_usage() {
    for line in [
        "",
        "-r localhost -p 1 -s /test --json:y:z",
        "-r localhost -p 1 -s -x test:echo:hi",
        "-r localhost -p 1 test:echo:hi",
        "-r localhost -s /test test:echo:hi",
        "-p 1 -s /test test:echo:hi",
        "-r localhost -p 1 -s /test",
    ] {
        both_refuse(line);
    }
}

#[test]
fn an_invalid_value_is_rejected_with_the_usage() {
    for line in [
        "-r localhost -p http -s /test test:echo:hi",
        "-r localhost -p 1 -s /test -t soon test:echo:hi",
        "-r localhost -p 1 test:echo:hi -s",
    ] {
        both_refuse(line);
    }
}

#[test]
fn a_link_with_an_original_name_behaves_like_that_tool() {
    let scratch = Scratch::new();
    let server = Server::test_server(ours_named(&scratch, "ztl_task_server"));
    let task = ["test:echo:hi"];
    let expected = server.start_client(original_client(), &task).end(PATIENCE);
    let expected = ClientOutput::of(&expected, server.port);
    expected.assert_ends_with("Result is 'hi'.");
    for name in ["ztl_task_client", "task_client.py"] {
        let client = ours_named(&scratch, name);
        let ended = server.start_client(client, &task).end(PATIENCE);
        assert_eq!(ClientOutput::of(&ended, server.port), expected, "{name}");

        let mut client = Command::new(scratch.path(name));
        let refused = Process::run(client.args(["-r", "localhost"]));
        assert_eq!(refused.code, Some(2));
        let usage = format!("usage: {name} ");
        assert!(refused.stderr.starts_with(&usage), "{refused:?}");
    }
    Server::test_server(ours_named(&scratch, "task_server.py"));
}

#[test]
fn a_server_takes_options_by_the_same_rules() {
    let scratch = Scratch::new();
    let mut command = ours_named(&scratch, "ztl_task_server");
    // The helper adds the valid port and scope.
    command.args(["--verbose", "--po", "1", "--sc=/x"]);
    let server = Server::test_server(command);
    let ended = server.start_client(original_client(), &["test:echo:hi"]);
    ClientOutput::of(&ended.end(PATIENCE), server.port).assert_ends_with("Result is 'hi'.");
    server.process.wait_for("warning: ignored --verbose");
}

#[test]
fn options_set_the_servers_limits() {
    let mut command = ztl();
    command.args(["task-server", "--limit", "running=1", "--limit=keep=10min"]);
    let server = Server::test_server(command);
    let mut client = server.original_client();
    let sleeping = client.start("test", "sleep", "20");
    let ended = server.start_client(our_client(), &["test:echo:hi"]);
    let told = ClientOutput::of(&ended.end(PATIENCE), server.port);
    told.assert_ends_with("too many tasks are running, wait for one to end'.");
    assert_eq!(client.status(sleeping).number, 1);

    for (tool, wrong) in [
        (
            "task-server -p 0 -s /x --limit tasks=1",
            "there is no limit 'tasks'; there are: message",
        ),
        (
            "task-server -p 0 -s /x --limit running",
            "write a limit as running=100",
        ),
        (
            "simple-server 0 /x --limit running=none",
            "'none' is not a whole number above 0",
        ),
        (
            "gateway -p 0 -s /x -d a=sim:gripper --limit keep=long",
            "'long' is not a duration; write 10min or 1h",
        ),
    ] {
        let ended = Process::run(ztl().args(tool.split(' ')));
        assert_ne!(ended.code, Some(0), "{ended:?}");
        assert!(ended.stderr.contains(wrong), "{tool}: {ended:?}");
    }
    let scratch = Scratch::new();
    let file = scratch.path("lab.yaml");
    std::fs::write(
        &file,
        "scope: /lab\nport: 1\nlimits:\n  runing: 3\n  held: 0\n",
    )
    .expect("a file");
    let ended = Process::run(ztl().arg("gateway").arg(&file).arg("--check"));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(
        ended
            .stderr
            .contains("lab.yaml:4:3: unknown key 'runing'; did you mean 'running'?"),
        "{ended:?}"
    );
    assert!(
        ended
            .stderr
            .contains("lab.yaml:5:9: '0' is not a whole number above 0"),
        "{ended:?}"
    );
}
