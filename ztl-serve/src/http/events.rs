//! Events of a robot, over a WebSocket or as Server-Sent Events. A thread reads them until whoever listens lets go.

use std::io::{ErrorKind, Read as _};
use std::net::ToSocketAddrs as _;
use std::time::{Duration, Instant};

use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket};
use ureq::http::header::{ACCEPT, CONTENT_TYPE};
use ureq::http::{HeaderMap, HeaderValue};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node};

use super::dial::{Closer, Dial, Stream};
use super::exchange::{Answer, CONNECT, connection, no_answer};
use super::request::{Filled, RequestTemplate, Schemes};
use super::sse::SseReader;
use super::thread::spawn;
use crate::call::Call;
use crate::human::{human_size, human_time};
use crate::reader::ConfigReader;
use crate::value_template::ValueTemplate;

/// How long a WebSocket may be silent, where the file does not say it. After half of it, the robot is asked whether it is
/// there.
const SILENCE: Duration = Duration::from_secs(20);
/// The longest such time.
const LONGEST_SILENCE: Duration = Duration::from_hours(24);

/// Where events come from, as the file says.
#[derive(Debug)]
pub(crate) struct EventSource {
    request: RequestTemplate,
    /// What is sent when a WebSocket is open.
    send: Option<ValueTemplate>,
    silence: Option<Duration>,
}

/// What is heard.
#[derive(Debug)]
pub(super) enum Heard {
    /// The robot has accepted the connection.
    Open,
    Event(Answer),
    /// Why nothing more comes.
    Closed(String),
}

impl Heard {
    /// Its size in bytes. An event without a text takes memory, too.
    pub(super) fn len(&self) -> usize {
        let text = match self {
            Self::Open => 0,
            Self::Event(event) => event.len(),
            Self::Closed(reason) => reason.len(),
        };
        size_of::<Self>() + text
    }
}

/// Ends the connection when it is dropped.
#[derive(Debug)]
pub(crate) struct Listening(Closer);

impl Drop for Listening {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl<'d> ConfigReader<'d> {
    /// Reads where events come from. `node` is the mapping with these keys.
    pub(super) fn http_events(
        &mut self,
        node: &'d Node,
        fields: &mut Fields<'d>,
        rule: &GoalRule,
    ) -> Option<EventSource> {
        let send_node = fields.optional("send");
        let silence = fields.optional("silence");
        let request = self.http_request(fields, rule, Schemes::Events);
        let send = send_node.map(|node| self.value_template(node, rule));
        let silence = silence.map(|node| self.time(node, LONGEST_SILENCE));
        let request = request?;
        if let (Some(node), false) = (send_node, request.is_socket()) {
            let message =
                "only a WebSocket takes messages; its address begins with ws:// or wss://";
            self.yaml.wrong(node, message);
        }
        if request.has_body() || !request.is_get() {
            let message = "events are asked for with get, without a body";
            self.yaml.wrong(node, message);
        }
        Some(EventSource {
            request,
            send: match send {
                Some(send) => Some(send?),
                None => None,
            },
            silence: match silence {
                Some(silence) => Some(silence?),
                None => None,
            },
        })
    }
}

impl EventSource {
    /// Where they come from, for messages.
    pub(super) fn name(&self) -> String {
        self.request.name()
    }

    /// Adds each part of the goal that it uses.
    pub(super) fn goal_paths<'s>(&'s self, paths: &mut Vec<&'s [String]>) {
        paths.extend(self.request.goal_paths());
        if let Some(send) = &self.send {
            send.goal_paths(paths);
        }
    }

    /// What does not fit of a task's goal.
    pub(super) fn check(&self, call: &Call) -> Result<(), String> {
        self.fill(call).map(drop)
    }

    fn fill(&self, call: &Call) -> Result<(Filled, Option<String>), String> {
        let request = self.request.fill(call)?;
        let send = self.send.as_ref().map(|send| {
            let value = send.fill(call)?;
            serde_json::to_string(&value).map_err(|error| error.to_string())
        });
        Ok((request, send.transpose()?))
    }

