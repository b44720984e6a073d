//! A web server on a thread, plain or encrypted, with WebSockets; and `ztl serve` for it.

use std::io::{self, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustls::{ServerConfig, ServerConnection, StreamOwned};
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::Role;
use tungstenite::{Error, Message, WebSocket};
use ztl_std::{RemoteTask, State, Subscriber, TaskId};
use ztl_tests::lab::{
    PATIENCE, Scratch, Server, connect_to, outcome, reserve_port, start, until, ztl,
};

/// A request: method and address, headers, body.
pub(crate) type Request = (String, String, String);
type Answer = dyn Fn(&Request, &mut Wire) + Send + Sync;

/// A connection of a client.
pub(crate) enum Wire {
    Plain(TcpStream),
    Tls(Box<StreamOwned<ServerConnection, TcpStream>>),
}

impl Wire {
    fn tcp(&self) -> &TcpStream {
        match self {
            Self::Plain(stream) => stream,
            Self::Tls(stream) => &stream.sock,
        }
    }
}

impl Read for Wire {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(stream) => stream.read(buffer),
            Self::Tls(stream) => stream.read(buffer),
        }
    }
}

impl Write for Wire {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(stream) => stream.write(bytes),
            Self::Tls(stream) => stream.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(stream) => stream.flush(),
            Self::Tls(stream) => stream.flush(),
        }
    }
}

/// A server that notes what it is asked.
pub(crate) struct Web {
    pub(crate) port: u16,
    pub(crate) asked: Arc<Mutex<Vec<Request>>>,
}

impl Web {
    pub(crate) fn start(answer: impl Fn(&Request, &mut Wire) + Send + Sync + 'static) -> Self {
        Self::with(None, answer)
    }

    /// With TLS.
    pub(crate) fn with(
        tls: Option<Arc<ServerConfig>>,
        answer: impl Fn(&Request, &mut Wire) + Send + Sync + 'static,
    ) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = listener.local_addr().expect("an address").port();
        let asked = Arc::new(Mutex::new(Vec::new()));
        let (noted, answer): (_, Arc<Answer>) = (Arc::clone(&asked), Arc::new(answer));
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let (noted, answer) = (Arc::clone(&noted), Arc::clone(&answer));
                let tls = tls.clone();
                std::thread::spawn(move || {
                    let wire = match tls {
                        Some(config) => {
                            let tls = ServerConnection::new(config).expect("a connection");
                            Wire::Tls(Box::new(StreamOwned::new(tls, stream)))
                        }
                        None => Wire::Plain(stream),
                    };
                    serve(wire, &noted, &*answer)
                });
            }
        });
        Self { port, asked }
    }

    /// All requests for this.
    pub(crate) fn asked(&self, what: &str) -> Vec<Request> {
        let asked = self.asked.lock().expect("requests");
        let meant = asked.iter().filter(|(line, ..)| line == what);
        meant.cloned().collect()
    }

    #[track_caller]
    pub(crate) fn wait_for(&self, what: &str) -> Request {
        until(what, PATIENCE, || self.asked(what).pop())
    }
}

/// Reads a request, unless the client goes away before that.
fn request(wire: &mut Wire) -> Option<Request> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        wire.read_exact(&mut byte).ok()?;
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).expect("UTF-8");
    let (line, headers) = head.split_once("\r\n").expect("a line");
    let what = line.trim_end_matches(" HTTP/1.1").to_owned();
    let headers = headers.trim_end().replace("\r\n", "\n") + "\n";
    let lower = headers.to_lowercase();
    let length = lower
        .lines()
        .find_map(|it| it.strip_prefix("content-length: "));
    let mut body = vec![0; length.map_or(0, |it| it.parse().expect("a length"))];
    wire.read_exact(&mut body).ok()?;
    Some((what, headers, String::from_utf8(body).expect("UTF-8")))
}

fn serve(mut wire: Wire, noted: &Mutex<Vec<Request>>, answer: &Answer) {
    let Some(request) = request(&mut wire) else {
        return;
    };
    noted.lock().expect("requests").push(request.clone());
    answer(&request, &mut wire);
    if let Wire::Tls(stream) = &mut wire {
        stream.conn.send_close_notify();
        let _ = stream.flush();
    }
}

pub(crate) fn say(wire: &mut Wire, status: &str, body: &str) {
    let length = body.len();
    let head =
        format!("HTTP/1.1 {status}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n");
    let _ = wire.write_all(format!("{head}{body}").as_bytes());
    let _ = wire.flush();
}

/// The end of a WebSocket that answers.
pub(crate) struct Socket<'w>(WebSocket<&'w mut Wire>);

