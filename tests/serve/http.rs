//! `http`, against a server on a thread: requests, what their answers mean, and servers that misbehave.

mod certificates;
mod events;
mod hostile;
mod robots;
mod tls;
mod web;

use std::io::{Read as _, Write as _};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ztl_std::State;
use ztl_std::State::{Aborted, Completed, Failed};
use ztl_tests::lab::{PATIENCE, Process, Scratch, end, until, ztl};

use web::{Served, Web, Wire, say};

#[test]
fn nothing_of_a_goal_becomes_structure() {
    let web = Web::start(|_, stream| say(stream, "200 OK", "done\n"));
    let served = Served::new(
        &web,
        "path: {http: {get: 'http://{robot}/a/{goal}/b?x={goal}&y=1'}},
         form: {http: {post: 'http://{robot}/form', form: {text: '{goal}', z: 1}}},
         json: {http: {put: 'http://{robot}/json', json: {a: {b: ['{goal.x}', 'at {goal.x}']}}}},
         header: {http: {delete: 'http://{robot}/header', headers: {X-Goal: '{goal}'}, bearer: token.txt}},
         basic: {http: {get: 'http://{robot}/basic', basic: token.txt}}",
    );
    let done = (Completed, "done".to_owned());
    assert_eq!(served.run("p", "path", "../?x#&=% ü"), done);
    let part = "..%2F%3Fx%23%26%3D%25%20%C3%BC";
    web.wait_for(&format!("GET /a/{part}/b?x={part}&y=1"));
    assert_eq!(served.run("p", "form", "a&b=c\r\n"), done);
    assert_eq!(web.wait_for("POST /form").2, "text=a%26b%3Dc%0D%0A&z=1");
    assert_eq!(served.run("p", "json", "{x: '\",1'}"), done);
    assert_eq!(
        web.wait_for("PUT /json").2,
        r#"{"a":{"b":["\",1","at \",1"]}}"#
    );
    assert_eq!(served.run("p", "header", "fine"), done);
    let headers = web.wait_for("DELETE /header").1.to_lowercase();
    assert!(
        headers.contains("x-goal: fine\n") && headers.contains("authorization: bearer s3cret\n"),
        "{headers}"
    );
    assert_eq!(served.run("p", "basic", ""), done);
    let headers = web.wait_for("GET /basic").1;
    assert!(headers.contains("Basic czNjcmV0\n"), "{headers}");
    for (component, goal, part) in [
        ("path", "..", "'..' cannot be a part of an address"),
        ("path", "", "'' cannot be a part of an address"),
        (
            "header",
            "a\r\nX-Other: 1",
            "cannot be the value of a header",
        ),
        ("json", "{y: 1}", "the goal '{y: 1}' is not "),
    ] {
        let (state, text) = served.run("p", component, goal);
        assert!(
            state == State::Rejected && text.contains(part),
            "{component}: {state} {text}"
        );
    }
    std::fs::remove_file(served.scratch.path("token.txt")).expect("to remove");
    let (state, text) = served.run("p", "basic", "");
    assert!(
        state == State::Rejected && text.contains("token.txt: No such file"),
        "{text}"
    );
}

