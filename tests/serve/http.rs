//! `http`, against a server on a thread: requests, what their answers mean, and servers that misbehave.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ztl_std::State::{Aborted, Completed, Failed};
use ztl_std::{RemoteTask, State, TaskId};
use ztl_tests::lab::{
    PATIENCE, Process, Scratch, Server, connect_to, end, outcome, start, until, ztl,
};

use crate::rig::project;

/// A request: method and address, headers in lower case, body.
type Request = (String, String, String);
type Answer = dyn Fn(&Request, &mut TcpStream) + Send + Sync;

/// A server that notes what it is asked.
struct Web {
    port: u16,
    asked: Arc<Mutex<Vec<Request>>>,
}

impl Web {
    fn start(answer: impl Fn(&Request, &mut TcpStream) + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("an address").port();
        let asked = Arc::new(Mutex::new(Vec::new()));
        let (noted, answer): (_, Arc<Answer>) = (Arc::clone(&asked), Arc::new(answer));
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let (noted, answer) = (Arc::clone(&noted), Arc::clone(&answer));
                std::thread::spawn(move || serve(stream, &noted, &*answer));
            }
        });
        Self { port, asked }
    }

    /// The bodies of all requests for this.
    fn asked(&self, what: &str) -> Vec<Request> {
        let asked = self.asked.lock().expect("requests");
        let meant = asked.iter().filter(|(line, ..)| line == what);
        meant.cloned().collect()
    }

    #[track_caller]
    fn wait_for(&self, what: &str) -> Request {
        until(what, PATIENCE, || self.asked(what).pop())
    }
}

fn serve(mut stream: TcpStream, noted: &Mutex<Vec<Request>>, answer: &Answer) {
    let mut reader = BufReader::new(stream.try_clone().expect("a stream"));
    let mut line = String::new();
    let _ = reader.read_line(&mut line);
    let what = line.trim_end().trim_end_matches(" HTTP/1.1").to_owned();
    let (mut headers, mut length) = (String::new(), 0);
    loop {
        let mut header = String::new();
        let _ = reader.read_line(&mut header);
        let header = header.trim_end().to_owned();
        if header.is_empty() {
            break;
        }
        if let Some(number) = header.to_lowercase().strip_prefix("content-length: ") {
            length = number.parse().expect("a length");
        }
        headers.push_str(&header);
        headers.push('\n');
    }
    let mut body = vec![0; length];
    let _ = reader.read_exact(&mut body);
    let body = String::from_utf8(body).expect("UTF-8");
    let request = (what, headers, body);
    noted.lock().expect("requests").push(request.clone());
    answer(&request, &mut stream);
}

fn say(stream: &mut TcpStream, status: &str, body: &str) {
    let length = body.len();
    let head =
        format!("HTTP/1.1 {status}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n");
    let _ = stream.write_all(format!("{head}{body}").as_bytes());
}

/// `ztl serve` with components of a handler `p`.
struct Served {
    server: Server,
    scope: &'static str,
    scratch: Scratch,
}

impl Served {
    #[track_caller]
    fn file(scope: &'static str, text: &str) -> Self {
        let scratch = Scratch::new();
        std::fs::write(scratch.path("token.txt"), "s3cret\n").expect("to write");
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text).expect("to write");
        let server = Server::start(ztl().arg("serve").arg(&path).args(["-p", "0"]));
        Self {
            server,
            scope,
            scratch,
        }
    }

    #[track_caller]
    fn new(web: &Web, components: &str) -> Self {
        let hosts = format!("http: {{robot: '127.0.0.1:{}'}}", web.port);
        let text = format!("{hosts}\nscopes: {{/test: {{p: {{\n{components}}}}}}}");
        Self::file("/test", &text)
    }

    #[track_caller]
    fn remote(&self) -> RemoteTask {
        connect_to(&self.server.endpoint(), self.scope).with_timeout(PATIENCE)
    }

    /// [`outcome`] of a task.
    #[track_caller]
    fn run(&self, handler: &str, component: &str, goal: &str) -> (State, String) {
        outcome(&mut self.remote(), handler, component, goal)
    }

    #[track_caller]
    fn trigger(&self, handler: &str, component: &str, goal: &str) -> (RemoteTask, TaskId) {
        let mut remote = self.remote();
        let id = start(&mut remote, handler, component, goal);
        (remote, id)
    }
}

const SUCCESS: &str = r#"{"result": true, "status": "Success"}"#;

/// A stand-in for Misty, as its documentation says.
fn misty() -> Web {
    Web::start(|(what, _, body), stream| match what.as_str() {
        "GET /api/battery" => say(
            stream,
            "200 OK",
            r#"{"result": {"chargePercent": 0.87}, "status": "Success"}"#,
        ),
        "POST /api/images/display" if !body.contains(".jpg") => {
            say(
                stream,
                "400 Bad Request",
                r#"{"error": "no such file", "status": "Failed"}"#,
            );
        }
        "POST /api/images/display"
        | "POST /api/arms/set"
        | "POST /api/drive/time"
        | "POST /api/tts/speak"
        | "POST /api/tts/stop"
        | "POST /api/halt"
        | "POST /api/head"
        | "POST /api/led" => say(stream, "200 OK", SUCCESS),
        _ => say(stream, "404 Not Found", ""),
    })
}

