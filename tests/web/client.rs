//! A client of `/rosbridge` that tells when it hears what.

use std::collections::VecDeque;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::{Value, json};
use ztl_tests::lab::PATIENCE;

/// A WebSocket.
pub(crate) struct Client {
    stream: TcpStream,
    heard: VecDeque<Value>,
}

impl Client {
    /// Connects to a console at this port.
    #[track_caller]
    pub(crate) fn open(port: u16) -> Self {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
        stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
        stream.set_nodelay(true).expect("an option");
        let request = format!(
            "GET /rosbridge HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).expect("a request");
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).expect("an answer");
            head.push(byte[0]);
        }
        let head = String::from_utf8(head).expect("UTF-8");
        assert!(head.starts_with("HTTP/1.1 101 "), "{head}");
        let heard = VecDeque::new();
        Self { stream, heard }
    }

    pub(crate) fn send(&mut self, message: &Value) {
        let text = message.to_string();
        let length = u16::try_from(text.len()).expect("a short message");
        // The last fragment of a text; masked with zeros.
        let mut frame = vec![0x81, 0x80 | 126];
        frame.extend_from_slice(&length.to_be_bytes());
        frame.extend_from_slice(&[0; 4]);
        frame.extend_from_slice(text.as_bytes());
        self.stream.write_all(&frame).expect("to write");
    }

    /// The next message; `None` if the console closes the socket.
    fn receive(&mut self) -> Option<Value> {
        let mut read = |count| {
            let mut bytes = vec![0xA5; count];
            self.stream.read_exact(&mut bytes).map(|()| bytes)
        };
        loop {
            let head = read(2).ok()?;
            let length = match head[1] {
                126 => u16::from_be_bytes(read(2).ok()?.try_into().ok()?).into(),
                127 => u64::from_be_bytes(read(8).ok()?.try_into().ok()?),
                short => short.into(),
            };
            let body = read(usize::try_from(length).ok()?).ok()?;
            match head[0] {
                0x81 => return Some(serde_json::from_slice(&body).expect("JSON")),
                0x88 => return None,
                // A ping.
                _ => {}
            }
        }
    }

    /// The first message that fits, taken from what was heard.
    #[track_caller]
    pub(crate) fn next(&mut self, fits: impl Fn(&Value) -> bool) -> Value {
        if let Some(at) = self.heard.iter().position(&fits) {
            return self.heard.remove(at).expect("it is there");
        }
        loop {
            let message = self.receive().expect("a message within the time");
            if fits(&message) {
                return message;
            }
            self.heard.push_back(message);
        }
    }

    /// Receives the tasks until all is over, without reading them. The console closes the connection of whoever answers no
    /// ping, so it may be over before.
    pub(crate) fn drain(mut self, over: &AtomicBool) {
        self.subscribe("/ztl/tasks");
        let mut bytes = vec![0xA5; 64 << 10];
        while !over.load(Ordering::SeqCst) {
            let count = self.stream.read(&mut bytes);
            if count.expect("a message within the time") == 0 {
                return;
            }
        }
    }

    pub(crate) fn subscribe(&mut self, topic: &str) {
        self.send(&json!({ "op": "subscribe", "topic": topic }));
    }

    /// The next value of a topic that fits.
    #[track_caller]
    pub(crate) fn topic(&mut self, topic: &str, fits: impl Fn(&Value) -> bool) -> Value {
        let mut message = self.next(|message| message["topic"] == topic && fits(&message["msg"]));
        message["msg"].take()
    }

    /// Waits for a list of tasks that has one for which `fits` is true.
    #[track_caller]
    pub(crate) fn task(&mut self, fits: impl Fn(&Value) -> bool) -> Value {
        let has = |list: &Value| {
            let tasks = list["tasks"].as_array().expect("a list");
            tasks.iter().find(|task| fits(task)).cloned()
        };
        let list = self.topic("/ztl/tasks", |list| has(list).is_some());
        has(&list).expect("it fits")
    }

    pub(crate) fn unsubscribe(&mut self, topic: &str) {
        self.send(&json!({ "op": "unsubscribe", "topic": topic }));
    }

    /// The console's clock, in milliseconds.
    #[track_caller]
    pub(crate) fn now_ms(&mut self) -> u64 {
        let told = self.call("/ztl/time", &json!({}));
        told["now_ms"].as_u64().expect("a time")
    }

    /// Calls a service without waiting for the answer.
    pub(crate) fn ask(&mut self, id: &str, service: &str, args: &Value) {
        self.send(&json!({ "op": "call_service", "id": id, "service": service, "args": args }));
    }

    /// The answer to a call.
    #[track_caller]
    pub(crate) fn answer(&mut self, id: &str) -> Value {
        self.next(|message| message["op"] == "service_response" && message["id"] == id)
    }

    /// Calls a service; returns its values.
    #[track_caller]
    pub(crate) fn call(&mut self, service: &str, args: &Value) -> Value {
        self.ask(service, service, args);
        self.answer(service)["values"].take()
    }

    /// Sends a goal. `args` has its text, and may have a time.
    pub(crate) fn goal(&mut self, id: &str, action: &str, args: &Value) {
        self.send(&json!({
            "op": "send_action_goal", "id": id, "action": action, "args": args, "feedback": true,
        }));
    }

    /// The result of a goal.
    #[track_caller]
    pub(crate) fn result(&mut self, id: &str) -> Value {
        self.next(|message| message["op"] == "action_result" && message["id"] == id)
    }
}