#[test]
fn redirects_endless_answers_and_closed_connections_are_bounded_and_clear() {
    let other = Web::start(|_, stream| say(stream, "200 OK", "other"));
    let port = other.port;
    let web = Web::start(move |(what, ..), stream| {
        let redirect = |stream: &mut Wire, status: &str, to: &str| {
            let head = format!(
                "HTTP/1.1 {status}\r\nLocation: {to}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
            );
            let _ = stream.write_all(head.as_bytes());
        };
        let endless = b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n";
        match what.as_str() {
            "GET /same" => redirect(stream, "302 Found", "/there"),
            "GET /there" => say(stream, "200 OK", "there"),
            "GET /far" => redirect(stream, "302 Found", &format!("http://127.0.0.1:{port}/far")),
            "GET /round" => redirect(stream, "302 Found", "/round"),
            "POST /moved" => redirect(stream, "302 Found", "/there"),
            "GET /huge" => {
                let _ = stream.write_all(endless);
                while stream.write_all(&[b'x'; 4096]).is_ok() {}
            }
            "GET /drip" => {
                let _ = stream.write_all(endless);
                // A byte arrives more often than any limit on silence, until the client closes the connection.
                while stream.write_all(b"x").is_ok() {
                    std::thread::sleep(Duration::from_millis(20));
                }
            }
            // Says nothing until the client closes the connection.
            "POST /silent" => {
                let _ = stream.read(&mut [0]);
            }
            "POST /half" => {
                let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\nhalf");
            }
            "POST /garbage" => {
                let _ = stream.write_all(b"\0\xff\r\n\r\n");
            }
            _ => {}
        }
    });
    let served = Served::new(
        &web,
        "get: {http: {get: 'http://{robot}/{goal}'}},
         short-get: {http: {get: 'http://{robot}/{goal}', limit: 4 s}},
         post: {http: {post: 'http://{robot}/{goal}'}},
         short-post: {http: {post: 'http://{robot}/{goal}', limit: 4 s}},
         gone: {http: {post: 'http://127.0.0.1:1/x'}}",
    );
    assert_eq!(
        served.run("p", "get", "same"),
        (Completed, "there".to_owned())
    );
    let (state, text) = served.run("p", "get", "huge");
    assert!(
        state == Completed && text.ends_with("xx … (cut)") && text.len() < 70_000,
        "{state}"
    );
    for (component, goal, part) in [
        ("get", "far", "leads to 'http://127.0.0.1:"),
        ("get", "round", "it was redirected more than 3 times"),
        (
            "short-get",
            "drip",
            "unknown: whether GET http://127.0.0.1:",
        ),
        (
            "post",
            "moved",
            "status 302, which leads to '/there' and is not followed: ",
        ),
        ("short-post", "silent", "was done: no answer in time"),
        ("post", "half", "unknown: whether POST http://127.0.0.1:"),
        ("post", "close", "unknown: whether POST http://127.0.0.1:"),
        ("post", "garbage", "unknown: whether POST http://127.0.0.1:"),
        ("gone", "", "POST http://127.0.0.1:1/x: "),
    ] {
        let (state, text) = served.run("p", component, goal);
        assert!(
            state != Completed && text.contains(part),
            "{goal}: {state} {text}"
        );
    }
    assert!(other.asked.lock().expect("requests").is_empty());
    // Nothing was sent twice.
    assert_eq!(web.asked("POST /close").len(), 1);
}

