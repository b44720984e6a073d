//! Encrypted connections: who may use a server by key and scope, and which keys a client has.

use std::process::Command;

use ztl_std::TriggerError;
use ztl_std::server::MAX_MESSAGE;
use ztl_tests::lab::{Ended, Keys, Process, SCOPE, Server, python, ztl};

use crate::access::{client, gateway};

#[test]
fn libzmq_without_encryption_rejects_keys_and_does_not_start() {
    let keys = Keys::make(&["robot"]);
    let words = "gateway -p 0 -s /lab -d gripper=sim:gripper --transport libzmq --key";
    let key = keys.path("robot.key_secret");
    let ended = Process::run(ztl().args(words.split(' ')).arg(key));
    assert!(ended.code.is_some_and(|code| code != 0), "{ended:?}");
    assert!(ended.stderr.contains("libzmq cannot encrypt"), "{ended:?}");
}

#[track_caller]
fn client_as(server: &Server, keys: &[String]) -> Ended {
    let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
    client(server, &keys)
}

#[test]
fn only_a_client_with_an_allowed_key_is_served() {
    let keys = Keys::make(&["robot", "anna", "mallory", "other"]);
    let (own, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let server = gateway(&["--key", &own, "--client-key", &anna]);
    server.process.wait_for("encrypted, with an allowed key");

    let ended = client_as(&server, &keys.options("anna", "robot"));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    // A client without a key, with another key, or for another server gets nothing: the outcome is unknown.
    let mallory = client_as(&server, &keys.options("mallory", "robot"));
    assert_eq!(mallory.code, Some(5), "{mallory:?}");
    server.process.wait_for("with the key");
    assert!(
        mallory
            .stdout
            .contains("does not admit this client: the server's --client-key must"),
        "{mallory:?}"
    );
    let nobody = client(&server, &[]);
    assert_eq!(nobody.code, Some(5), "{nobody:?}");
    assert!(
        nobody
            .stdout
            .contains("encrypts, and this client has no keys"),
        "{nobody:?}"
    );
    let other = client_as(&server, &keys.options("anna", "other"));
    assert_eq!(other.code, Some(5), "{other:?}");
    assert!(
        other
            .stdout
            .contains("does not have the key that this client expects"),
        "{other:?}"
    );
    // It keeps serving allowed clients.
    assert_eq!(
        client_as(&server, &keys.options("anna", "robot")).code,
        Some(0)
    );
}

#[test]
fn every_command_says_that_the_server_demands_keys() {
    let keys = Keys::make(&["robot", "anna"]);
    let (own, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let server = gateway(&["--key", &own, "--client-key", &anna]);
    let port = server.port;
    let told = format!(
        "the server at tcp://127.0.0.1:{port} encrypts, and this client has no keys: \
         give --key and --server-key (in a configuration file: key and server-key)"
    );
    let write = |name: &str, text: &str| std::fs::write(keys.path(name), text).expect("to write");
    let remotes = format!("remotes:\n  robot: {{host: 127.0.0.1, port: {port}, scope: {SCOPE}}}\n");
    write("remotes.yaml", &remotes);
    write(
        "show.yaml",
        "show:\n  step: {gripper(remote=robot): {finger: 3}}\n",
    );
    let forward = format!("{{forward: {{to: 'tcp://127.0.0.1:{port}', scope: {SCOPE}}}}}");
    let near = format!("scopes: {{{SCOPE}: {{gripper: {{finger: {forward}}}}}}}\n");
    write("near.yaml", &near);
    let mut near = ztl();
    let near = Server::start(near.args(["serve", "-p", "0"]).arg(keys.path("near.yaml")));
    let address = format!("-r 127.0.0.1 -p {port}");
    let commands = [
        (1, format!("ps {address}")),
        (1, format!("describe {address}")),
        (1, format!("devices {address}")),
        (1, format!("abort {address} --all")),
        (1, format!("abort {address} 5")),
        (
            5,
            format!("task-client --exit-status {address} -s {SCOPE} gripper:finger:1"),
        ),
        (
            5,
            format!("task-client --exit-status --json {address} -s {SCOPE} gripper:finger:1"),
        ),
        (
            5,
            format!("simple-client --exit-status 127.0.0.1 {port} {SCOPE} x"),
        ),
        (
            5,
            "remote-task --exit-status -c remotes.yaml robot gripper:finger:1".to_owned(),
        ),
        (
            1,
            "run-script -s show.yaml -c remotes.yaml --yes --plain".to_owned(),
        ),
        (1, "check show.yaml -c remotes.yaml --live".to_owned()),
        (
            1,
            format!(
                "task-client --exit-status -r 127.0.0.1 -p {} -s {SCOPE} gripper:finger:1",
                near.port
            ),
        ),
    ];
    let run = |words: &str| {
        let mut command = ztl();
        command.current_dir(keys.path(""));
        Process::run(command.args(words.split(' ')))
    };
    std::thread::scope(|scope| {
        let asked = commands
            .each_ref()
            .map(|(_, words)| scope.spawn(|| run(words)));
        for ((code, words), ended) in commands.iter().zip(asked) {
            let ended = ended.join().expect("it was run");
            let all = format!("{}{}", ended.stdout, ended.stderr);
            assert!(all.contains(&told), "{words}: {ended:?}");
            assert_eq!(ended.code, Some(*code), "{words}: {ended:?}");
        }
    });
    let ended = run(&format!("doctor {address}"));
    let told = format!("127.0.0.1:{port} encrypts, and this client has no keys\n");
    assert!(ended.stdout.contains(&told), "{ended:?}");
    assert!(
        ended.stdout.contains("-> give --key and --server-key"),
        "{ended:?}"
    );
}

#[test]
fn a_client_with_keys_says_that_a_server_does_not_encrypt() {
    let keys = Keys::make(&["robot", "anna"]);
    let ended = client_as(&gateway(&[]), &keys.options("anna", "robot"));
    assert_eq!(ended.code, Some(5), "{ended:?}");
    let told = "does not encrypt, and this client has keys: start the server with --key, or connect without keys";
    assert!(ended.stdout.contains(told), "{ended:?}");
}

/// libzmq answers a denied client with ERROR; our server only closes the connection.
#[test]
fn a_client_says_what_keeps_it_from_a_server_of_libzmq() {
    let keys = Keys::make(&["robot", "anna", "mallory", "other"]);
    let script = r#"
import sys, zmq, zmq.auth
from zmq.auth.thread import ThreadAuthenticator
directory, denied = sys.argv[1:]
context = zmq.Context()
authenticator = ThreadAuthenticator(context)
authenticator.start()
plain, encrypted = context.socket(zmq.REP), context.socket(zmq.REP)
authenticator.configure_curve(domain="*", location=denied)
own = zmq.auth.load_certificate(f"{directory}/robot.key_secret")
encrypted.curve_publickey, encrypted.curve_secretkey = own
encrypted.curve_server = True
print("Serving at", *[socket.bind_to_random_port("tcp://127.0.0.1") for socket in (plain, encrypted)], flush=True)
sys.stdin.read()
"#;
    std::fs::create_dir(keys.path("nobody")).expect("to make it");
    let mut command = Command::new(python());
    command.args(["-c", script, &keys.path(""), &keys.path("nobody")]);
    let process = Process::start(&mut command);
    let line = process.wait_for("Serving at ");
    let ports: Vec<&str> = line.split(' ').skip(2).map(str::trim).collect();
    let [plain, encrypted] = ports.as_slice() else {
        panic!("{line}");
    };
    for (port, options, told) in [
        (
            plain,
            &keys.options("anna", "robot")[..],
            "does not encrypt, and this client has keys",
        ),
        (encrypted, &[], "encrypts, and this client has no keys"),
        (
            encrypted,
            &keys.options("anna", "other"),
            "does not have the key that this client expects",
        ),
        (
            encrypted,
            &keys.options("mallory", "robot"),
            "does not admit this client",
        ),
    ] {
        let ended = Process::run(
            ztl()
                .args(["ps", "-r", "127.0.0.1", "-p", port])
                .args(options),
        );
        assert!(ended.stderr.contains(told), "{options:?}: {ended:?}");
    }
}

#[test]
fn a_server_with_keys_and_no_allowed_client_serves_nobody() {
    let keys = Keys::make(&["robot", "anna"]);
    let server = gateway(&["--key", &keys.path("robot.key_secret")]);
    server.process.wait_for("no client can connect");
    assert_eq!(
        client_as(&server, &keys.options("anna", "robot")).code,
        Some(5)
    );
}

#[test]
fn keys_that_let_nobody_in_cause_a_warning() {
    let keys = Keys::make(&["robot", "anna"]);
    let (own, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    std::fs::create_dir(keys.path("empty")).expect("to make it");
    let empty = keys.path("empty");
    let elsewhere = format!("test={anna}");
    let here = format!("{SCOPE}={anna}");
    let monitor = format!("$ztl={anna}");
    let nobody = "no client's key is allowed, so no client can connect; give --client-key (in a file, client-keys)";
    let none = format!("{empty}: there is no *.key in this directory");
    let unserved = format!(
        "client keys are allowed at scope 'test', which is not served; did you mean '{SCOPE}'?"
    );
    let file = keys.path("robot.yaml");
    let text = format!("scopes: {{{SCOPE}: {{h: {{c: echo}}}}}}\n");
    std::fs::write(&file, text).expect("to write");
    let gateway_words = ["gateway", "-s", SCOPE, "-d", "g=sim:gripper"];
    for (clients, warnings) in [
        (&[][..], &[nobody][..]),
        (&[empty.as_str()], &[&none, nobody]),
        (&[&empty, &anna], &[&none]),
        (&[&elsewhere], &[&unserved]),
        (&[&here], &[]),
        (&[&monitor], &[]),
    ] {
        let clients = clients.iter().flat_map(|client| ["--client-key", client]);
        let access: Vec<&str> = ["-p", "0", "--key", &own]
            .into_iter()
            .chain(clients)
            .collect();
        let warnings: Vec<String> = warnings
            .iter()
            .map(|warning| format!("ztl: warning: {warning}"))
            .collect();
        let verdict = match warnings.len() {
            0 => "Nothing is wrong: ",
            1 => "Nothing is wrong except a warning: ",
            _ => "Nothing is wrong except 2 warnings: ",
        };
        for server in [&gateway_words[..], &["serve", &file]] {
            let ended = Process::run(ztl().args(server).args(&access).arg("--check"));
            assert_eq!(ended.code, Some(0), "{ended:?}");
            assert!(ended.stdout.starts_with(verdict), "{ended:?}");
            let told: Vec<&str> = ended.stderr.lines().collect();
            assert_eq!(told, warnings, "{ended:?}");
            // The start says the same.
            let started = Server::start(ztl().args(server).args(&access));
            for warning in &warnings {
                started.process.wait_for(warning);
            }
        }
    }
}

#[test]
fn a_clients_key_needs_a_key_of_the_server_in_an_option_or_in_the_file() {
    let keys = Keys::make(&["robot", "anna"]);
    let (own, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let plain = format!("scope: {SCOPE}\nport: 0\ndevices: {{g: 'sim:gripper'}}\n");
    let (without, with) = (keys.path("plain.yaml"), keys.path("with.yaml"));
    std::fs::write(&without, &plain).expect("to write");
    std::fs::write(&with, format!("{plain}key: robot.key_secret\n")).expect("to write");
    let check = |file: &str, options: &[&str]| {
        let mut command = ztl();
        command.args(["gateway", file, "--check", "--client-key", &anna]);
        Process::run(command.args(options))
    };
    let rejected = check(&without, &[]);
    assert_eq!(rejected.code, Some(2), "{rejected:?}");
    let told =
        format!("ztl: --client-key {anna}: clients can have keys only if the server has one");
    assert!(rejected.stderr.starts_with(&told), "{rejected:?}");
    for ended in [check(&without, &["--key", &own]), check(&with, &[])] {
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert_eq!(ended.stderr, "", "{ended:?}");
    }
    // The clients in the file, the key in an option.
    let clients = "port: 0\nclient-keys: anna.key\n";
    let gateway = format!("{clients}scope: {SCOPE}\ndevices: {{g: 'sim:gripper'}}\n");
    let serve = format!("{clients}scopes: {{{SCOPE}: {{h: {{c: echo}}}}}}\n");
    for (tool, text) in [("gateway", gateway), ("serve", serve)] {
        let file = keys.path(&format!("{tool}.yaml"));
        std::fs::write(&file, text).expect("to write");
        let check = |options: &[&str]| {
            let words = [tool, &file, "--check"];
            Process::run(ztl().args(words).args(options))
        };
        let refused = check(&[]);
        assert_eq!(refused.code, Some(2), "{refused:?}");
        let told = format!(
            "{file}:2:14: clients can have keys only if the server has one; write key: robot.key_secret, or give --key"
        );
        assert!(refused.stderr.starts_with(&told), "{refused:?}");
        let ended = check(&["--key", &own]);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert_eq!(ended.stderr, "", "{ended:?}");
    }
}

/// As with libzmq, the overhead of encryption is part of a message.
#[test]
fn the_longest_encrypted_message_passes_and_a_longer_one_is_reported() {
    let keys = Keys::make(&["robot", "anna"]);
    let anna = format!("{SCOPE}={}", keys.path("anna.key"));
    let own = keys.path("robot.key_secret");
    let server = gateway(&["--key", &own, "--client-key", &anna]);
    let mut remote = keys.client(&server.endpoint(), "anna", "robot");
    let most = MAX_MESSAGE - 33;
    let payload = |bytes| "x".repeat(bytes - SCOPE.len() - ";1;-1;".len());
    let rejected = remote.trigger_payload(&payload(most));
    assert!(
        matches!(rejected, Err(TriggerError::Rejected { .. })),
        "it is not a task: {rejected:?}"
    );
    let error = remote.trigger_payload(&payload(most + 1));
    let told = format!(
        "has {} bytes, and the server at {} takes at most {most}",
        most + 1,
        server.endpoint()
    );
    let error = error.expect_err("it is too long").to_string();
    assert!(error.contains(&told), "{error}");
}

#[test]
fn a_key_for_another_scope_gives_no_access() {
    let keys = Keys::make(&["robot", "anna", "bert"]);
    let here = format!("{SCOPE}={}", keys.path("anna.key"));
    let elsewhere = format!("/elsewhere={}", keys.path("bert.key"));
    let own = keys.path("robot.key_secret");
    let server = gateway(&[
        "--key",
        &own,
        "--client-key",
        &here,
        "--client-key",
        &elsewhere,
    ]);
    assert_eq!(
        client_as(&server, &keys.options("anna", "robot")).code,
        Some(0)
    );

    let mut remote = keys.client(&server.endpoint(), "bert", "robot");
    match remote.trigger("gripper", "finger", "5") {
        Err(TriggerError::Rejected { reason, .. }) => {
            assert!(reason.starts_with("No controller for scope"), "{reason}");
        }
        other => panic!("{other:?}"),
    }
    // It does not learn what the server offers either.
    let probe = remote
        .ask_server("probe")
        .expect("an answer")
        .expect("known");
    assert!(
        !probe.contains(SCOPE) && !probe.contains("gripper"),
        "{probe}"
    );
    let tasks = remote
        .ask_server("tasks")
        .expect("an answer")
        .expect("known");
    assert!(tasks.contains("\"tasks\":[]"), "{tasks}");
    assert_eq!(remote.ask_server("devices"), Ok(None));
}

#[test]
fn a_client_in_python_uses_the_same_files() {
    let keys = Keys::make(&["robot", "anna"]);
    let (own, anna) = (keys.path("robot.key_secret"), keys.path("anna.key"));
    let server = gateway(&["--key", &own, "--client-key", &anna]);
    let script = r#"
import sys, zmq, zmq.auth
port, own, server = sys.argv[1:]
socket = zmq.Context().socket(zmq.REQ)
socket.curve_publickey, socket.curve_secretkey = zmq.auth.load_certificate(own)
socket.curve_serverkey, _ = zmq.auth.load_certificate(server)
socket.connect(f"tcp://127.0.0.1:{port}")
socket.send(b"$ztl;2;-1;probe")
print(socket.recv().decode() if socket.poll(5000) else "nothing")
"#;
    let mut command = Command::new(python());
    command.args(["-c", script, &server.port.to_string()]);
    let ended = Process::run(command.args([keys.path("anna.key_secret"), keys.path("robot.key")]));
    assert!(
        ended.stdout.contains("\"gripper\": [\"finger\"]"),
        "{ended:?}"
    );
}

/// Two encrypted gateways with keys of their own, a configuration file that names both, and a script for them.
struct EncryptedShow {
    keys: Keys,
    _servers: [Server; 2],
}

impl EncryptedShow {
    #[track_caller]
    fn new() -> Self {
        let keys = Keys::make(&["left", "right", "anna"]);
        let servers = ["left", "right"].map(|name| {
            let own = keys.path(&format!("{name}.key_secret"));
            let device = format!("{name}=sim:gripper");
            let client = keys.path("anna.key");
            let server =
                Server::gateway_with(&[&device], &["--key", &own, "--client-key", &client]);
            server.wait_ready(name);
            server
        });
        let remotes = ["left", "right"].iter().zip(&servers).map(|(name, server)| {
            format!(
                "  {name}: {{host: 127.0.0.1, port: {}, scope: {SCOPE}, key: anna.key_secret, server-key: {name}.key}}\n",
                server.port
            )
        });
        let remotes = format!("remotes:\n{}", remotes.collect::<String>());
        let script = "show(delay=0):\n  both:\n    left: {finger: 3}\n    right: {finger: 4}\n";
        std::fs::write(keys.path("remotes.yaml"), remotes).expect("to write");
        std::fs::write(keys.path("show.yaml"), script).expect("to write");
        Self {
            keys,
            _servers: servers,
        }
    }

    #[track_caller]
    fn run(&self, words: &str) -> Ended {
        let mut command = ztl();
        command.current_dir(self.keys.path(""));
        Process::run(command.args(words.split(' ')))
    }
}

#[test]
fn a_script_is_checked_and_played_on_encrypted_servers() {
    let show = EncryptedShow::new();
    let ended = show.run("check show.yaml -c remotes.yaml --live");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let ended = show.run("run-script -s show.yaml -c remotes.yaml --yes --plain");
    assert_eq!(ended.code, Some(0), "{ended:?}");
    for words in [
        "ps --remote left -c remotes.yaml",
        "describe --remote right -c remotes.yaml",
        "task-client --exit-status --remote right -c remotes.yaml right:finger:5",
        "remote-task --exit-status -c remotes.yaml left left:finger:5",
    ] {
        let ended = show.run(words);
        assert_eq!(ended.code, Some(0), "{words}: {ended:?}");
    }
    // The options' keys are for servers without keys in the file.
    let text = std::fs::read_to_string(show.keys.path("remotes.yaml")).expect("a file");
    let text = text.replace(", key: anna.key_secret, server-key: left.key", "");
    std::fs::write(show.keys.path("remotes.yaml"), text).expect("to write");
    let words =
        "check show.yaml -c remotes.yaml --live --key anna.key_secret --server-key left.key";
    let ended = show.run(words);
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

#[test]
fn wrong_keys_in_the_configuration_file_are_reported_with_their_place() {
    let show = EncryptedShow::new();
    let remotes = show.keys.path("remotes.yaml");
    let text = std::fs::read_to_string(&remotes).expect("a file");
    for (from, to, expected) in [
        (
            ", server-key: left.key",
            "",
            "an encrypted connection needs both",
        ),
        ("server-key: left.key", "server-key: none.key", "none.key: "),
        (
            "key: anna.key_secret",
            "key: remotes.yaml",
            "there is no line `public-key",
        ),
    ] {
        std::fs::write(&remotes, text.replacen(from, to, 1)).expect("to write");
        for words in [
            "check show.yaml -c remotes.yaml",
            "ps --remote left -c remotes.yaml",
        ] {
            let ended = show.run(words);
            assert!(
                ended.code.is_some_and(|code| code != 0),
                "{words}: {ended:?}"
            );
            let told = format!("{}{}", ended.stdout, ended.stderr);
            assert!(told.contains("remotes.yaml:2:"), "{words}: {told}");
            assert!(told.contains(expected), "{words}: {told}");
        }
    }
}
