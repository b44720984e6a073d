//! `ztl doctor`: its findings on this machine, each with a remedy.

use serde_json::Value;
use ztl_tests::lab::{Ended, Process, Scratch, Server, reserve_port, ztl};

#[track_caller]
fn doctor(options: &[&str]) -> Ended {
    Process::run(ztl().arg("doctor").args(options))
}

/// Its findings, in JSON, and its exit code.
#[track_caller]
fn told(options: &[&str]) -> (Value, Option<i32>) {
    let ended = doctor(&[&["--json"], options].concat());
    let value = serde_json::from_str(&ended.stdout);
    let value = value.unwrap_or_else(|error| panic!("{error}: {ended:?}"));
    (value, ended.code)
}

/// The findings about this subject.
fn about<'a>(told: &'a Value, about: &str) -> Vec<&'a Value> {
    let findings = told["findings"].as_array().expect("findings");
    findings
        .iter()
        .filter(|finding| finding["about"] == about)
        .collect()
}

#[track_caller]
fn assert_problem(told: &Value, what: &str, text: &str, remedy: &str) {
    let found = about(told, what);
    let problem = found.iter().find(|finding| {
        let text = finding["text"]
            .as_str()
            .is_some_and(|said| said.contains(text));
        finding["health"] == "problem" && text
    });
    let problem = problem.unwrap_or_else(|| panic!("no '{text}': {told:#}"));
    let said = problem["remedy"].as_str().expect("a remedy");
    assert!(said.contains(remedy), "{said}");
}

#[test]
fn a_healthy_machine_is_reported_as_good() {
    let scratch = Scratch::new();
    let journal = scratch.path("new/journal");
    let journal = journal.to_str().expect("a path");
    let server = Server::ours();
    let (port, free) = (server.port.to_string(), reserve_port().to_string());
    let options = ["-p", &port, "--journal", journal, "--listen", &free];
    let (told, code) = told(&options);
    assert_eq!(
        (&told["problems"], code),
        (&Value::from(0), Some(0)),
        "{told:#}"
    );
    for what in [
        "ztl", "kernel", "cpu", "memory", "clock", "timer", "random", "files", "names", "network",
        "ports", "serial", "journal", "server",
    ] {
        assert!(!about(&told, what).is_empty(), "{what}: {told:#}");
    }
    let found = about(&told, "server");
    let found = &found[0]["data"];
    assert_eq!(found["version"], env!("CARGO_PKG_VERSION"));
    let round = found["round_trip_us"].as_u64().expect("a time");
    assert!((1..5_000_000).contains(&round), "{round}");
    assert!(
        about(&told, "ports")[0]["data"]["taken"]
            .as_array()
            .expect("ports")
            .contains(&server.port.into())
    );
    // It leaves nothing behind.
    assert!(!scratch.path("new").exists());
    // The same as text.
    let ended = doctor(&options);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(ended.stdout.ends_with("Nothing is wrong.\n"), "{ended:?}");
    assert!(ended.stdout.contains("round trip"), "{ended:?}");
}

#[test]
fn the_originals_server_is_recognized_without_a_version() {
    let server = Server::original();
    let (told, code) = told(&["-p", &server.port.to_string()]);
    let found = about(&told, "server");
    assert_eq!(found[0]["health"], "good", "{told:#}");
    assert_eq!(found[0]["data"]["version"], Value::Null);
    assert!(found[0]["text"].to_string().contains("an original server"));
    assert_eq!(code, Some(0), "{told:#}");
}

#[test]
fn each_problem_is_reported_with_its_remedy() {
    let scratch = Scratch::new();
    std::fs::write(scratch.path("file"), "").expect("a file");
    let inside = scratch.path("file/journal");
    let inside = inside.to_str().expect("a path");
    let server = Server::ours();
    let (taken, nobody) = (server.port.to_string(), reserve_port().to_string());
    let (told, code) = told(&[
        "-p",
        &nobody,
        "--listen",
        &taken,
        "--journal",
        inside,
        "--serial",
        "/dev/ttyNONE",
        "--serial",
        "/etc/passwd",
        "--serial",
        "/dev/null",
    ]);
    assert_eq!(
        (&told["problems"], code),
        (&Value::from(6), Some(1)),
        "{told:#}"
    );
    assert_problem(&told, "ports", "is in use", "ss -ltnp");
    assert_problem(&told, "journal", "ot a directory", "--journal DIR");
    assert_problem(&told, "serial", "/dev/ttyNONE", "plugged in");
    assert_problem(&told, "serial", "/etc/passwd is not a serial port", "lists");
    assert_problem(&told, "serial", "/dev/null is not a serial port", "lists");
    assert_problem(&told, "server", "nothing listens there", "--bind '*'");
    let ended = doctor(&["-p", &nobody]);
    assert_eq!(ended.code, Some(1));
    assert!(ended.stdout.contains("WRONG server"), "{ended:?}");
    assert!(ended.stdout.ends_with("One thing is wrong.\n"), "{ended:?}");
}

#[test]
fn a_server_that_does_not_answer_is_a_problem() {
    let listener = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a port");
    let port = listener.local_addr().expect("its address").port();
    let (told, code) = told(&["-r", "127.0.0.1", "-p", &port.to_string()]);
    assert_problem(&told, "server", "does not answer", "does it hang?");
    assert_eq!(code, Some(1));
    let (told, code) = self::told(&["-r", "no.such.host.invalid", "-p", "1"]);
    assert_problem(
        &told,
        "server",
        "cannot resolve 'no.such.host.invalid'",
        "/etc/hosts",
    );
    assert_eq!(code, Some(1));
}

#[test]
fn a_host_without_a_port_is_a_usage_error() {
    let ended = doctor(&["-r", "robot", "-c", "/dev/null"]);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(ended.stderr.contains("(a host needs --port)"), "{ended:?}");
}