#[test]
fn what_may_be_repeated_is_and_progress_is_asked_until_it_is_over() {
    let count = Mutex::new(0);
    let web = Web::start(move |(what, ..), stream| {
        let mut count = count.lock().expect("a number");
        match what.as_str() {
            "POST /shaky" => {
                *count += 1;
                if *count >= 3 {
                    say(stream, "201 Created", r#"{"id": 7}"#);
                }
            }
            "POST /begin" => say(stream, "202 Accepted", ""),
            "GET /state" => {
                *count += 1;
                let (state, percent) = if *count > 5 {
                    ("idle", 100)
                } else {
                    ("busy", *count * 10)
                };
                say(
                    stream,
                    "200 OK",
                    &format!(r#"{{"state": "{state}", "percent": {percent}}}"#),
                );
            }
            "GET /never" => say(stream, "200 OK", r#"{"state": "busy"}"#),
            _ => say(stream, "200 OK", ""),
        }
    });
    let served = Served::new(
        &web,
        "shaky: {http: {post: 'http://{robot}/shaky', repeat: 5, done: [200, 201], result: id}},
         begin: {http: {post: 'http://{robot}/begin', done: 202, result: percent,
                        progress: {get: 'http://{robot}/state', every: 10 ms, until: {field: state, is: idle}, show: percent}}},
         never: {http: {post: 'http://{robot}/begin', limit: 4 s, abort: {post: 'http://{robot}/halt'},
                        progress: {get: 'http://{robot}/never', every: 50 ms, until: {field: state, is: idle}}}},
         wrong: {http: {post: 'http://{robot}/begin', done: 200}},
         lacks: {http: {get: 'http://{robot}/never', result: stat}}",
    );
    let whole = (Completed, "{'state': 'busy'}".to_owned());
    assert_eq!(served.run("p", "lacks", ""), whole);
    served.server.process.wait_for("no field 'stat'");
    assert_eq!(served.run("p", "shaky", ""), (Completed, "7".to_owned()));
    assert_eq!(web.asked("POST /shaky").len(), 3);
    assert_eq!(served.run("p", "begin", ""), (Completed, "100".to_owned()));
    let late = "not over within 4 s; it was aborted";
    assert_eq!(served.run("p", "never", ""), (Failed, late.to_owned()));
    assert_eq!(web.asked("POST /halt").len(), 1);
    assert_eq!(
        served.run("p", "wrong", ""),
        (Failed, "status 202: ".to_owned())
    );
}

#[test]
fn an_abort_reaches_a_robot_that_has_not_answered_and_again_after_its_answer() {
    let gate = Arc::new(Mutex::new(()));
    let held = gate.lock().expect("a gate");
    let opened = Arc::clone(&gate);
    let web = Web::start(move |(what, ..), stream| {
        if what == "POST /drive" {
            drop(opened.lock());
        }
        say(stream, "200 OK", "");
    });
    let served = Served::new(
        &web,
        "drive: {http: {post: 'http://{robot}/drive', abort: {post: 'http://{robot}/halt'}}},
         nap: {http: {post: 'http://{robot}/nap', for: 1 h, abort: {post: 'http://{robot}/halt'}}},
         fixed: {http: {post: 'http://{robot}/drive'}}",
    );
    let (mut remote, task) = served.trigger("p", "drive", "");
    web.wait_for("POST /drive");
    remote.abort(task).expect("an answer");
    web.wait_for("POST /halt");
    drop(held);
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
    assert_eq!(web.asked("POST /halt").len(), 2);
    let fixed = served.run("p", "fixed", "");
    assert_eq!(fixed.0, Completed);
    let stopped = "p:nap, has ended as ABORTED: the server was stopped";
    served.trigger("p", "nap", "");
    web.wait_for("POST /nap");
    served.server.process.signal("TERM");
    served.server.process.wait_for(stopped);
}

#[test]
fn a_robot_that_is_idle_since_it_was_aborted_has_not_completed_its_task() {
    let halted = Arc::new(Mutex::new(false));
    let web = Web::start(move |(what, ..), stream| match what.as_str() {
        "POST /halt" => {
            *halted.lock().expect("a truth value") = true;
            say(stream, "200 OK", "");
        }
        "GET /state" => {
            // The answer is under way when the abort comes.
            until("an abort", PATIENCE, || {
                halted.lock().expect("a truth value").then_some(())
            });
            say(stream, "200 OK", r#"{"state": "idle"}"#);
        }
        // It stops, and says nothing.
        "POST /mute" => {}
        _ => say(stream, "200 OK", ""),
    });
    let served = Served::new(
        &web,
        "move: {http: {post: 'http://{robot}/move', abort: {post: 'http://{robot}/halt'},
                       progress: {get: 'http://{robot}/state', every: 1 ms, until: {field: state, is: idle}}}},
         nap: {http: {post: 'http://{robot}/nap', for: 6 s, abort: {post: 'http://{robot}/mute'}}}",
    );
    let (mut remote, task) = served.trigger("p", "move", "");
    web.wait_for("GET /state");
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));

    let (mut remote, task) = served.trigger("p", "nap", "");
    web.wait_for("POST /nap");
    remote.abort(task).expect("an answer");
    let (state, text) = end(&mut remote, task);
    let unknown = "unknown: an abort was sent, which may have ended it early: ";
    assert_eq!((state, text.as_str()), (Failed, unknown));
}

#[test]
fn a_robot_whose_name_is_not_found_rejects_the_task() {
    let web = Web::start(|_, stream| say(stream, "200 OK", ""));
    // A label has at most 63 characters, so that no server of names is asked.
    let name = format!("{}.local", "x".repeat(64));
    let text = format!("go: {{http: {{post: 'http://{name}/go'}}}}");
    let (state, text) = Served::new(&web, &text).run("p", "go", "");
    let told = format!("POST http://{name}/go: ");
    assert!(
        state == State::Rejected && text.starts_with(&told),
        "{state} {text}"
    );
}