    /// Connects on a thread, which tells what is heard, and at last that it is closed. `longest`: most bytes of an event.
    ///
    /// # Errors
    /// What of the call does not fit, or the system has no more threads.
    pub(super) fn listen(
        &self,
        call: &Call,
        longest: usize,
        mut on: impl FnMut(Heard) + Send + 'static,
    ) -> Result<Listening, String> {
        let (request, send) = self.fill(call)?;
        let closer = Closer::default();
        let connection = Connection {
            request,
            send,
            silence: self.silence,
            longest,
            closer: closer.clone(),
        };
        let is_socket = self.request.is_socket();
        spawn("ztl-http-events", move || {
            let reason = match is_socket {
                true => connection.socket(&mut on),
                false => connection.sent(&mut on),
            };
            on(Heard::Closed(reason));
        })?;
        Ok(Listening(closer))
    }
}

struct Connection {
    request: Filled,
    send: Option<String>,
    silence: Option<Duration>,
    longest: usize,
    closer: Closer,
}

impl Connection {
    /// Reads a WebSocket. Returns why it ends.
    fn socket(&self, on: &mut dyn FnMut(Heard)) -> String {
        let mut socket = match self.open_socket() {
            Ok(socket) => socket,
            Err(reason) => return reason,
        };
        on(Heard::Open);
        let silence = self.silence.unwrap_or(SILENCE);
        let mut is_asked = false;
        loop {
            let until = Instant::now().checked_add(silence / 2);
            socket.get_mut().set_until(until);
            match socket.read() {
                Ok(Message::Text(text)) => {
                    on(Heard::Event(Answer::of_event(None, text.as_bytes())))
                }
                Ok(Message::Binary(bytes)) => on(Heard::Event(Answer::of_event(None, &bytes))),
                // A ping is answered by the next read.
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => {}
                Ok(Message::Close(frame)) => {
                    let why = frame.map(|frame| frame.reason.to_string());
                    let why = why.filter(|why| !why.is_empty());
                    let why = why.map(|why| format!(": {why}")).unwrap_or_default();
                    // The answer to it.
                    let _ = socket.flush();
                    return format!("the robot has closed it{why}");
                }
                Err(Error::Io(error)) if error.kind() == ErrorKind::TimedOut => {
                    if is_asked {
                        return format!("the robot was silent for {}", human_time(silence));
                    }
                    is_asked = true;
                    let until = Instant::now().checked_add(CONNECT);
                    socket.get_mut().set_until(until);
                    if let Err(error) = socket.send(Message::Ping(Vec::new().into())) {
                        return self.why(&error);
                    }
                    continue;
                }
                Err(error) => return self.why(&error),
            }
            is_asked = false;
        }
    }

    fn why(&self, error: &Error) -> String {
        match error {
            Error::Capacity(_) => {
                format!("a message is longer than {}", human_size(self.longest))
            }
            Error::ConnectionClosed | Error::AlreadyClosed => "the robot has closed it".to_owned(),
            Error::Io(error) if error.kind() == ErrorKind::UnexpectedEof => {
                "the connection was closed".to_owned()
            }
            error => format!("the connection is broken: {error}"),
        }
    }

