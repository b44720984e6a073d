//! `ztl publish` and `ztl subscribe`, and the events of tasks that servers publish.

use std::process::Command;

use ztl_tests::lab::{Keys, PATIENCE, Process, SCOPE, Scratch, Server, our_client_at, until, ztl};

/// `ztl publish` at a free port with these words, and the port.
fn publisher(words: &[&str]) -> (Process, u16) {
    let mut command = ztl();
    command.args(["publish", "-p", "0"]).args(words);
    let process = Process::start(&mut command);
    let port = process.wait_for_port("Publishing at tcp://127.0.0.1:");
    (process, port)
}

/// `ztl subscribe` with these words after the address.
fn subscribe(port: u16, words: &[&str]) -> Command {
    let mut command = ztl();
    command.args(["subscribe", &format!("tcp://127.0.0.1:{port}")]);
    command.args(words);
    command
}

#[test]
fn a_published_value_is_shown_as_text_as_json_and_as_bytes() {
    let value = "{x: 1.5, what: [on, null, \"it's\\e[2J\"]}";
    for (format, shown) in [
        (
            &[][..],
            "/lab/pose {'x': 1.5, 'what': ['on', None, \"it's\\x1b[2J\"]}\n",
        ),
        (
            &["--json"],
            "\"value\": {\"x\": 1.5, \"what\": [\"on\", null, \"it's\\u001b[2J\"]}}\n",
        ),
    ] {
        let (publisher, port) = publisher(&["/lab/pose", value]);
        let words = [format, &["-n", "1"]].concat();
        let ended = Process::run(&mut subscribe(port, &words));
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(ended.stdout.ends_with(shown), "{ended:?}");
        assert_eq!(publisher.end(PATIENCE).code, Some(0));
    }
    let (_publisher, port) = publisher(&["/lab/text", "--text", "42"]);
    let scratch = Scratch::new();
    let file = scratch.path("raw");
    let mut command = subscribe(port, &["-n", "1", "--raw"]);
    assert_eq!(Process::run(command.arg(&file)).code, Some(0));
    assert_eq!(std::fs::read(file).expect("a file"), b"42");
}

#[test]
fn a_subscriber_of_a_port_for_tasks_says_what_is_wrong() {
    let keys = Keys::make(&["server", "client"]);
    let (own, client) = (keys.path("server.key_secret"), keys.path("client.key"));
    let options = ["--key", &own, "--client-key", &client];
    let encrypted = Server::gateway_with(&["head=sim:head"], &options);
    let plain = Server::ours();
    for (port, said) in [
        (
            encrypted.port,
            "the publisher encrypts, and this client has no keys: give --key and --server-key",
        ),
        (plain.port, "is it a publisher, or a port for tasks?"),
    ] {
        let mut subscriber = Process::start(&mut subscribe(port, &[]));
        subscriber.wait_for(said);
        subscriber.kill();
    }
}

#[test]
fn each_line_is_published_and_a_wrong_one_is_named() {
    let (mut publisher, port) = publisher(&["/lab/lines", "-"]);
    let subscriber = Process::start(&mut subscribe(port, &["/lab/lines"]));
    // The first lines are published after a subscriber has come.
    for line in ["1", "[2", "!tag 3", "four"] {
        publisher.write_line(line);
    }
    publisher.close_stdin();
    let ended = publisher.end(PATIENCE);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended.stderr.contains("line 2 of stdin: '[2' is not YAML"),
        "{ended:?}"
    );
    assert!(
        ended
            .stderr
            .contains("line 3 of stdin: '!tag 3' cannot be published: it has the tag !tag"),
        "{ended:?}"
    );
    until("both values", PATIENCE, || {
        (subscriber.stdout() == "/lab/lines 1\n/lab/lines 'four'\n").then_some(())
    });
    subscriber.signal("TERM");
    assert_eq!(subscriber.end(PATIENCE).code, Some(143));
}