#[test]
fn mistakes_of_the_file_have_their_places() {
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    std::fs::write(scratch.path("empty.pem"), "").expect("to write");
    let text = "http: {robot: 'a b', safe: {host: 10.0.0.7, certificate: empty.pem}}
scopes: {/test: {p: {
    a: {http: {post: 'http://{robt}/x', json: {}}},
    b: {http: {post: 'ftp://10.0.0.7/x'}},
    c: {http: {get: 'http://10.0.0.7/{gaol}', json: {x: 1}}},
    d: {http: {json: {}}},
    e: {http: {post: 'http://{goal}/x'}},
    f: {http: {post: 'http://10.0.0.7/', put: 'http://10.0.0.7/', done: 99}},
    g: {http: {post: 'http://10.0.0.7/', headers: {Authorization: x}, progress: {get: 'http://10.0.0.7/'}}},
    h: {http: {post: 'http://10.0.0.7/', for: 1 s, bearer: nowhere.txt, done: {field: a..b, is: 1}}},
    i: {http: {post: 'ws://10.0.0.7/', json: '{answer.id}', event: {post: 'ws://10.0.0.7/', until: 200}}},
    j: {http: {event: {get: 'http://10.0.0.7/', send: 1, until: {event: x}, ready: {has: ''}}}},
    k: {http: {for: 1 s, event: {get: 'wss://{safe}:x/', until: {event: x}}}},
    l: {http: {get: 'http://{safe}/', event: {get: 'ws://{safe}/'}}},
    n: {http: {post: 'http://10.0.0.7/', for: soon, done: []}},
    o: {http: {event: {get: 'ws://10.0.0.7/', until: {field: a, is: '{answer.x}'}}, done: 200}},
    p: {post: 'http://10.0.0.7/'},
    q: {http: {post: 'http://10.0.0.7/', abort: no}},
    m: {http: {psot: 'http://10.0.0.7/'}, abort: {post: 'http://10.0.0.7/'}}}}}
streams: {/test: {s: {http-event: {get: 'ws://10.0.0.7/{goal.x}'}, only: {event: 1, x: 1}, frame: line}}}";
    std::fs::write(&path, text).expect("to write");
    let mut command = ztl();
    command.arg("serve").arg(&path).args(["-p", "0", "--check"]);
    let ended = Process::run(&mut command);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    for part in [
        ":1:15: 'a b' is not a host",
        ":3:22: no host is called 'robt'",
        ":4:22: 'ftp://10.0.0.7/x' is not an address",
        ":5:21: unknown placeholder '{gaol}'",
        ":5:53: get has no body",
        ":6:15: no request; write post: \"http://{robot}/api/halt\"",
        ":7:22: no host is called 'goal'; a client cannot choose the host",
        ":8:47: give only one of: get, post, put, patch, delete",
        ":8:73: '99' is not a status code",
        ":9:52: write bearer: FILE or basic: FILE",
        "until: {field: state, is: idle}",
        ":10:87: 'a..b' is not a field of the answer",
        ":1:58: ",
        "empty.pem: no certificate: expected PEM",
        ":11:22: 'ws://10.0.0.7/' is not an address",
        ":11:46: '{answer}' is known only after the answer",
        ":11:68: events are asked for with get, without a body",
        ":11:100: '200' is not {field: state, is: idle}",
        ":12:55: only a WebSocket takes messages",
        ":12:90: '' is not a field of the answer",
        ":13:33: give only one of: for, progress, event",
        ":14:46: 'until' is missing",
        ":15:47: 'soon' is not a time",
        ":15:59: this list is empty",
        ":16:69: '{answer}' is known only after the answer",
        ":16:91: done is about a request, and there is none",
        ":17:8: nothing does this task; write http: {post: ",
        ":18:49: without abort, clients cannot abort; leave it out",
        ":19:16: unknown key 'psot'; did you mean 'post'?",
        ":19:50: this stands beside http; write it inside: http: {…, abort: …}",
        ":20:41: no goal has 'x': it is nothing",
        ":20:85: unknown key 'x'",
        ":20:99: each message is a frame; leave this out",
    ] {
        assert!(ended.stderr.contains(part), "{part}: {}", ended.stderr);
    }
    // Each mistake is told once.
    assert_eq!(
        ended.stderr.matches("yaml:19:").count(),
        2,
        "{}",
        ended.stderr
    );
}
