//! Events: WebSockets and Server-Sent Events that end tasks and are streams, and servers of them that misbehave.

use std::io::Write as _;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ztl_std::State::{Aborted, Completed, Failed, Rejected};
use ztl_std::Subscriber;
use ztl_tests::lab::{PATIENCE, end, until};

use super::web::{Served, Socket, Web, Wire, say};

/// How often a server looks whether it is to send something.
const TICK: Duration = Duration::from_millis(20);

/// What a server tells all who listen, in order.
#[derive(Clone, Default)]
struct News(Arc<Mutex<Vec<String>>>);

impl News {
    fn add(&self, text: impl Into<String>) {
        self.0.lock().expect("news").push(text.into());
    }

    /// How many there are.
    fn count(&self) -> usize {
        self.0.lock().expect("news").len()
    }

    fn from(&self, start: usize) -> Vec<String> {
        let news = self.0.lock().expect("news");
        news.get(start..).unwrap_or_default().to_vec()
    }

    /// Tells a WebSocket the news after the first `told`, until the client goes away. Count them before the client learns that
    /// somebody listens: it may then do what makes news.
    fn tell(&self, socket: &mut Socket<'_>, mut told: usize) {
        while socket.next(TICK).is_ok() {
            for text in self.from(told) {
                told += 1;
                match text.as_str() {
                    "close" => return socket.close(),
                    text if !socket.send(text) => return,
                    _ => {}
                }
            }
        }
    }
}