    fn open_socket(&self) -> Result<WebSocket<Stream>, String> {
        let uri = &self.request.uri;
        let host = uri.host().unwrap_or_default();
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let usual = if self.request.trust.is_some() {
            443
        } else {
            80
        };
        let addresses = (bare, uri.port_u16().unwrap_or(usual)).to_socket_addrs();
        let addresses: Vec<_> = addresses.map_err(|error| error.to_string())?.collect();
        let until = Instant::now() + CONNECT;
        let trust = self.request.trust.as_ref();
        let stream = Stream::open(&addresses, bare, trust, until, &self.closer);
        let stream = stream.map_err(|error| error.to_string())?;
        let mut asked = ureq::http::Request::builder().uri(uri);
        for (name, value) in &self.request.headers {
            asked = asked.header(name, value);
        }
        let key = tungstenite::handshake::client::generate_key();
        let authority = uri.authority().map(ToString::to_string);
        let asked = asked
            .header("Host", authority.unwrap_or_default())
            .header("Connection", "Upgrade")
            .header("Upgrade", "websocket")
            .header("Sec-WebSocket-Version", "13")
            .header("Sec-WebSocket-Key", key)
            .body(())
            .map_err(|error| error.to_string())?;
        let config = WebSocketConfig::default()
            .read_buffer_size(16 << 10)
            .write_buffer_size(0)
            .max_message_size(Some(self.longest))
            .max_frame_size(Some(self.longest));
        let opened = tungstenite::client::client_with_config(asked, stream, Some(config));
        let (mut socket, _) = opened.map_err(|error| match error {
            tungstenite::HandshakeError::Failure(Error::Http(answer)) => {
                format!("no WebSocket: status {}", answer.status().as_u16())
            }
            tungstenite::HandshakeError::Failure(Error::Io(error))
                if error.kind() == ErrorKind::TimedOut =>
            {
                "no WebSocket in time".to_owned()
            }
            tungstenite::HandshakeError::Failure(error) => format!("no WebSocket: {error}"),
            tungstenite::HandshakeError::Interrupted(_) => "no WebSocket in time".to_owned(),
        })?;
        if let Some(text) = &self.send {
            let sent = socket.send(Message::Text(text.as_str().into()));
            sent.map_err(|error| self.why(&error))?;
        }
        Ok(socket)
    }

    fn why_ended(&self, error: &std::io::Error) -> String {
        match self.silence {
            Some(silence) if is_timeout(error) => {
                format!("the robot was silent for {}", human_time(silence))
            }
            _ => format!("the connection is broken: {error}"),
        }
    }

    /// Reads Server-Sent Events. Returns why they end.
    fn sent(&self, on: &mut dyn FnMut(Heard)) -> String {
        let dial = Dial {
            trust: self.request.trust.clone(),
            closer: self.closer.clone(),
            silence: self.silence,
        };
        let mut request = self.request.clone();
        let accepted = HeaderValue::from_static("text/event-stream");
        request.headers.push((ACCEPT, accepted));
        let answer = connection(&request, &request.uri, dial, None);
        let mut answer = match answer {
            Ok(answer) => answer,
            Err(error) => return no_answer(&error).reason,
        };
        let status = answer.status().as_u16();
        if status != 200 {
            return format!("no events: status {status}");
        }
        if !is_event_stream(answer.headers()) {
            return "no events: expected text/event-stream".to_owned();
        }
        on(Heard::Open);
        let mut reader = answer.body_mut().as_reader();
        let mut events = SseReader::new(self.longest);
        let mut buffer = [0; 4096];
        loop {
            let count = match reader.read(&mut buffer) {
                Ok(0) => return "the robot has ended them".to_owned(),
                Ok(count) => count,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => return self.why_ended(&error),
            };
            let pushed = events.push(buffer.get(..count).unwrap_or_default(), |event| {
                on(Heard::Event(Answer::of_event(event.name, &event.data)));
            });
            if pushed.is_err() {
                return format!("an event is longer than {}", human_size(self.longest));
            }
        }
    }
}

fn is_timeout(error: &std::io::Error) -> bool {
    let cause = error.get_ref().and_then(|it| it.downcast_ref());
    matches!(cause, Some(ureq::Error::Timeout(_)))
}

fn is_event_stream(headers: &HeaderMap) -> bool {
    let kind = headers.get(CONTENT_TYPE);
    let kind = kind.and_then(|kind| kind.to_str().ok()).unwrap_or_default();
    kind.trim_start()
        .to_ascii_lowercase()
        .starts_with("text/event-stream")
}