#[test]
fn the_example_for_misty_shows_moves_drives_speaks_and_halts() {
    let web = misty();
    let text = std::fs::read_to_string(project("examples/serve/misty.yaml")).expect("an example");
    let text = text.replace("192.168.1.50", &format!("'127.0.0.1:{}'", web.port));
    let misty = Served::file("/misty", &text);
    let success = (
        Completed,
        "{'result': True, 'status': 'Success'}".to_owned(),
    );
    for (handler, component, goal, request, body) in [
        (
            "face",
            "show",
            "e_Joy.jpg",
            "POST /api/images/display",
            r#"{"FileName":"e_Joy.jpg"}"#,
        ),
        (
            "face",
            "led",
            "{red: 255, green: 0, blue: 7}",
            "POST /api/led",
            r#"{"red":255,"green":0,"blue":7}"#,
        ),
        (
            "arms",
            "move",
            "{left: -29, right: 90}",
            "POST /api/arms/set",
            r#"{"LeftArmPosition":-29,"RightArmPosition":90,"LeftArmVelocity":60,"RightArmVelocity":60,"Units":"degrees"}"#,
        ),
        (
            "head",
            "look",
            "{yaw: 10.5}",
            "POST /api/head",
            r#"{"Pitch":0,"Roll":0,"Yaw":10.5,"Velocity":60,"Units":"degrees"}"#,
        ),
        (
            "base",
            "drive",
            "{speed: 10, ms: 100}",
            "POST /api/drive/time",
            r#"{"LinearVelocity":10,"AngularVelocity":0,"TimeMs":100}"#,
        ),
        (
            "tts",
            "say",
            "he said \"hi\", {x}",
            "POST /api/tts/speak",
            r#"{"Text":"he said \"hi\", {x}","Flush":false}"#,
        ),
    ] {
        assert_eq!(misty.run(handler, component, goal), success, "{component}");
        let (_, headers, sent) = web.wait_for(request);
        assert_eq!(sent, body, "{component}");
        assert!(
            headers
                .to_lowercase()
                .contains("content-type: application/json"),
            "{headers}"
        );
    }
    assert_eq!(
        misty.run("battery", "level", ""),
        (Completed, "0.87".to_owned())
    );
    let failed = "status 400: {'error': 'no such file', 'status': 'Failed'}";
    assert_eq!(
        misty.run("face", "show", "joy"),
        (Failed, failed.to_owned())
    );

    let (mut remote, task) = misty.trigger("base", "drive", "{speed: 10, ms: 10000}");
    web.wait_for("POST /api/drive/time");
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
    assert!(!web.asked("POST /api/halt").is_empty());
}

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
        let redirect = |stream: &mut TcpStream, status: &str, to: &str| {
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
        "get: {http: {get: 'http://{robot}/{goal}', limit: 500 ms}},
         post: {http: {post: 'http://{robot}/{goal}', limit: 500 ms}},
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
        ("get", "drip", "unknown: whether GET http://127.0.0.1:"),
        ("post", "moved", "status 302"),
        ("post", "silent", "was done: no answer in time"),
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
         never: {http: {post: 'http://{robot}/begin', limit: 300 ms, abort: {post: 'http://{robot}/halt'},
                        progress: {get: 'http://{robot}/never', every: 10 ms, until: {field: state, is: idle}}}},
         wrong: {http: {post: 'http://{robot}/begin', done: 200}}",
    );
    assert_eq!(served.run("p", "shaky", ""), (Completed, "7".to_owned()));
    assert_eq!(web.asked("POST /shaky").len(), 3);
    assert_eq!(served.run("p", "begin", ""), (Completed, "100".to_owned()));
    let late = "not over within 300 ms; it was aborted";
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
}

#[test]
fn mistakes_of_the_file_have_their_places() {
    let scratch = Scratch::new();
    let path = scratch.path("robot.yaml");
    let text = "http: {robot: 'a b'}
scopes: {/test: {p: {
    a: {http: {post: 'http://{robt}/x', json: {}}},
    b: {http: {post: 'ftp://10.0.0.7/x'}},
    c: {http: {get: 'http://10.0.0.7/{gaol}', json: {x: 1}}},
    d: {http: {json: {}}},
    e: {http: {post: 'http://{goal}/x'}},
    f: {http: {post: 'http://10.0.0.7/', put: 'http://10.0.0.7/', done: 99}},
    g: {http: {post: 'http://10.0.0.7/', headers: {Authorization: x}, progress: {get: 'http://10.0.0.7/'}}},
    h: {http: {post: 'http://10.0.0.7/', for: 1 s, bearer: nowhere.txt, done: {field: a..b, is: 1}}}}}}";
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
        ":6:15: no request; write post:",
        ":7:22: no host is called 'goal'; a client cannot choose the host",
        ":8:47: give only one of: get, post, put, patch, delete",
        ":8:73: '99' is not a status code",
        ":9:52: write bearer: FILE or basic: FILE",
        "until: {field: state, is: idle}",
        ":10:87: 'a..b' is not a field of the answer",
    ] {
        assert!(ended.stderr.contains(part), "{part}: {}", ended.stderr);
    }
}
