//! The configuration file of the gateway.

use std::path::Path;

use ztl_std::State;
use ztl_tests::lab::{Ended, PATIENCE, Process, Scratch, connect_to, reserve_port, until, ztl};

/// `ztl gateway` with these arguments; it must exit by itself.
#[track_caller]
fn run(words: &[&str]) -> Ended {
    Process::run(ztl().arg("gateway").args(words))
}

/// A file of the project.
fn project(path: &str) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path);
    root.display().to_string()
}

#[track_caller]
fn written(scratch: &Scratch, text: &str) -> String {
    let path = scratch.path("lab.yaml");
    std::fs::write(&path, text).expect("to write");
    path.display().to_string()
}

#[test]
fn the_example_is_valid_and_checking_it_serves_nothing() {
    // Another program may use the port of the example.
    let port = reserve_port();
    let example = project("examples/gateway.yaml");
    let ended = run(&[&example, "--check", "-p", &port.to_string()]);
    let said = format!(
        "Nothing is wrong: gripper, head, lamp, try-me, scope /lab, at 127.0.0.1:{port}.\n"
    );
    assert_eq!(
        (ended.code, ended.stdout, ended.stderr.as_str()),
        (Some(0), said, "")
    );
}

#[test]
fn checking_opens_no_device() {
    let scratch = Scratch::new();
    let device = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = device.local_addr().expect("its address").port();
    let text =
        format!("scope: /lab\nport: 0\njournal: off\ndevices: {{arm: tcp:127.0.0.1:{port}}}\n");
    let file = written(&scratch, &text);
    let checked = run(&[&file, "--check"]);
    assert_eq!(checked.code, Some(0), "{checked:?}");
    device.set_nonblocking(true).expect("a socket");
    let nobody = device.accept().map_err(|error| error.kind());
    assert_eq!(nobody.map(drop), Err(std::io::ErrorKind::WouldBlock));

    let _gateway = Process::start(ztl().args(["gateway", &file]));
    until("the gateway that serves", PATIENCE, || device.accept().ok());
}

#[test]
fn the_check_finds_errors_that_would_fail_the_start() {
    let scratch = Scratch::new();
    std::fs::write(scratch.path("file"), "").expect("to write");
    std::os::unix::fs::symlink("loop", scratch.path("loop")).expect("a link");
    std::os::unix::fs::symlink("no/where", scratch.path("dangling")).expect("a link");
    std::fs::write(scratch.path("precious"), "a: {b: 1}\n").expect("to write");
    let devices = "scope: /lab\ndevices: {head: sim:head}\n";
    for (text, code, said) in [
        // An address reserved for documentation (RFC 5737), and an interface that does not exist.
        (
            "port: 0\nbind: 192.0.2.1\njournal: off\n",
            1,
            "this machine does not have the address 192.0.2.1",
        ),
        (
            "port: 0\nbind: no-such-interface\njournal: off\n",
            1,
            "'no-such-interface' is not an address",
        ),
        (
            "port: 0\nbind: 224.0.0.1\njournal: off\n",
            1,
            "224.0.0.1 is a multicast address, where no client can connect",
        ),
        (
            "port: 0\njournal: file/journal\n",
            1,
            "the journal cannot lie at ",
        ),
        (
            "port: 0\njournal: loop\n",
            1,
            "loop: Too many levels of symbolic links",
        ),
        ("port: 0\njournal: dangling\n", 1, "dangling: No such file"),
        (
            "port: 0\njournal: dangling/\n",
            1,
            "the journal cannot lie at ",
        ),
        (
            "port: 0\njournal: precious\n",
            1,
            "precious is not a journal, and was left as it is; name another file",
        ),
        (
            "port: 0\njournal: ''\n",
            2,
            "the name of the journal is empty",
        ),
        (
            "port: 0\nkey: no.key_secret\n",
            2,
            "no.key_secret: No such file",
        ),
        ("port: 1\npublish: 1\n", 2, "port 1 is for tasks"),
    ] {
        let file = written(&scratch, &format!("{devices}{text}"));
        let checked = run(&[&file, "--check"]);
        let started = run(&[&file]);
        for ended in [&checked, &started] {
            assert_eq!(ended.code, Some(code), "{ended:?}");
            assert!(ended.stderr.contains(said), "{ended:?}");
        }
        assert_eq!(checked.stdout, "");
    }
    let precious = std::fs::read_to_string(scratch.path("precious"));
    assert_eq!(precious.expect("the file"), "a: {b: 1}\n");
}

