//! Shared by the tests of connections and servers: frames as a peer writes them, and a test device.

use std::string::{String, ToString};
use std::vec::Vec;

use ztl_core::link::{Busy, Offer};

use super::{Connection, Peer, Server, Socket};
use crate::{Component, Identity, Instant, Refused, Report, Run};

mod connection;
mod document;
mod line;
mod server;

pub(super) const NOW: Instant = Instant::ZERO;

/// The whole greeting of a ZMTP 3.0 peer with the mechanism NULL.
pub(super) fn greeting() -> Vec<u8> {
    let mut bytes = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03\0NULL".to_vec();
    bytes.resize(64, 0);
    bytes
}

/// A frame with these flags. Its size is short where possible, unless the flags include LONG.
pub(super) fn frame(flags: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    if flags & 2 == 0 && body.len() < 256 {
        bytes.extend([flags, body.len() as u8]);
    } else {
        bytes.push(flags | 2);
        bytes.extend((body.len() as u64).to_be_bytes());
    }
    bytes.extend(body);
    bytes
}

/// A command, as a peer sends it.
pub(super) fn command(name: &str, data: &[u8]) -> Vec<u8> {
    let body = [&[name.len() as u8], name.as_bytes(), data].concat();
    frame(4, &body)
}

pub(super) fn property(name: &str, value: &[u8]) -> Vec<u8> {
    let size = (value.len() as u32).to_be_bytes();
    [&[name.len() as u8], name.as_bytes(), &size, value].concat()
}

pub(super) fn ready(socket: &str) -> Vec<u8> {
    command("READY", &property("Socket-Type", socket.as_bytes()))
}

/// A request as REQ sends it.
pub(super) fn request(body: &[u8]) -> Vec<u8> {
    [frame(1, b""), frame(0, body)].concat()
}

/// How bytes are delivered.
#[derive(Debug, Clone, Copy)]
pub(super) enum Pieces {
    Whole,
    Single,
}

pub(super) const BOTH: [Pieces; 2] = [Pieces::Whole, Pieces::Single];

/// An end of a connection that can be fed and drained.
pub(super) trait End {
    fn feed(&mut self, bytes: &[u8]) -> usize;
    fn drain(&mut self) -> Vec<u8>;

    /// Feeds the bytes as far as they are taken; returns what is sent.
    fn talk(&mut self, pieces: Pieces, bytes: &[u8]) -> Vec<u8> {
        let mut heard = self.drain();
        let mut rest = bytes;
        while !rest.is_empty() {
            let piece = match pieces {
                Pieces::Whole => rest,
                Pieces::Single => &rest[..1],
            };
            let taken = self.feed(piece);
            let said = self.drain();
            if taken == 0 && said.is_empty() {
                break;
            }
            heard.extend(said);
            rest = &rest[taken..];
        }
        heard
    }
}

impl<S: Socket, B: AsRef<[u8]> + AsMut<[u8]>> End for Connection<S, B> {
    fn feed(&mut self, bytes: &[u8]) -> usize {
        self.handle_bytes(NOW, bytes)
    }

    fn drain(&mut self) -> Vec<u8> {
        let mut heard = Vec::new();
        loop {
            let pending = self.transmit_buf();
            let sent = pending.len().min(7);
            heard.extend(&pending[..sent]);
            if sent == 0 {
                return heard;
            }
            self.consume(sent);
        }
    }
}

/// A motor that needs three polls to reach its goal.
#[derive(Debug, Default)]
pub(super) struct Motor {
    steps: u8,
    aborted: bool,
    /// Does not stop on an abort.
    pub(super) stubborn: bool,
    /// Lets one more task wait.
    pub(super) patient: bool,
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        let busy = match self.patient {
            true => Busy::Queue(1),
            false => Busy::Refuse,
        };
        Offer::new("motor").with_words("up down").with_busy(busy)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal == "sideways" {
            why.text("motor takes up or down");
            return Err(Refused);
        }
        Ok(())
    }

    fn start(&mut self, _now: Instant, _goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        self.steps = 0;
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        if self.aborted && !self.stubborn {
            report.text("stopped half way");
            return Run::Aborted;
        }
        self.steps += 1;
        report.text(&self.steps.to_string());
        report.text(" of 3");
        if self.steps < 3 {
            Run::Running
        } else {
            Run::Completed
        }
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.aborted = true;
    }

    /// A step in each turn.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now
    }
}

/// With this boot id the first task has id 1.
pub(super) const BOOT: u32 = 0x3A2C_BD44;

pub(super) type TestServer = Server<'static, [Motor; 1], 2, 2, 256, 2>;

pub(super) fn server() -> TestServer {
    Server::new("/lab", Identity::new("desk", "1", BOOT), [Motor::default()])
}

/// A client of a server, as a test sees it.
pub(super) struct Client<'d> {
    pub(super) server: &'d mut TestServer,
    pub(super) peer: Peer,
}

impl End for Client<'_> {
    fn feed(&mut self, bytes: &[u8]) -> usize {
        self.server.handle_bytes(NOW, self.peer, bytes)
    }

    fn drain(&mut self) -> Vec<u8> {
        let mut heard = Vec::new();
        loop {
            let pending = self.server.transmit_buf(self.peer);
            let sent = pending.len().min(7);
            heard.extend(&pending[..sent]);
            if sent == 0 {
                return heard;
            }
            self.server.consume(self.peer, sent);
        }
    }
}

/// Connects a REQ in this slot.
pub(super) fn connect(server: &mut TestServer, peer: u8) -> Client<'_> {
    server.open(NOW, Peer(peer));
    let mut client = Client {
        server,
        peer: Peer(peer),
    };
    client.talk(Pieces::Whole, &[greeting(), ready("REQ")].concat());
    client
}

impl Client<'_> {
    /// The reply's text; empty while it is held.
    pub(super) fn ask(&mut self, body: &str) -> String {
        let heard = self.talk(Pieces::Whole, &request(body.as_bytes()));
        text(&heard)
    }
}

/// The text of a reply to REQ.
#[track_caller]
pub(super) fn text(heard: &[u8]) -> String {
    if heard.is_empty() {
        return String::new();
    }
    let body = heard.strip_prefix(b"\x01\0").expect("a delimiter");
    let body = match body {
        [0, size, body @ ..] => {
            assert_eq!(body.len(), usize::from(*size));
            body
        }
        [2, 0, 0, 0, 0, 0, 0, high, low, body @ ..] => {
            assert_eq!(body.len(), usize::from(*high) << 8 | usize::from(*low));
            body
        }
        other => panic!("not a frame: {other:?}"),
    };
    String::from_utf8(body.to_vec()).expect("UTF-8")
}

/// The body of an INIT.
pub(super) fn init(task: &str) -> String {
    let mut encoded = std::vec![0; task.len() * 2];
    let spec = ztl_core::TaskSpec::split(task).expect("two colons");
    std::format!(
        "/lab;1;-1;{}",
        spec.encode_into(&mut encoded).expect("room")
    )
}