#[test]
fn a_named_publisher_is_found_with_its_scope_and_its_keys() {
    let scratch = Scratch::new();
    let path = |name: &str| scratch.path(name).display().to_string();
    for name in ["robot", "anna"] {
        let ended = Process::run(ztl().arg("keys").arg(path(name)));
        assert_eq!(ended.code, Some(0), "{ended:?}");
    }
    let keys = [
        "--key",
        &path("robot.key_secret"),
        "--client-key",
        &path("anna.key"),
    ];
    let words = [
        &["/lab/door", "open", "--state", "--subscribers", "1"][..],
        &keys,
    ]
    .concat();
    let (_publisher, port) = publisher(&words);
    let config = format!(
        "publishers:\n  door: {{host: 127.0.0.1, port: {port}, scope: /lab/door, key: anna.key_secret, server-key: robot.key}}\n"
    );
    std::fs::write(scratch.path("remotes.yaml"), config).expect("to write");
    let named = |name: &str| {
        let mut command = ztl();
        command.args(["subscribe", name, "-n", "1", "-c", &path("remotes.yaml")]);
        Process::run(&mut command)
    };
    let ended = named("door");
    assert_eq!(
        (ended.code, ended.stdout.as_str()),
        (Some(0), "/lab/door 'open'\n"),
        "{ended:?}"
    );
    let ended = named("dor");
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(ended.stderr.contains("did you mean 'door'?"), "{ended:?}");
}

#[test]
fn what_does_not_come_in_time_is_an_error() {
    let mut command = ztl();
    command.args(["publish", "-p", "0", "/lab/x", "1", "-t", "200ms"]);
    let ended = Process::run(&mut command);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(
        ended.stderr.contains("0 of 1 subscribers came in time"),
        "{ended:?}"
    );
    // After 2 s it says what it waits for.
    let mut absent = Process::start(&mut subscribe(1, &[]));
    absent.wait_for("ztl: no publisher at tcp://127.0.0.1:1 yet; ");
    absent.kill();
    let ended = Process::run(&mut subscribe(1, &["-n", "1", "-t", "200ms"]));
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(!ended.stderr.contains("yet"), "{ended:?}");
    assert!(
        ended.stderr.contains("the publisher is not connected"),
        "{ended:?}"
    );
}

#[test]
fn rates_are_shown_each_second() {
    let (mut publisher, port) = publisher(&["/lab/rate", "-"]);
    let subscriber = Process::start(&mut subscribe(port, &["--rate"]));
    let now = || std::time::SystemTime::UNIX_EPOCH.elapsed().expect("a time");
    // The first rate may be one of no values, which has no age.
    let line = until("a rate with an age", PATIENCE, || {
        // The second value has a time that no clock shows: it is not counted.
        publisher.write_line(&format!("{{time: {}}}", now().as_secs_f64()));
        publisher.write_line("{time: 1e300}");
        std::thread::sleep(std::time::Duration::from_millis(50));
        let rates = subscriber.stdout();
        let line = rates.lines().find(|line| line.ends_with(" ms old"));
        line.map(str::to_owned)
    });
    assert!(
        line.contains(" messages/s, ") && line.contains(", 0 missed, "),
        "{line}"
    );
    let age = line
        .strip_suffix(" ms old")
        .and_then(|line| line.rsplit(' ').next());
    let age: f64 = age.expect("an age").parse().expect("a number");
    assert!(age < 60_000.0, "{line}");
}

#[test]
fn a_server_publishes_what_happens_to_its_tasks() {
    let scratch = Scratch::new();
    let file = scratch.path("robot.yaml");
    let text = format!("port: 0\npublish: 0\nscopes:\n  {SCOPE}:\n    test: {{echo: echo}}\n");
    std::fs::write(&file, text).expect("to write");
    let mut command = ztl();
    let server = Server::start(command.arg("serve").arg(&file));
    let port = server
        .process
        .wait_for_port("Publishing events of tasks at tcp://127.0.0.1:");
    let events = Process::start(&mut subscribe(port, &["--json", SCOPE]));
    let told = until("events", PATIENCE, || {
        let client = Process::run(our_client_at(server.port).arg("test:echo:hi"));
        assert_eq!(client.code, Some(0), "{client:?}");
        let told = events.stdout();
        told.contains("\"state\": \"COMPLETED\"").then_some(told)
    });
    let first = told.lines().next().expect("an event");
    assert!(
        first.contains(&format!("\"topic\": \"{SCOPE}/$tasks/")),
        "{first}"
    );
    let asked = told.lines().find(|line| line.contains("INITIATED"));
    assert!(
        asked.is_none_or(|line| line.contains("\"goal\": \"hi\"")),
        "{told}"
    );
}
