//! Plays the traces of the document, as sockets of libzmq and as bytes over TCP.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use ztl_core::envelope::{ClientId, Envelope};
use ztl_tests::lab::{PATIENCE, Server, until};

use super::document::{Block, blocks};
use super::parallel::{side_by_side, socket};
use super::robot::{Happening, TraceServer};

/// The document's placeholders for numbers that the server chooses.
const GIVEN: [&str; 4] = ["10471", "10472", "81501", "81502"];

/// Who answers.
enum Host {
    Ours(TraceServer),
    Original(Server),
}

impl Host {
    fn endpoint(&self) -> String {
        match self {
            Self::Ours(server) => server.server.endpoint().to_owned(),
            Self::Original(server) => server.endpoint(),
        }
    }
}

/// A client without envelopes, one with them, and an observer.
struct Clients {
    plain: zmq::Socket,
    enveloped: zmq::Socket,
    onlooker: zmq::Socket,
}

impl Clients {
    fn of(host: &Host) -> Self {
        let context = zmq::Context::new();
        let open = |kind| {
            let socket = socket(&context, kind);
            socket.connect(&host.endpoint()).expect("an address");
            socket
        };
        Self {
            plain: open(zmq::REQ),
            enveloped: open(zmq::DEALER),
            onlooker: open(zmq::REQ),
        }
    }
}

struct Player {
    host: Host,
    clients: Clients,
    /// The server's values for some of [`GIVEN`].
    given: BTreeMap<&'static str, String>,
    /// The scope of the last request, and when it was sent.
    scope: String,
    asked: Instant,
    /// The next answer does not come sooner than so long after it.
    held: Duration,
}

impl Player {
    fn new(host: Host) -> Self {
        Self {
            clients: Clients::of(&host),
            host,
            given: BTreeMap::new(),
            scope: String::new(),
            asked: Instant::now(),
            held: Duration::ZERO,
        }
    }

    #[track_caller]
    fn play(&mut self, line: &str) {
        if let Some(happening) = line.strip_prefix("* ") {
            return self.happen(happening);
        }
        let (way, body) = line.split_once(' ').unwrap_or((line, ""));
        match way.strip_suffix('>') {
            Some(number) => self.send(envelope(number), body),
            None => {
                let number = way.strip_suffix('<').expect("one of `>`, `<`, `*`");
                self.receive(envelope(number), body);
            }
        }
    }

    #[track_caller]
    fn send(&mut self, envelope: Option<Envelope>, body: &str) {
        self.scope = body.split(';').next().unwrap_or_default().to_owned();
        self.asked = Instant::now();
        let body = self.known(body);
        let sent = match envelope {
            None => self.clients.plain.send(body.as_bytes(), 0),
            Some(envelope) => {
                let (client, number) = envelope.frames();
                let frames: [&[u8]; 4] = [&client, &number, b"", body.as_bytes()];
                self.clients.enveloped.send_multipart(frames, 0)
            }
        };
        sent.expect("to send");
    }

    #[track_caller]
    fn receive(&mut self, envelope: Option<Envelope>, expected: &str) {
        let (socket, frames) = match envelope {
            None => (&self.clients.plain, Vec::new()),
            Some(envelope) => {
                let (client, number) = envelope.frames();
                let frames = vec![client.to_vec(), number.to_vec(), Vec::new()];
                (&self.clients.enveloped, frames)
            }
        };
        let mut answer = socket.recv_multipart(0).expect("an answer");
        let body = answer.pop().unwrap_or_default();
        assert_eq!(answer, frames, "in another envelope");
        let body = String::from_utf8(body).expect("UTF-8");
        self.compare(expected, &body);
        assert!(self.asked.elapsed() >= self.held, "too early: {body}");
        self.held = Duration::ZERO;
    }

    /// The reply matches the expected text; a number of [`GIVEN`] stands for any value of the server.
    #[track_caller]
    fn compare(&mut self, expected: &str, answer: &str) {
        let unknown = |player: &Self| {
            let unknown = GIVEN
                .iter()
                .filter(|name| !player.given.contains_key(*name));
            let places = unknown.filter_map(|name| Some((expected.find(*name)?, *name)));
            places.min()
        };
        while let Some((place, name)) = unknown(self) {
            // Before that place, every number is known.
            let place = self.known(&expected[..place]).len();
            let rest = answer.get(place..).unwrap_or_default();
            let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
            let number = rest[..digits].to_owned();
            assert!(!number.is_empty(), "{expected}\nis expected, not\n{answer}");
            let fresh = self.given.values().all(|known| *known != number);
            assert!(fresh, "given a second time, as {name}: {answer}");
            self.given.insert(name, number);
        }
        assert_eq!(answer, self.known(expected));
    }

