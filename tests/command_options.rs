//! The rules for options that the original's tools have from Python's argparse, and the names under
//! which they are called.

use std::process::Command;

use ztl_tests::lab::{
    PATIENCE, Process, SCOPE, Scratch, Server, Told, built, original_client, our_client, ztl,
};

/// The words of a command line; `PORT` stands for this server's port.
fn words(line: &str, server: &Server) -> Vec<String> {
    let port = server.port.to_string();
    let words = line.split(' ').map(|word| word.replace("PORT", &port));
    words.collect()
}

/// Both clients with these words tell the same, which ends with the echo of `hi`; what ours wrote
/// to stderr.
#[track_caller]
fn both_run(words: &[String], server: &Server) -> String {
    let [original, ours] =
        [original_client(), our_client()].map(|mut client| Process::run(client.args(words)));
    let expected = Told::of(&original, server.port);
    expected.assert_ends_with("finished in state 'COMPLETED' while waiting. Result is 'hi'.");
    assert_eq!(
        Told::of(&ours, server.port),
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
fn what_is_not_known_is_ignored_with_a_warning() {
    let server = Server::ours();
    for (line, ignored) in [
        ("--verbose test:echo:hi", "--verbose"),
        ("--verbose=3 test:echo:hi", "--verbose=3"),
        ("-v test:echo:hi", "-v"),
        ("test:echo:hi surplus", "surplus"),
        ("test:echo:hi --config file", "file"),
    ] {
        let line = format!("-r localhost -p PORT -s /test {line}");
        let stderr = both_run(&words(&line, &server), &server);
        let warning = format!("ztl task-client: warning: ignored {ignored}\n");
        assert!(stderr.contains(&warning), "{line}: {stderr}");
    }
}

/// Both clients refuse these words in the same way: how the tool is used, then what is wrong.
#[track_caller]
fn both_refuse(line: &str) {
    let words: Vec<&str> = line.split(' ').filter(|word| !word.is_empty()).collect();
    let [original, ours] =
        [original_client(), our_client()].map(|mut client| Process::run(client.args(&words)));
    for (ended, name) in [(original, "ztl_task_client"), (ours, "ztl task-client")] {
        assert_eq!(ended.code, Some(2), "{line}: {ended:?}");
        assert_eq!(ended.stdout, "", "{line}");
        let last = ended.stderr.lines().last().unwrap_or_default();
        let error = format!("{name}: error: ");
        assert!(last.starts_with(&error), "{line}: {ended:?}");
        let usage = format!("usage: {name} ");
        assert!(ended.stderr.starts_with(&usage), "{line}: {ended:?}");
    }
}

#[test]
fn what_is_missing_is_refused_with_how_the_tool_is_used() {
    for line in [
        "",
        "-r localhost -p 1 test:echo:hi",
        "-r localhost -s /test test:echo:hi",
        "-p 1 -s /test test:echo:hi",
        "-r localhost -p 1 -s /test",
    ] {
        both_refuse(line);
    }
}

#[test]
fn a_value_that_is_wrong_is_refused_with_how_the_tool_is_used() {
    for line in [
        "-r localhost -p http -s /test test:echo:hi",
        "-r localhost -p 1 -s /test -t soon test:echo:hi",
        "-r localhost -p 1 test:echo:hi -s",
    ] {
        both_refuse(line);
    }
}

/// Our command under another name.
fn link(scratch: &Scratch, name: &str) -> Command {
    let link = scratch.path(name);
    std::os::unix::fs::symlink(built("ztl"), &link).expect("a link");
    Command::new(link)
}

#[test]
fn a_link_with_the_originals_name_is_the_originals_tool() {
    let scratch = Scratch::new();
    let server = Server::test_server(link(&scratch, "ztl_task_server"));
    let task = ["test:echo:hi"];
    let expected = server.start_client(original_client(), &task).end(PATIENCE);
    let expected = Told::of(&expected, server.port);
    expected.assert_ends_with("Result is 'hi'.");
    for name in ["ztl_task_client", "task_client.py"] {
        let client = link(&scratch, name);
        let ended = server.start_client(client, &task).end(PATIENCE);
        assert_eq!(Told::of(&ended, server.port), expected, "{name}");

        let mut client = Command::new(scratch.path(name));
        let refused = Process::run(client.args(["-r", "localhost"]));
        assert_eq!(refused.code, Some(2));
        let usage = format!("usage: {name} ");
        assert!(refused.stderr.starts_with(&usage), "{refused:?}");
    }
    Server::test_server(link(&scratch, "task_server.py"));
}

#[test]
fn a_server_takes_options_by_the_same_rules() {
    let mut command = ztl();
    // The helper adds the port and the scope that count.
    command.args(["task-server", "--verbose", "--po", "1", "--sc=/x"]);
    let server = Server::test_server(command);
    let ended = server.start_client(original_client(), &["test:echo:hi"]);
    Told::of(&ended.end(PATIENCE), server.port).assert_ends_with("Result is 'hi'.");
    server.process.wait_for("warning: ignored --verbose");
}

#[test]
fn a_servers_limits_are_chosen_by_options() {
    let mut command = ztl();
    command.args(["task-server", "--limit", "running=1", "--limit=keep=10min"]);
    let server = Server::test_server(command);
    let mut client = server.original_client();
    let sleeping = client.start("test", "sleep", "20");
    let ended = server.start_client(our_client(), &["test:echo:hi"]);
    let told = Told::of(&ended.end(PATIENCE), server.port);
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
            "'none' is no whole number above 0",
        ),
        (
            "gateway -p 0 -s /x -d a=sim:gripper --limit keep=long",
            "'long' is no time; write 10min or 1h",
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
            .contains("lab.yaml:5:9: '0' is no whole number above 0"),
        "{ended:?}"
    );
}

#[test]
fn a_tool_that_is_not_there_yet_says_so_under_each_of_its_names() {
    let scratch = Scratch::new();
    for tool in ["simple_publisher", "simple_subscriber"] {
        let mut plain = ztl();
        plain.arg(tool.replace('_', "-"));
        for mut command in [
            link(&scratch, &format!("ztl_{tool}")),
            link(&scratch, &format!("{tool}.py")),
            plain,
        ] {
            command.args(["-p", "1", "-s", SCOPE, "--verbose", "x"]);
            let ended = Process::run(&mut command);
            assert_eq!(ended.code, Some(1), "{command:?}: {ended:?}");
            assert_eq!(ended.stdout, "");
            let line = ended.stderr.trim_end();
            assert!(line.contains("this tool is not there yet"), "{line}");
            assert_eq!(line.lines().count(), 1, "{line}");
        }
    }
}
