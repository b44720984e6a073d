//! Robots that do not answer, and clients that do not wait.

use std::io::{Read as _, Write as _};
use std::time::Duration;

use ztl_std::State::{Completed, Failed};

use super::web::{Served, Web, say};

/// How long a client waits that does not.
const IMPATIENCE: Duration = Duration::from_millis(20);

#[test]
fn aborts_that_come_faster_than_answers_do_not_pile_up() {
    let web = Web::start(|(what, ..), wire| match what.as_str() {
        // Silent until the client closes the connection.
        "POST /drive" | "POST /halt" => drop(wire.read(&mut [0])),
        _ => say(wire, "200 OK", ""),
    });
    let served = Served::new(
        &web,
        "drive: {http: {post: 'http://{robot}/drive', abort: {post: 'http://{robot}/halt'}}},
         other: {http: {post: 'http://{robot}/other'}}",
    );
    let (mut remote, task) = served.trigger("p", "drive", "");
    web.wait_for("POST /drive");
    remote.abort(task).expect("an answer");
    let mut impatient = served.remote().with_timeout(IMPATIENCE);
    for _ in 0..50 {
        let _ = impatient.abort(task);
    }
    web.wait_for("POST /halt");
    assert_eq!(served.run("p", "other", ""), (Completed, String::new()));
    let sent = web.asked("POST /halt").len();
    assert!(sent <= 3, "{sent} aborts were sent");
}

#[test]
fn a_request_without_an_answer_is_aborted() {
    let web = Web::start(|(what, ..), wire| match what.as_str() {
        "POST /drive" => drop(wire.read(&mut [0])),
        _ => say(wire, "200 OK", ""),
    });
    let served = Served::new(
        &web,
        "drive: {http: {post: 'http://{robot}/drive', limit: 4 s, abort: {post: 'http://{robot}/halt'}}}",
    );
    let (state, text) = served.run("p", "drive", "");
    let expected = "unknown: an abort was sent, but whether POST http://127.0.0.1:";
    assert!(
        state == Failed && text.starts_with(expected),
        "{state} {text}"
    );
    assert_eq!(web.asked("POST /halt").len(), 1);
}

#[test]
fn a_flood_of_events_does_not_hide_that_the_robot_is_heard() {
    let web = Web::start(|_, wire| {
        let head =
            "HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nConnection: close\r\n\r\n";
        // More at once than is kept, before anybody looks.
        let flood = format!(
            "{head}{}event: end\ndata: over\n\n",
            "data\n\n".repeat(100_000)
        );
        let _ = wire.write_all(flood.as_bytes());
        let _ = wire.read(&mut [0]);
    });
    let served = Served::new(
        &web,
        "wait: {http: {event: {get: 'http://{robot}/events', until: {event: end}}}}",
    );
    assert_eq!(served.run("p", "wait", ""), (Completed, "over".to_owned()));
}