#[test]
fn a_port_that_another_program_uses_is_a_mistake() {
    let scratch = Scratch::new();
    let taken = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = taken.local_addr().expect("its address").port();
    let devices = "scope: /lab\ndevices: {head: sim:head}\n";
    for ports in [
        format!("port: {port}\n"),
        format!("port: 0\npublish: {port}\n"),
    ] {
        let file = written(&scratch, &format!("{devices}{ports}"));
        for ended in [run(&[&file, "--check"]), run(&[&file])] {
            assert_eq!(ended.code, Some(1), "{ports}: {ended:?}");
            let said = format!("cannot listen at tcp://127.0.0.1:{port}: the port is in use");
            assert!(ended.stderr.contains(&said), "{ended:?}");
        }
    }
}

#[test]
fn checking_a_running_gateways_file_does_not_disturb_it() {
    let scratch = Scratch::new();
    let text = "scope: /lab\ndevices: {head: sim:head}\njournal: journal\nport: ";
    let file = written(&scratch, &format!("{text}0\n"));
    let gateway = Process::start(ztl().args(["gateway", &file]));
    let line = gateway.wait_for("Serving head at tcp://127.0.0.1:");
    gateway.wait_for("Device 'head' is ready");
    let (_, port) = line.split_once("tcp://127.0.0.1:").expect("a port");
    let (port, _) = port.split_once(',').expect("a port");
    let endpoint = format!("tcp://127.0.0.1:{port}");
    let mut remote = connect_to(&endpoint, "/lab");
    let file = written(&scratch, &format!("{text}{port}\n"));
    let checked = run(&[&file, "--check"]);
    assert_eq!(checked.code, Some(0), "{checked:?}");
    assert!(
        checked.stdout.starts_with("Nothing is wrong: "),
        "{checked:?}"
    );
    for note in ["the port is in use", "is another gateway's (process "] {
        assert!(checked.stderr.contains(note), "{checked:?}");
    }
    let id = remote.trigger("head", "pan", "left").expect("taken").id;
    remote.wait(id, Some(PATIENCE)).expect("its end");
    let names = |directory: &Path| {
        let entries = std::fs::read_dir(directory).expect("the directory");
        let name = |entry: std::fs::DirEntry| entry.file_name().into_string().expect("a name");
        let mut names: Vec<String> = entries.flatten().map(name).collect();
        names.sort();
        names
    };
    let directory = scratch.path("lab.yaml");
    let directory = directory.parent().expect("a directory");
    assert_eq!(names(directory), ["journal", "lab.yaml"]);
}

#[test]
fn the_manual_documents_every_key() {
    let scratch = Scratch::new();
    let file = written(
        &scratch,
        "zzzzzz: 1\ndevices: {a: {url: sim:head, zzzzzz: 1}}\n",
    );
    let ended = run(&[&file, "--check"]);
    let manual = std::fs::read_to_string(project("docs/gateway.md")).expect("the manual");
    let mut keys = 0;
    for list in ended
        .stderr
        .lines()
        .filter_map(|line| line.split_once("; there are: "))
    {
        for key in list.1.split(", ") {
            keys += 1;
            assert!(manual.contains(&format!("| `{key}` |")), "{key}");
        }
    }
    assert!(keys >= 11, "{ended:?}");
}

#[test]
fn an_invalid_file_is_rejected_with_every_mistake_and_its_exit_code() {
    let scratch = Scratch::new();
    let file = written(
        &scratch,
        "scope: /lab\nprot: 12345\ndevices:\n  gripper: sim:griper\n",
    );
    for check in [&["--check"][..], &[]] {
        let mut words = vec![file.as_str()];
        words.extend_from_slice(check);
        let ended = run(&words);
        let expected = format!(
            "{file}:2:1: unknown key 'prot'; did you mean 'port'?\n  2 | prot: 12345\n    | ^^^^\n\
             {file}:4:12: no simulated device 'griper'; there are: gripper, head, sensor\n  4 |   gripper: sim:griper\n    |            ^^^^^^^^^^\n"
        );
        assert_eq!((ended.code, ended.stderr), (Some(2), expected));
        assert_eq!(ended.stdout, "");
    }
}