#[test]
fn an_event_ends_a_task_also_one_that_comes_before_the_answer() {
    let news = News::default();
    let told = news.clone();
    let moves = Mutex::new(0);
    let web = Web::start(move |request, wire| match request.0.as_str() {
        "GET /events" => {
            let mut socket = Socket::accept(request, wire);
            // A subscription is confirmed before anything is asked for.
            let wish = until("a subscription", PATIENCE, || {
                socket.next(PATIENCE).expect("a client")
            });
            assert!(wish.starts_with(r#"{"subscribe":"moves-"#), "{wish}");
            let count = told.count();
            assert!(socket.send(r#"{"confirmed": true}"#));
            told.tell(&mut socket, count);
        }
        "POST /move" => {
            let mut id = moves.lock().expect("a number");
            *id += 1;
            // Quicker than the answer.
            if *id == 1 {
                told.add(r#"{"id": 7, "done": true}"#);
                told.add(r#"{"id": 1, "done": true, "at": "home"}"#);
            }
            say(wire, "200 OK", &format!(r#"{{"id": {id}}}"#));
        }
        "POST /halt" => say(wire, "200 OK", ""),
        _ => say(wire, "404 Not Found", ""),
    });
    let served = Served::new(
        &web,
        "move: {http: {post: 'http://{robot}/move', json: {to: '{goal}'}, result: at, limit: 30 s,
                abort: {post: 'http://{robot}/halt', json: {id: '{answer.id}'}},
                event: {get: 'ws://{robot}/events', send: {subscribe: 'moves-{id}'}, ready: {has: confirmed},
                        until: {fields: {id: '{answer.id}', done: true}},
                        failed: [{fields: {id: '{answer.id}', broken: true}}], show: percent}}}",
    );
    assert_eq!(served.run("p", "move", "1"), (Completed, "home".to_owned()));

    let (mut remote, task) = served.trigger("p", "move", "2");
    let moves = |count: usize| {
        until("the request", PATIENCE, || {
            web.asked("POST /move").get(count - 1).cloned()
        })
    };
    moves(2);
    news.add(r#"{"id": 1, "broken": true}"#);
    news.add(r#"{"percent": 30}"#);
    until("progress", PATIENCE, || {
        (remote.status(task).expect("a status").text == "30").then_some(())
    });
    news.add(r#"{"id": 2, "broken": true}"#);
    let broken = "{'id': 2, 'broken': True}".to_owned();
    assert_eq!(end(&mut remote, task), (Failed, broken));

    let (mut remote, task) = served.trigger("p", "move", "3");
    moves(3);
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task), (Aborted, "aborted".to_owned()));
    let halts = web.asked("POST /halt");
    assert_eq!(halts.last().expect("an abort").2, r#"{"id":3}"#);
}

#[test]
fn an_event_from_before_the_answer_ends_no_task_that_it_does_not_name() {
    let news = News::default();
    let told = news.clone();
    let is_read = Arc::new(Mutex::new(false));
    let read = Arc::clone(&is_read);
    let web = Web::start(move |request, wire| match request.0.as_str() {
        "GET /events" => {
            let mut socket = Socket::accept(request, wire);
            // What it does when somebody begins to listen.
            assert!(socket.send(r#"{"state": "idle"}"#));
            *read.lock().expect("a truth value") = socket.wait_until_read();
            told.tell(&mut socket, told.count());
        }
        "POST /drive" => {
            until("the event is read", PATIENCE, || {
                is_read.lock().expect("a truth value").then_some(())
            });
            say(wire, "200 OK", "");
        }
        _ => say(wire, "404 Not Found", ""),
    });
    let served = Served::new(
        &web,
        "drive: {http: {post: 'http://{robot}/drive', limit: 1 min,
                event: {get: 'ws://{robot}/events', until: {field: state, is: idle}, show: state}}}",
    );
    let (mut remote, task) = served.trigger("p", "drive", "");
    until("progress", PATIENCE, || {
        // It listens from some time on.
        news.add(r#"{"state": "busy"}"#);
        (remote.status(task).expect("a status").text == "busy").then_some(())
    });
    news.add(r#"{"state": "idle"}"#);
    assert_eq!(end(&mut remote, task).0, Completed);
}

#[test]
fn a_task_whose_events_are_lost_or_never_come_says_so() {
    let web = Web::start(|request, wire| match request.0.as_str() {
        "GET /closes" => Socket::accept(request, wire).close(),
        "GET /vanishes" => drop(Socket::accept(request, wire)),
        "GET /silent" => {
            let mut socket = Socket::accept(request, wire);
            while socket.next(TICK).is_ok() {}
        }
        "GET /huge" => {
            let mut socket = Socket::accept(request, wire);
            socket.send(&"x".repeat(100_000));
            while socket.next(TICK).is_ok() {}
        }
        // More than is kept, then what is waited for.
        "GET /flood" => {
            let mut socket = Socket::accept(request, wire);
            for number in 0..20_000 {
                socket.send(&format!(
                    r#"{{"n": {number}, "text": "{}"}}"#,
                    "y".repeat(50)
                ));
            }
            // What comes before the answer does not count.
            while socket.send(r#"{"done": true}"#) && socket.next(TICK).is_ok() {}
        }
        "GET /none" => say(wire, "403 Forbidden", ""),
        "GET /sse" => {
            let head =
                "HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nConnection: close\r\n\r\n";
            let _ = wire.write_all(head.as_bytes());
            let _ = wire.write_all(b": hello\n\nevent: other\ndata: x\n\n");
            let end = b"event: end\ndata: all\ndata: done\n\n";
            while wire.write_all(end).is_ok() {
                std::thread::sleep(TICK);
            }
        }
        "GET /text" => say(wire, "200 OK", "data: x\n\n"),
        _ => say(wire, "200 OK", ""),
    });
    let component = |name: &str, rest: &str| {
        format!(
            "{name}: {{http: {{post: 'http://{{robot}}/go', abort: {{post: 'http://{{robot}}/halt'}},
                      event: {{get: 'ws://{{robot}}/{name}', {rest}}}}}}}"
        )
    };
    let until_done = "until: {field: done, is: true}";
    let components = [
        component("closes", until_done),
        component("vanishes", until_done),
        component("silent", until_done).replacen("{post", "{limit: 4 s, post", 1),
        component("huge", until_done),
        component("flood", until_done),
        component("none", until_done),
        component("sse", "until: {event: end}").replace("ws://", "http://"),
        component("text", "until: {event: end}").replace("ws://", "http://"),
        format!("wait: {{http: {{limit: 4 s, event: {{get: 'ws://{{robot}}/silent', {until_done}}}}}}}"),
        format!("aborted: {{http: {{limit: 1 min, event: {{get: 'ws://{{robot}}/silent', {until_done}}}}}}}"),
        "unready: {http: {post: 'http://{robot}/never', event: {get: 'ws://{robot}/silent', ready: {has: x}, until: {has: y}}, limit: 1 s}}".to_owned(),
        "gone: {http: {post: 'http://{robot}/never', event: {get: 'ws://127.0.0.1:1/', until: {has: y}}}}".to_owned(),
    ];
    let served = Served::new(&web, &components.join(",\n"));
    let at = format!("GET ws://127.0.0.1:{}", web.port);
    for (component, state, text) in [
        (
            "closes",
            Failed,
            format!(
                "unknown: no more events of {at}/closes, it was aborted: the robot has closed it"
            ),
        ),
        (
            "vanishes",
            Failed,
            format!("unknown: no more events of {at}/vanishes, it was aborted: the connection "),
        ),
        (
            "silent",
            Failed,
            "not over within 4 s; it was aborted".to_owned(),
        ),
        ("huge", Failed, "a message is longer than 64 KiB".to_owned()),
        ("flood", Completed, "{'done': True}".to_owned()),
        (
            "none",
            Rejected,
            format!("{at}/none: no WebSocket: status 403"),
        ),
        ("sse", Completed, "all\ndone".to_owned()),
        (
            "text",
            Rejected,
            "no events: expected text/event-stream".to_owned(),
        ),
        ("wait", Failed, "no such event within 4 s".to_owned()),
        (
            "unready",
            Failed,
            "no event has confirmed in time that it listens (ready)".to_owned(),
        ),
        (
            "gone",
            Rejected,
            "GET ws://127.0.0.1:1/: Connection refused".to_owned(),
        ),
    ] {
        let ended = served.run("p", component, "");
        assert!(
            ended.0 == state && ended.1.contains(&text),
            "{component}: {ended:?}"
        );
    }
    assert!(web.asked("POST /never").is_empty());
    let (mut remote, task) = served.trigger("p", "aborted", "");
    remote.abort(task).expect("an answer");
    assert_eq!(end(&mut remote, task).0, Aborted);
}

#[test]
fn streams_of_events_are_picked_from_and_connect_again() {
    let news = News::default();
    let told = news.clone();
    let web = Web::start(move |request, wire| match request.0.as_str() {
        "GET /ws" => {
            let count = told.count();
            told.tell(&mut Socket::accept(request, wire), count);
        }
        // It answers no ping, since it never reads.
        "GET /dead" => {
            let mut socket = Socket::accept(request, wire);
            socket.send("1");
            loop {
                std::thread::park();
            }
        }
        "GET /sse" => sent_events(wire, &told),
        // It says nothing.
        "GET /quiet" => sent_events(wire, &News::default()),
        _ => say(wire, "404 Not Found", ""),
    });
    let text = format!(
        "http: {{robot: '127.0.0.1:{}'}}
streams: {{/test: {{
    all: {{http-event: {{get: 'ws://{{robot}}/ws'}}}},
    at: {{http-event: {{get: 'ws://{{robot}}/ws', bearer: token.txt}}, only: {{field: kind, is: touch}}, field: at.x}},
    sse: {{http-event: {{get: 'http://{{robot}}/sse'}}, only: {{event: touch}}}},
    quiet: {{http-event: {{get: 'http://{{robot}}/quiet', silence: 200 ms}}}},
    dead: {{http-event: {{get: 'ws://{{robot}}/dead', silence: 200 ms}}}},
    small: {{http-event: {{get: 'ws://{{robot}}/ws'}}, longest: 100 bytes}}}}}}\n",
        web.port
    );
    let served = Served::file("/test", &text);
    let [mut all, mut at, mut sse, mut small] =
        ["all", "at", "sse", "small"].map(|name| served.subscribe(&format!("/test/{name}")));
    // What is sent before a subscription is lost, so a value comes again and again until all have one.
    let touch = r#"{"kind": "touch", "at": {"x": 7}}"#;
    let shown = "{'kind': 'touch', 'at': {'x': 7}}";
    let expected = [
        (&mut all, shown),
        (&mut at, "7"),
        (&mut sse, shown),
        (&mut small, shown),
    ];
    for (values, shown) in expected {
        until("a value", PATIENCE, || {
            news.add(touch);
            let heard = values
                .next_within(Duration::from_millis(100))
                .expect("it can wait")?;
            let value = heard.value().expect("plain data");
            assert_eq!(value.value().repr().to_string(), shown);
            Some(())
        });
    }
    let headers = web
        .asked("GET /ws")
        .iter()
        .map(|it| it.1.to_lowercase())
        .collect::<String>();
    assert!(
        headers.contains("authorization: bearer s3cret"),
        "{headers}"
    );

    let mut long = r#"{"kind": "long", "text": ""#.to_owned();
    long.push_str(&"z".repeat(100));
    long.push_str("\"}");
    news.add(long);
    served
        .server
        .process
        .wait_for("Stream /test/small has ended, and begins again in 500 ms: GET ws://127.0.0.1:");
    for (name, address) in [("quiet", "http"), ("dead", "ws")] {
        served.server.process.wait_for(&format!(
            "Stream /test/{name} has ended, and begins again in 500 ms: GET {address}://127.0.0.1:{}/{name}: the robot was silent for 200 ms",
            web.port
        ));
    }
    is_told(&news, "1", &mut small, "1");
    // All connect again after the server has closed; what is not JSON is a text.
    let count = web.asked("GET /ws").len();
    news.add("close");
    until("new connections", PATIENCE, || {
        (web.asked("GET /ws").len() >= count + 3).then_some(())
    });
    is_told(&news, "plain words", &mut all, "'plain words'");
}

/// Adds this to the news until a subscriber is told it. What is added before its stream is connected is lost.
#[track_caller]
fn is_told(news: &News, text: &str, values: &mut Subscriber, shown: &str) {
    until(shown, PATIENCE, || {
        news.add(text);
        let heard = values.next_within(Duration::from_millis(100));
        let value = heard.expect("it can wait")?.value().expect("plain data");
        (value.value().repr().to_string() == shown).then_some(())
    });
}

/// Tells the news as events named `touch`, until the client goes away.
fn sent_events(wire: &mut Wire, news: &News) {
    let head = "HTTP/1.1 200 OK\r\nContent-Type: text/event-stream; charset=utf-8\r\nTransfer-Encoding: chunked\r\n\r\n";
    let mut told = news.count();
    if wire.write_all(head.as_bytes()).is_err() {
        return;
    }
    loop {
        let new = news.from(told);
        told += new.len();
        for text in new {
            let text = format!("event: touch\ndata: {text}\n\n");
            let chunk = format!("{:x}\r\n{text}\r\n", text.len());
            if wire
                .write_all(chunk.as_bytes())
                .and_then(|()| wire.flush())
                .is_err()
            {
                return;
            }
        }
        // The server has no other way to wait for news and for the client at once.
        std::thread::sleep(TICK);
    }
}
