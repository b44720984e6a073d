//! The configuration file of `ztl serve`.

use ztl_tests::lab::{Ended, Process, Scratch, ztl};

use crate::rig::{Rig, project};

#[track_caller]
fn run(words: &[&str]) -> Ended {
    Process::run(ztl().arg("serve").args(words))
}

#[track_caller]
fn written(scratch: &Scratch, text: &str) -> String {
    let path = scratch.path("robot.yaml");
    std::fs::write(&path, text).expect("to write");
    path.display().to_string()
}

#[test]
fn a_check_reports_mistakes_and_doubts() {
    let scratch = Scratch::new();
    let file = written(
        &scratch,
        "port: 1\nscopes:\n  /a: {h: {c: [no-such-program]}}\n  /b: {h: {c: echo, d: echo}}\n",
    );
    let ended = run(&[&file, "--check"]);
    let warning = format!(
        "{file}:3:16: warning: no-such-program does not exist; install it or correct the path\n  \
         3 |   /a: {{h: {{c: [no-such-program]}}}}\n    |                ^^^^^^^^^^^^^^^\n"
    );
    let said = "Nothing is wrong except a warning: 1 component at /a, 2 components at /b, at 127.0.0.1:1.\n";
    assert_eq!(
        (ended.code, ended.stdout.as_str(), ended.stderr),
        (Some(0), said, warning)
    );

    let file = written(&scratch, "prot: 1\nscopes: {/a: {h: {c: {rnu: x}}}}\n");
    for check in [&["--check"][..], &[]] {
        let mut words = vec![file.as_str()];
        words.extend_from_slice(check);
        let ended = run(&words);
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(2), ""));
        assert!(
            ended.stderr.starts_with(&format!(
                "{file}:1:1: unknown key 'prot'; did you mean 'port'?\n"
            )),
            "{ended:?}"
        );
        assert!(
            ended
                .stderr
                .contains(":2:23: unknown key 'rnu'; did you mean 'run'?"),
            "{ended:?}"
        );
    }
    let ended = run(&["/no/such/file.yaml"]);
    assert_eq!(ended.code, Some(2));
    assert!(
        ended
            .stderr
            .starts_with("/no/such/file.yaml: cannot read it: "),
        "{ended:?}"
    );
    let ended = run(&["/dev/zero"]);
    let said = "/dev/zero: cannot read it: it is not a regular file\n";
    assert_eq!((ended.code, ended.stderr.as_str()), (Some(2), said));
}

#[test]
fn options_override_the_file_and_missing_settings_are_reported() {
    let scratch = Scratch::new();
    let file = written(&scratch, "scopes: {/a: {h: {c: echo}}}\n");
    let ended = run(&[&file, "--check"]);
    let said = format!("ztl: no port: give --port <PORT>, or `port: 12345` in {file}\n");
    assert_eq!((ended.code, ended.stderr), (Some(2), said));
    let ended = run(&[
        &file,
        "-p",
        "20007",
        "-s",
        "/b",
        "--bind",
        "127.0.0.1",
        "--check",
    ]);
    assert_eq!(
        ended.stdout,
        "Nothing is wrong: 1 component at /b, at 127.0.0.1:20007.\n"
    );
    let file = written(
        &scratch,
        "scopes: {/a: {h: {c: echo}}, /b: {h: {c: echo}}}\n",
    );
    let ended = run(&[&file, "-p", "7", "-s", "/c"]);
    assert_eq!(ended.code, Some(2));
    assert!(
        ended
            .stderr
            .contains("--scope names the only scope of a file"),
        "{ended:?}"
    );
    let rig = Rig::with("echo: echo", &["--allow", "192.0.2.0/24"]);
    rig.server
        .process
        .wait_for("if its address is in 192.0.2.0/24");
}

#[test]
fn the_manual_documents_every_key() {
    let scratch = Scratch::new();
    let file = written(
        &scratch,
        "zzzzzz: 1\nhttp: {a: {zzzzzz: 1}}\nstreams: {/a: {b: {zzzzzz: 1}, c: {http-event: {zzzzzz: 1}}}}\nscopes: {/a: {h: {c: {run: [sh], zzzzzz: 1, goal: {zzzzzz: 1}, abort: {zzzzzz: 1}}, d: {forward: {zzzzzz: 1}}, e: {naoqi: A.b, zzzzzz: 1, abort: {zzzzzz: 1}}, f: {http: {zzzzzz: 1, post: 'http://a/', abort: {zzzzzz: 1}, progress: {zzzzzz: 1}}}, g: {http: {event: {zzzzzz: 1, until: {zzzzzz: 1}}}}}}}\n",
    );
    let ended = run(&[&file, "--check"]);
    let manual = std::fs::read_to_string(project("docs/serve.md")).expect("the manual");
    let lists = ended
        .stderr
        .lines()
        .filter_map(|line| line.split_once("; there are: "));
    let keys: Vec<&str> = lists.flat_map(|(_, keys)| keys.split(", ")).collect();
    for key in &keys {
        let plain = manual.contains(&format!("`{key}`")) || manual.contains(&format!("{key}: "));
        assert!(plain, "{key}");
    }
    assert!(keys.len() > 60, "{keys:?}");
}

#[test]
fn a_probe_lists_handlers_and_components() {
    let rig = Rig::new("one: echo\n'*': echo");
    let mut probe = zmq_ask(rig.server.port, "$ztl;2;-1;probe");
    probe.truncate(probe.find(", running").expect("the running tasks"));
    assert!(
        probe.ends_with(r#"scopes: {"/test": {"p": ["*", "one"]}}"#),
        "{probe}"
    );
}

fn zmq_ask(port: u16, question: &str) -> String {
    let socket = zmq::Context::new().socket(zmq::REQ).expect("a socket");
    socket.set_rcvtimeo(20_000).expect("a limit");
    socket
        .connect(&format!("tcp://127.0.0.1:{port}"))
        .expect("an address");
    socket.send(question, 0).expect("to send");
    socket.recv_string(0).expect("an answer").expect("UTF-8")
}
