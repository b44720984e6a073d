//! Compares `ztl simple-server`, `ztl simple-client` and `ztl remote-task` with the original's tools.

use std::process::Command;

use ztl_tests::lab::{
    ClientOutput, Ended, PATIENCE, Process, REJECTED, SCOPE, Scratch, Server, original_tool,
    ours_named, reserve_port, until, ztl,
};

use crate::{Clients, same_output, same_output_in_time};

/// One of our tools by its own name.
fn our_tool(name: &str) -> Command {
    let mut command = ztl();
    command.arg(name);
    command
}

/// Runs the original's and our `simple-client` against both servers at once, and checks that all
/// four tell the same, which ends with `last`.
#[track_caller]
fn same(servers: &[Server; 2], request: &str, last: &str) -> String {
    same_by(same_output, servers, request, last)
}

/// The same with this check.
#[track_caller]
fn same_by(
    check: fn(&[Server; 2], Clients<'_>, &str) -> String,
    servers: &[Server; 2],
    request: &str,
    last: &str,
) -> String {
    let start = |mut client: Command, server: &Server| {
        let port = server.port.to_string();
        Process::start(client.args(["localhost", &port, SCOPE, request]))
    };
    let original = |server: &Server| start(original_tool("ztl_simple_client"), server);
    let ours = |server: &Server| start(our_tool("simple-client"), server);
    check(servers, [&original, &ours], last)
}

/// The output of a simple server, without its ids. Keeps repeated requests once, and leaves out the request to hold
/// a reply, which only our client sends to our server.
fn printed(server: &Server) -> Vec<String> {
    let line = |line: &str| match line.split('\'').collect::<Vec<_>>().as_slice() {
        [before, _id, after] => format!("{before}'ID'{after}"),
        _ => line.to_owned(),
    };
    let text = server.process.stdout();
    let mut lines: Vec<String> = Vec::new();
    for line in text.lines().map(line) {
        let status = line.starts_with("Status ");
        if !(status && (line.contains("(wait ") || lines.contains(&line))) {
            lines.push(line);
        }
    }
    lines
}

#[test]
fn simple_servers_and_clients_print_the_same() {
    let servers = [Server::simple_original(), Server::simple_ours()];
    let last = "finished while waiting. Result is 'True'.";
    let text = same(&servers, "1", last);
    assert!(text.contains("Waiting maximum 5s"), "{text}");
    let last =
        "triggered: 'Controller threw exception: invalid literal for int() with base 10: 'soon''.";
    same(&servers, "soon", last);
    same(&servers, "-3", "finished while waiting. Result is 'True'.");
    // Longer than the client waits.
    same(&servers, "30", "aborted. Reply is 'True'.");
    let [original, ours] = servers.each_ref().map(|server| {
        until("the last abort", PATIENCE, || {
            let lines = printed(server);
            let aborted = lines.iter().filter(|line| line.starts_with("Task aborted"));
            (aborted.count() == 2).then_some(lines)
        })
    });
    let sorted = |mut lines: Vec<String>| {
        lines.sort();
        lines
    };
    let asked = "Status Task ID 'ID' (5)...".to_owned();
    assert!(original.contains(&asked), "{original:?}");
    assert_eq!(sorted(ours), sorted(original));
}

#[test]
fn a_rejected_abort_of_the_simple_client_is_reported_identically() {
    let servers = [Server::original(), Server::ours()];
    // test:sleep:7, which a client aborts after 5 s.
    let last = "finished after unsuccessful abort signal. Reply is 'False'.";
    same_by(same_output_in_time, &servers, "dGVzdDpzbGVlcDo3", last);
}

#[test]
fn a_simple_tool_without_arguments_exits_like_the_original() {
    for (tool, args) in [
        ("simple_server", &[][..]),
        ("simple_server", &["12345"]),
        ("simple_client", &["localhost", "1", "/test"]),
    ] {
        let scratch = Scratch::new();
        let tool = format!("ztl_{tool}");
        let original = Process::run(original_tool(&tool).args(args));
        let ours = Process::run(ours_named(&scratch, &tool).args(args));
        assert_eq!((original.code, ours.code), (Some(1), Some(1)), "{ours:?}");
        assert!(ours.stderr.starts_with("usage: ztl_simple_"), "{ours:?}");
    }
}

#[test]
fn a_simple_server_answers_unknown_ids_like_the_original() {
    for server in [Server::simple_original(), Server::simple_ours()] {
        let mut client = server.original_client();
        assert_eq!(client.status(77), (REJECTED, "Invalid ID"));
        assert_eq!(client.abort(77), (REJECTED, "Invalid ID"));
    }
    for server in [Server::original(), Server::ours()] {
        assert_eq!(
            server.original_client().status(77),
            (REJECTED, "Invalid ID '77'")
        );
    }
}

#[test]
fn ctrl_c_ends_the_simple_server_like_the_original() {
    for server in [Server::simple_original(), Server::simple_ours()] {
        server.process.signal("INT");
        let ended = server.process.end(PATIENCE);
        assert_eq!(ended.code, Some(1), "{ended:?}");
        let last = ended.stderr.lines().last();
        assert_eq!(last, Some("ERROR:root:Interrupted, exiting."));
    }
}

/// Both `remote-task`s with this configuration and these words.
#[track_caller]
fn both(config: &str, words: &[&str]) -> [Ended; 2] {
    let scratch = Scratch::new();
    std::fs::write(scratch.path("zmq-remotes.yaml"), config).expect("to write");
    [original_tool("ztl_remote_task"), our_tool("remote-task")].map(|mut tool| {
        tool.env("XDG_CONFIG_HOME", scratch.path(""));
        Process::run(tool.args(words))
    })
}

#[track_caller]
fn both_tell(port: u16, config: &str, words: &[&str], last: &str) -> [Ended; 2] {
    let ended = both(config, words);
    let [original, ours] = ended.each_ref().map(|ended| ClientOutput::of(ended, port));
    original.assert_ends_with(last);
    assert_eq!(ours, original, "{words:?}: {ended:?}");
    ended
}

#[test]
fn server_names_are_resolved_like_the_original() {
    let server = Server::ours();
    let port = server.port;
    let nobody = reserve_port();
    let file = format!(
        "remotes:\n  robot: {{host: localhost, port: {port}, scope: /test}}\n  \
         quoted: {{host: localhost, port: '{port}', scope: /test, more: 1}}\n  \
         elsewhere: {{host: localhost, port: {nobody}, scope: /test}}\n"
    );
    let done = "finished in state 'COMPLETED' while waiting. Result is 'hi'.";
    for name in ["robot", "quoted"] {
        both_tell(port, &file, &[name, "test:echo:hi"], done);
    }
    let number = port.to_string();
    // The option replaces the file's value.
    let task = ["--task", "elsewhere", "localhost", &number, "/test"];
    let mut words = task.to_vec();
    words.extend(["--task", "third", "localhost", &number, "/test"]);
    for name in ["elsewhere", "third"] {
        both_tell(
            port,
            &file,
            &[&words[..], &[name, "test:echo:hi"]].concat(),
            done,
        );
    }
    let publisher = [
        "--publisher",
        "p",
        "localhost",
        "1",
        "/p",
        "robot",
        "test:echo:hi",
    ];
    both_tell(port, &file, &publisher, done);

    let last = "triggered: 'Controller threw exception: No such handler 'x', try 'test'.'.";
    both_tell(port, &file, &["robot", "x:echo:hi"], last);
    // Aborted after 1 s, or later by a busy machine.
    let words = ["--timeout", "1", "robot", "test:sleep:3"];
    let last = "finished in state 'COMPLETED' after unsuccessful abort signal. Reply is 'True'.";
    until("the same output", PATIENCE, || {
        let ended = both(&file, &words);
        println!("{ended:?}");
        let [original, ours] = ended.map(|ended| ClientOutput::of(&ended, port));
        let ends_so = original.text.trim_end().ends_with(last);
        (ends_so && ours == original).then_some(())
    });
    both_tell(
        port,
        &file,
        &["robot", "test"],
        "e.g. 'handler:component:goal'",
    );
}

#[test]
fn the_options_replace_a_configuration() {
    let server = Server::ours();
    let port = server.port.to_string();
    let words = [
        "--task",
        "r",
        "localhost",
        &port,
        "/test",
        "r",
        "test:echo:hi",
    ];
    let done = "finished in state 'COMPLETED' while waiting. Result is 'hi'.";
    let missing = "WARNING:remote-config:WARNING: Configuration file '";
    for broken in ["", "remotes: {", "7"] {
        let [original, ours] = both_tell(server.port, broken, &words, done);
        assert!(original.stderr.contains(missing), "{original:?}");
        // An empty file is accepted here.
        let told = ours.stderr.contains(missing);
        assert_eq!(told, !broken.is_empty(), "{broken:?}: {ours:?}");
        assert_eq!(
            ours.stderr.contains("zmq-remotes.yaml:1:"),
            told,
            "{ours:?}"
        );
    }
    let nowhere = ["--config", "/no/such/file"];
    both_tell(server.port, "", &[&nowhere[..], &words].concat(), done);
}

#[test]
fn an_unknown_server_name_is_rejected_with_the_known_names() {
    let file = "remotes:\n  robot: {host: localhost, port: 1, scope: /test}\n  \
                lamp: {host: localhost, scope: /test}\n";
    for (name, message) in [
        ("robto", "zmq-remotes.yaml; did you mean 'robot'?\n"),
        ("x", "zmq-remotes.yaml; there are: lamp, robot\n"),
        (
            "lamp",
            "zmq-remotes.yaml:3:9: 'port' is missing; write port: 12345\n",
        ),
    ] {
        let [original, ours] = both(file, &[name, "a:b:c"]);
        assert_eq!((original.code, ours.code), (Some(1), Some(2)), "{ours:?}");
        assert!(ours.stderr.contains(message), "{name}: {ours:?}");
        assert_eq!(ours.stdout, "");
    }
}

#[test]
fn a_negative_port_has_the_originals_exit_code() {
    let scratch = Scratch::new();
    let words = "--task robot 127.0.0.1 -1 /test robot a:b:c";
    let ours = ours_named(&scratch, "ztl_remote_task");
    for mut tool in [original_tool("ztl_remote_task"), ours] {
        tool.env("XDG_CONFIG_HOME", scratch.path(""));
        let ended = Process::run(tool.args(words.split(' ')));
        assert_eq!(ended.code, Some(1), "{ended:?}");
    }
}

#[test]
fn the_exit_status_option_reports_the_outcome() {
    let (simple, tests) = (Server::simple_ours(), Server::ours());
    let port = simple.port.to_string();
    for (request, code) in [("0", 0), ("soon", 1)] {
        let mut client = our_tool("simple-client");
        client.args(["--exit-status", "localhost", &port, SCOPE, request]);
        assert_eq!(Process::run(&mut client).code, Some(code), "{request}");
    }
    let port = tests.port.to_string();
    for (task, code) in [("test:echo:hi", 0), ("test:dance:x", 3), ("x:echo:hi", 1)] {
        let mut client = our_tool("remote-task");
        client.args(["--exit-status", "--task", "r", "localhost", &port, SCOPE]);
        assert_eq!(
            Process::run(client.args(["r", task])).code,
            Some(code),
            "{task}"
        );
    }
}
