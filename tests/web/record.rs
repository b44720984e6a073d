//! The record of the show and its report, while the show runs.

use std::fs;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;

use serde_json::{Value, json};
use ztl_tests::lab::{PATIENCE, Process, busy};

use crate::client::Client;
use crate::console::{Console, from_port, node, port, web};

const SCRIPT: &str = "\
\"<img src=x onerror=alert`1`></style><script>alert`2`</script>\":
  say hello: {test(remote=ours): {echo: hello}}
  fail (on_failure=ask): {test(remote=ours): {nothing: hello}}
";

/// A console that plays and records a script, and its link.
fn show(console: &Console, record: Option<&str>, options: &[&str]) -> (Process, String) {
    let path = console.files.path("show.yaml");
    fs::write(&path, SCRIPT).expect("a file");
    let (path, record) = (
        path.display().to_string(),
        record.map(|name| console.files.path(name).display().to_string()),
    );
    let mut all = vec!["--script", &path];
    all.extend(record.iter().flat_map(|record| ["--record", record]));
    all.extend(options);
    web(0, &[("ours", console.robot.port)], &all)
}

/// The head of an answer, and its body.
fn get(port: u16, path: &str, headers: &str) -> (String, Vec<u8>) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    let request = format!("GET {path} HTTP/1.0\r\n{headers}\r\n");
    stream.write_all(request.as_bytes()).expect("a request");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("an answer");
    let mut windows = answer.windows(4);
    let end = windows
        .position(|four| four == b"\r\n\r\n")
        .expect("a head");
    let body = answer.split_off(end + 4);
    (String::from_utf8(answer).expect("text"), body)
}

#[test]
fn the_page_has_the_report_and_the_record_of_the_show() {
    let _busy = busy();
    let console = Console::of_one();
    let (_process, url) = show(&console, Some("run 1.jsonl"), &[]);
    let directory = console.files.path("");
    let mut command = node("driver.mjs");
    let driver = Process::start(command.args(["record", &url]).arg(directory));
    let ended = driver.end(PATIENCE * 3);
    assert!(ended.stdout.contains("passed"), "{ended:?}");
}

#[test]
fn a_record_is_for_those_who_may_look_at_the_console() {
    let console = Console::of_one();
    let (_process, link) = show(&console, Some("run.jsonl"), &["--host", "robot.local"]);
    let link = from_port(&link);
    let (port, token) = link.split_once("/?token=").expect("a token");
    let port = port.trim_start_matches(':').parse().expect("a port");
    let host = "Host: robot.local\r\n";
    let with = |more: &str| format!("{host}Authorization: Bearer {token}\r\n{more}");
    for path in ["/record", "/report"] {
        let status = |headers: &str| get(port, path, headers).0;
        assert!(status(host).contains(" 401 "), "{path}");
        let foreign = with("Origin: http://evil.example\r\n");
        assert!(status(&foreign).contains(" 403 "), "{path}");
        // A picture, or a link, of a page elsewhere has no Origin.
        for how in [
            "Mode: no-cors",
            "Mode: navigate\r\nSec-Fetch-Dest: document",
        ] {
            let elsewhere = format!("Sec-Fetch-Site: cross-site\r\nSec-Fetch-{how}\r\n");
            assert!(status(&with(&elsewhere)).contains(" 403 "), "{path} {how}");
        }
        let rebound = with("").replace("robot.local", "evil.example");
        assert!(status(&rebound).contains(" 403 "), "{path}");
        assert!(status(&with("")).contains(" 200 "), "{path}");
    }
    // There is no other file.
    for path in [
        "/record/",
        "/record/run.jsonl",
        "/record/../show.yaml",
        "/show.yaml",
        "/record%2f..%2fshow.yaml",
    ] {
        assert!(get(port, path, &with("")).0.contains(" 404 "), "{path}");
    }
    let (head, page) = get(port, "/report", &with(""));
    assert!(
        head.contains(
            "content-security-policy: default-src 'none'; style-src 'unsafe-inline'; img-src data:;"
        ) && head.contains("sandbox"),
        "{head}"
    );
    let page = String::from_utf8(page).expect("text");
    assert!(
        page.contains("</html>") && !page.contains("<script"),
        "{page}"
    );
    assert!(!page.contains("damaged"), "it goes on: {page}");
    let (head, record) = get(port, "/record", &with(""));
    assert!(
        head.contains("attachment; filename=\"run.jsonl\""),
        "{head}"
    );
    let record = String::from_utf8(record).expect("text");
    let first: Value = serde_json::from_str(record.lines().next().expect("a line")).expect("JSON");
    assert_eq!(first["event"], "run_started");
}

#[test]
fn a_recording_of_the_show_has_a_report_and_a_show_without_a_record_has_none() {
    let console = Console::of_one();
    let (_process, url) = show(&console, Some("run.mcap"), &[]);
    let at = port(&url);
    let host = format!("Host: 127.0.0.1:{at}\r\n");
    let mut client = Client::open(at);
    client.call(
        "/ztl/show/note",
        &json!({ "text": "the left arm hesitates" }),
    );
    ztl_tests::lab::until("the recording to have it", PATIENCE, || {
        let (head, page) = get(at, "/report", &host);
        let page = String::from_utf8(page).expect("text");
        // It is written at least once a second.
        let has_it = head.contains(" 200 ") && page.contains("the left arm hesitates");
        assert!(!page.contains("damaged"), "{page}");
        has_it.then_some(())
    });
    assert!(get(at, "/record", &host).1.starts_with(b"\x89MCAP0\r\n"));
    let (_process, url) = show(&console, None, &[]);
    let at = port(&url);
    let host = format!("Host: 127.0.0.1:{at}\r\n");
    for path in ["/record", "/report"] {
        assert!(get(at, path, &host).0.contains(" 404 "), "{path}");
    }
}