impl<'w> Socket<'w> {
    /// Accepts it.
    pub(crate) fn accept(request: &Request, wire: &'w mut Wire) -> Self {
        let mut headers = request.1.lines().filter_map(|line| line.split_once(": "));
        let key = headers.find(|(name, _)| name.eq_ignore_ascii_case("sec-websocket-key"));
        let accept = derive_accept_key(key.expect("a key").1.as_bytes());
        let head = format!(
            "HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
        );
        let _ = wire.write_all(head.as_bytes());
        let _ = wire.flush();
        Self(WebSocket::from_raw_socket(wire, Role::Server, None))
    }

    /// The next message, if one comes within this time. `Err`: the client has gone.
    pub(crate) fn next(&mut self, within: Duration) -> Result<Option<String>, ()> {
        let tcp = self.0.get_ref().tcp();
        tcp.set_read_timeout(Some(within)).map_err(drop)?;
        loop {
            match self.0.read() {
                Ok(Message::Text(text)) => return Ok(Some(text.as_str().to_owned())),
                Ok(Message::Close(_)) => return Err(()),
                Ok(_) => {}
                Err(Error::Io(error)) if error.kind() == io::ErrorKind::WouldBlock => {
                    return Ok(None);
                }
                Err(_) => return Err(()),
            }
        }
    }

    /// False if the client has gone.
    pub(crate) fn send(&mut self, text: &str) -> bool {
        self.0.send(Message::text(text)).is_ok()
    }

    /// Waits until the client has read everything that was sent. False if it has gone.
    pub(crate) fn wait_until_read(&mut self) -> bool {
        let mut pings = self.0.send(Message::Ping(Vec::new().into())).is_ok();
        let _ = self.0.get_ref().tcp().set_read_timeout(Some(PATIENCE));
        while pings {
            match self.0.read() {
                Ok(Message::Pong(_)) => return true,
                Ok(_) => {}
                Err(_) => pings = false,
            }
        }
        false
    }

    pub(crate) fn close(&mut self) {
        let _ = self.0.close(None);
        let _ = self.0.flush();
    }
}

/// `ztl serve` with components of a handler `p`.
pub(crate) struct Served {
    pub(crate) server: Server,
    scope: &'static str,
    publish: u16,
    pub(crate) scratch: Scratch,
}

impl Served {
    #[track_caller]
    pub(crate) fn file(scope: &'static str, text: &str) -> Self {
        Self::file_in(Scratch::new(), scope, text)
    }

    /// A file beside others.
    #[track_caller]
    pub(crate) fn file_in(scratch: Scratch, scope: &'static str, text: &str) -> Self {
        std::fs::write(scratch.path("token.txt"), "s3cret\n").expect("to write");
        let path = scratch.path("robot.yaml");
        std::fs::write(&path, text).expect("to write");
        let publish = reserve_port();
        let mut command = ztl();
        command.arg("serve").arg(&path).args(["-p", "0"]);
        command.args(["--publish", &publish.to_string()]);
        Self {
            server: Server::start(&mut command),
            scope,
            publish,
            scratch,
        }
    }

    #[track_caller]
    pub(crate) fn new(web: &Web, components: &str) -> Self {
        Self::file("/test", &Self::text(web, components))
    }

    /// The file of a handler with these components.
    pub(crate) fn text(web: &Web, components: &str) -> String {
        let hosts = format!("http: {{robot: '127.0.0.1:{}'}}", web.port);
        format!("{hosts}\nscopes: {{/test: {{p: {{\n{components}}}}}}}\n")
    }

    #[track_caller]
    pub(crate) fn remote(&self) -> RemoteTask {
        connect_to(&self.server.endpoint(), self.scope)
    }

    /// [`outcome`] of a task.
    #[track_caller]
    pub(crate) fn run(&self, handler: &str, component: &str, goal: &str) -> (State, String) {
        outcome(&mut self.remote(), handler, component, goal)
    }

    #[track_caller]
    pub(crate) fn trigger(
        &self,
        handler: &str,
        component: &str,
        goal: &str,
    ) -> (RemoteTask, TaskId) {
        let mut remote = self.remote();
        let id = start(&mut remote, handler, component, goal);
        (remote, id)
    }

    /// Subscribes to a stream.
    #[track_caller]
    pub(crate) fn subscribe(&self, topic: &str) -> Subscriber {
        let endpoint = format!("tcp://127.0.0.1:{}", self.publish);
        Subscriber::connect(&endpoint, topic).expect("an address")
    }
}

/// The next value of a stream.
#[track_caller]
pub(crate) fn next(values: &mut Subscriber) -> String {
    let heard = values.next_within(PATIENCE).expect("it can wait");
    let value = heard.expect("a value").value().expect("plain data");
    value.value().repr().to_string()
}