#[test]
fn a_missing_setting_is_reported_with_its_option_and_key() {
    let scratch = Scratch::new();
    let file = written(&scratch, "scope: /lab\ndevices: {head: sim:head}\n");
    let missing = run(&[&file, "--check"]);
    let said = format!("ztl: no port: give --port <PORT>, or `port: 12345` in {file}\n");
    assert_eq!((missing.code, missing.stderr), (Some(2), said));
    let twice = run(&[&file, "-p", "0", "--device", "head=sim:gripper"]);
    assert_eq!(twice.code, Some(2));
    assert!(
        twice.stderr.contains("two devices are named 'head'"),
        "{twice:?}"
    );
    for (file, part) in [
        (
            "/no/such/file.yaml",
            "/no/such/file.yaml: cannot read it: No such file",
        ),
        ("/", "/: cannot read it: "),
    ] {
        let ended = run(&[file]);
        assert_eq!(ended.code, Some(2));
        assert!(ended.stderr.starts_with(part), "{ended:?}");
    }
}

#[test]
fn the_file_sets_the_journals_path() {
    let scratch = Scratch::new();
    let text = "scope: /lab\nport: 0\ndevices: {head: sim:head}\njournal: ";
    for (journal, said) in [
        (
            "state/lab.jsonl".to_owned(),
            format!("Journal: {}", scratch.path("state/lab.jsonl").display()),
        ),
        ("off".to_owned(), "Without a journal".to_owned()),
    ] {
        let file = written(&scratch, &format!("{text}{journal}\n"));
        let gateway = Process::start(ztl().arg("gateway").arg(file));
        gateway.wait_for(&said);
        gateway.wait_for("Serving head");
    }
    let option = [
        "gateway",
        "-d",
        "head=sim:head",
        "-p",
        "0",
        "-s",
        "/lab",
        "--journal",
        "off",
    ];
    let ended = Process::run(ztl().args(option));
    assert_eq!(ended.code, Some(2));
    assert!(ended.stderr.contains("give --no-journal"), "{ended:?}");
}

#[test]
fn only_clients_allowed_by_file_and_options_may_connect() {
    let scratch = Scratch::new();
    let text = "scope: /lab\nport: 0\nallow: 192.0.2.0/24\ndevices: {head: sim:head}\n";
    let file = written(&scratch, text);
    let gateway = Process::start(ztl().args(["gateway", &file, "--allow", "198.51.100.7"]));
    gateway.wait_for("if its address is in 198.51.100.7/32 or 192.0.2.0/24");
}

#[test]
fn options_override_the_configuration_file() {
    let scratch = Scratch::new();
    let file = written(
        &scratch,
        "scope: /file\nport: 1\nlog-format: json\ndevices: {head: sim:head}\n",
    );
    let words = [
        &file,
        "-p",
        "0",
        "-s",
        "/option",
        "-d",
        "gripper=sim:gripper",
    ];
    let gateway = Process::start(ztl().arg("gateway").args(words));
    let line = gateway.wait_for("Serving head, gripper at tcp://127.0.0.1:");
    assert!(line.contains("scope /option"), "{line}");
    let endpoint = line
        .split([' ', ','])
        .find(|word| word.starts_with("tcp://"))
        .expect("an endpoint");
    let ready = gateway.wait_for("Device 'gripper' is ready");
    let event: serde_json::Value = serde_json::from_str(&ready).expect("JSON");
    assert_eq!(event["level"], "INFO", "{ready}");
    assert_eq!(event["device"], "gripper", "{ready}");
    let mut remote = connect_to(endpoint, "/option");
    let id = until("the gripper takes a task", PATIENCE, || {
        remote.trigger("gripper", "finger", "3").ok()
    })
    .id;
    let end = remote.wait(id, Some(PATIENCE)).expect("its end");
    assert_eq!((end.state, end.text.as_str()), (State::Completed, "3.0"));
}