    /// With the numbers that the server gave.
    fn known(&self, text: &str) -> String {
        let fill = |text: String, (name, number): (&&str, &String)| text.replace(name, number);
        self.given.iter().fold(text.to_owned(), fill)
    }

    #[track_caller]
    fn happen(&mut self, what: &str) {
        let (what, text) = what.split_once(": ").unwrap_or((what, ""));
        let said = || text.to_owned();
        let happening = match what {
            "the server restarts" => return self.restart(),
            "accepted" => Happening::Accepted,
            "rejected" => Happening::Rejected(said()),
            "progress" => Happening::Progress(said()),
            "completed" => Happening::Completed(said()),
            "failed" => Happening::Failed(said()),
            "stopped" => Happening::Stopped(said()),
            _ => {
                let millis = what.strip_suffix(" ms pass").and_then(|ms| ms.parse().ok());
                self.held = Duration::from_millis(millis.expect("something that happens"));
                return;
            }
        };
        if let Host::Ours(server) = &self.host {
            server.let_happen(&happening);
        }
        // Waits until the server has the event; for a task without a known id, the next reply shows it.
        let ids = GIVEN.iter().take(2).rev();
        let id = ids.filter_map(|name| self.given.get(name)).next();
        if let Some(id) = id.filter(|_| !text.is_empty()) {
            let status = format!("{};2;{id};", self.scope);
            until(what, PATIENCE, || {
                self.clients.onlooker.send(&status, 0).expect("to send");
                let answer = self.clients.onlooker.recv_bytes(0).expect("an answer");
                let answer = String::from_utf8(answer).expect("UTF-8");
                (answer.splitn(4, ';').nth(3) == Some(text)).then_some(())
            });
        }
    }

    fn restart(&mut self) {
        self.host = Host::Ours(TraceServer::new());
        self.clients = Clients::of(&self.host);
    }
}

/// The envelope that the document writes as `7`, or with the wish as `7!`.
fn envelope(number: &str) -> Option<Envelope> {
    let digits = number.trim_end_matches('!');
    (!digits.is_empty()).then(|| Envelope {
        client: ClientId(*b"0123456789abcdef"),
        number: digits.parse().expect("a number"),
        early_end: digits != number,
    })
}

/// Plays a block; a panic's message then includes its position.
fn play(block: &Block, host: Host) {
    let mut player = Player::new(host);
    for (number, line) in &block.lines {
        println!("docs/protocol.md:{number}: {line}");
        player.play(line);
    }
}

/// How often a trace with events is played at most: where the machine stalls, the server answers before the event.
const TRIES: usize = 3;

/// Whether something happens in it, perhaps while the server holds an answer for a second or two.
fn has_events(block: &Block) -> bool {
    block.lines.iter().any(|(_, line)| line.starts_with("* "))
}

#[test]
fn servers_match_every_documented_trace() {
    let blocks = blocks("trace");
    assert!(blocks.len() >= 9, "only {} traces", blocks.len());
    let (eventful, others): (Vec<_>, Vec<_>) = blocks.into_iter().partition(has_events);
    let run = |block: Block| {
        let run = move || play(&block, Host::Ours(TraceServer::new()));
        Box::new(run) as Box<dyn FnOnce() + Send>
    };
    side_by_side(others.into_iter().map(run).collect());
    for block in &eventful {
        let plays = || {
            std::thread::scope(|threads| {
                let player = threads.spawn(|| play(block, Host::Ours(TraceServer::new())));
                player.join().is_ok()
            })
        };
        let line = block.lines[0].0;
        assert!((0..TRIES).any(|_| plays()), "docs/protocol.md:{line}");
    }
}

#[test]
fn the_original_does_not_notice_the_extensions() {
    let blocks = blocks("trace original");
    assert!(!blocks.is_empty());
    for block in blocks {
        play(&block, Host::Original(Server::original()));
    }
}

#[test]
fn the_documented_bytes_match_the_wire() {
    let blocks = blocks("bytes");
    assert!(!blocks.is_empty());
    for block in blocks {
        let server = TraceServer::new();
        let address = server.server.endpoint().replace("tcp://", "");
        let mut stream = TcpStream::connect(address).expect("a connection");
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        for (number, line) in block.lines {
            let (way, hex) = line.split_at(1);
            let bytes = hex.split_whitespace();
            let bytes: Vec<u8> = bytes
                .map(|byte| u8::from_str_radix(byte, 16).expect("hexadecimal"))
                .collect();
            if way == ">" {
                stream.write_all(&bytes).unwrap();
            } else {
                let mut answer = vec![0xA5; bytes.len()];
                stream.read_exact(&mut answer).expect("an answer");
                assert_eq!(answer, bytes, "docs/protocol.md:{number}");
            }
        }
    }
}
