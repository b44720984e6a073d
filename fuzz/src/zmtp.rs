//! ZMTP from the first byte of a greeting: any stream into a server, a serial line, and both sides of a
//! connection. In every case the server's output is valid ZMTP, all input is taken in time, and a good client
//! is served afterwards.

use std::time::Duration;

use embedded_io::{ErrorType, Read, ReadReady, Write};
use ztl_mcu::link::{Busy, Offer};
use ztl_mcu::zmtp::{Connection, Dealer, Line, Peer, Rep, Req, Server, Socket};
use ztl_mcu::{Component, Identity, Instant, Refused, Report, Run};

/// With this boot id the first task has id 1, as in `docs/zmtp.md`.
const BOOT: u32 = 0x3A2C_BD44;

/// Longest time a reply is held.
const HELD: Duration = Duration::from_secs(2);

/// Accepts any goal and takes one second.
#[derive(Default)]
struct Motor {
    ends: Instant,
    aborted: bool,
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new("motor")
            .with_words("any")
            .with_busy(Busy::Queue(1))
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if goal.is_empty() {
            why.text("motor takes a goal");
            return Err(Refused);
        }
        Ok(())
    }

    fn start(&mut self, now: Instant, _goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.ends = now + Duration::from_secs(1);
        self.aborted = false;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        report.text("on its way");
        if self.aborted {
            return Run::Aborted;
        }
        if now < self.ends {
            return Run::Running;
        }
        Run::Completed
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {}
}

type Device = Server<'static, [Motor; 1], 2, 3, 256, 2>;

fn device() -> Device {
    Server::new("/lab", Identity::new("desk", "1", BOOT), [Motor::default()])
}

/// Any stream.
pub fn zmtp(stream: &[u8]) {
    let (whole, lives) = serve(stream, stream.len().max(1));
    let (single, lives_too) = serve(stream, 1);
    assert_eq!(
        lives, lives_too,
        "the output depends on how the bytes are split"
    );
    for (whole, single) in whole.iter().zip(single) {
        // Output not sent yet is dropped with the connection.
        assert!(
            single.starts_with(whole),
            "the output depends on how the bytes are split"
        );
        assert!(
            !lives || *whole == single,
            "the output depends on how the bytes are split"
        );
    }
    line(stream);
    connection::<Rep>(stream);
    connection::<Req>(stream);
    connection::<Dealer>(stream);
}

/// A server's first client sends the stream in pieces. Returns all output, and whether the client is still
/// connected.
fn serve(stream: &[u8], piece: usize) -> ([Vec<u8>; 2], bool) {
    let mut device = device();
    let mut now = Instant::ZERO;
    device.open(now, Peer(0));
    let mut heard = drain(&mut device, Peer(0));
    for piece in stream.chunks(piece) {
        let mut rest = piece;
        while !rest.is_empty() {
            let taken = device.handle_bytes(now, Peer(0), rest);
            let said = drain(&mut device, Peer(0));
            if taken == 0 && said.is_empty() {
                // Only a held reply may block input, and it is sent in time.
                now = now + HELD;
                device.handle_timeout(now);
                let held = drain(&mut device, Peer(0));
                assert!(!held.is_empty() || !device.is_open(Peer(0)), "it hangs");
                heard.extend(held);
            }
            heard.extend(said);
            rest = &rest[taken..];
        }
    }
    device.handle_timeout(now + HELD);
    heard.extend(drain(&mut device, Peer(0)));
    let heard = parts(&heard);
    let lives = device.is_open(Peer(0));

    // A good client is served next to it and in its slot.
    assert_serves(&mut device, Peer(1), now + HELD);
    assert_serves(&mut device, Peer(0), now + HELD);
    (heard, lives)
}

fn drain(device: &mut Device, peer: Peer) -> Vec<u8> {
    let mut heard = Vec::new();
    loop {
        let pending = device.transmit_buf(peer);
        let count = pending.len().min(50);
        heard.extend(&pending[..count]);
        if count == 0 {
            return heard;
        }
        device.consume(peer, count);
    }
}

/// Checks with a second, simpler parser that a server's output is a greeting and frames. Returns messages and
/// commands separately, because commands may overtake.
fn parts(heard: &[u8]) -> [Vec<u8>; 2] {
    let (mut messages, mut commands) = (Vec::new(), Vec::new());
    const BEGIN: &[u8] = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03";
    let mut rest = heard.strip_prefix(BEGIN).expect("a partial greeting");
    rest = match rest {
        [] => return [messages, commands],
        // ZMTP 2.0: REP, and no identity.
        [4, 0, 0, rest @ ..] => rest,
        [1, b'N', b'U', b'L', b'L', ..] => &rest[53..],
        other => panic!("no greeting: {other:?}"),
    };
    let mut more = false;
    while let [flags, rest_of_it @ ..] = rest {
        assert!(*flags < 5, "flags {flags}");
        let (size, body) = match flags & 2 {
            0 => (usize::from(rest_of_it[0]), &rest_of_it[1..]),
            _ => {
                let (size, body) = rest_of_it.split_first_chunk::<8>().expect("a size");
                (u64::from_be_bytes(*size) as usize, body)
            }
        };
        assert_eq!(
            flags & 2 != 0,
            size > 255,
            "a size in as few bytes as it needs"
        );
        assert!(size <= body.len(), "a frame is cut");
        if *flags == 4 {
            assert!(!more, "a command within a message");
        } else {
            if flags & 1 == 0 {
                let text = std::str::from_utf8(&body[..size]).expect("a text");
                assert!(text.splitn(4, ';').count() == 4, "no answer: {text}");
            }
            more = flags & 1 != 0;
        }
        let frame = rest.len() - body.len() + size;
        let kind = if *flags == 4 {
            &mut commands
        } else {
            &mut messages
        };
        kind.extend(&rest[..frame]);
        rest = &rest[frame..];
    }
    assert!(!more, "a message is cut");
    [messages, commands]
}

/// What a good client sends before its first request.
fn greeting() -> Vec<u8> {
    let mut bytes = b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03\x01NULL".to_vec();
    bytes.resize(64, 0);
    bytes.extend(b"\x04\x19\x05READY\x0BSocket-Type\0\0\0\x03REQ");
    bytes
}

const QUESTION: &[u8] = b"\x01\0\0\x13/lab;2;4294967295;x";
const ANSWER: &[u8] = b"\x01\0\0\x29/lab;2;4294967295;Invalid ID '4294967295'";

fn assert_serves(device: &mut Device, peer: Peer, now: Instant) {
    device.open(now, peer);
    device.handle_bytes(now, peer, &greeting());
    let hello = drain(device, peer);
    assert!(hello.ends_with(b"REP"), "{hello:?}");
    device.handle_bytes(now, peer, QUESTION);
    assert_eq!(drain(device, peer), ANSWER);
}

struct Port<'s> {
    received: &'s [u8],
    sent: Vec<u8>,
}

impl ErrorType for Port<'_> {
    type Error = std::convert::Infallible;
}

impl Read for Port<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Self::Error> {
        // In small pieces, as a serial port delivers them.
        let count = buffer.len().min(self.received.len()).min(7);
        buffer[..count].copy_from_slice(&self.received[..count]);
        self.received = &self.received[count..];
        Ok(count)
    }
}

impl ReadReady for Port<'_> {
    fn read_ready(&mut self) -> Result<bool, Self::Error> {
        Ok(!self.received.is_empty())
    }
}

impl Write for Port<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Self::Error> {
        self.sent.extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }
}

/// A serial port receives the stream, and then a good client, with nothing between them.
fn line(stream: &[u8]) {
    let mut device = device();
    let mut line = Line::new();
    let mut now = Instant::ZERO;
    let good = [&greeting(), QUESTION].concat();
    let mut bring = |bytes: &[u8]| {
        let mut sent = Vec::new();
        let mut port = Port {
            received: bytes,
            sent: Vec::new(),
        };
        // Long enough for any number of held replies.
        for _ in 0..bytes.len() + 20 {
            let mut out = Port {
                received: &[],
                sent: Vec::new(),
            };
            line.turn(&mut device, &mut port, &mut out, now)
                .expect("the port never fails");
            sent.extend(out.sent);
            now = now + HELD;
        }
        sent
    };
    let before = bring(stream);
    assert!(before.is_empty() || before.starts_with(b"\xFF"));
    // It receives nothing that belongs to the stream before.
    let mut hello = greeting();
    hello.truncate(64);
    hello.splice(8..9, [1]);
    let all = [&hello, Rep::READY, ANSWER].concat();
    assert_eq!(bring(&good), all);
}

/// Either side of a connection reads the whole stream, even if its messages are ignored.
fn connection<S: Socket>(stream: &[u8]) {
    let mut connection = Connection::<S, _>::new([0xA5; 128]);
    connection.open(Instant::ZERO);
    let mut rest = stream;
    let mut turn = 0;
    while !rest.is_empty() {
        let taken = connection.handle_bytes(Instant::ZERO, rest);
        rest = &rest[taken..];
        let mut moved = taken > 0;
        if let Some(message) = connection.message() {
            assert!(message.envelope.map(<[u8]>::len).sum::<usize>() < 128);
            moved = true;
            match turn % 3 {
                0 => connection.discard(),
                1 => connection.hold(),
                _ => {}
            }
            connection.reply(&mut |sink| sink.put(b"an answer"));
        }
        turn += 1;
        while let Some(count) = Some(connection.transmit_buf().len()).filter(|count| *count > 0) {
            connection.consume(count.min(9));
            moved = true;
        }
        assert!(moved, "it hangs");
    }
    if connection.is_ready() && connection.request(&[b"me"], &mut |sink| sink.put(b"what?")) {
        assert_eq!(connection.transmit_buf(), b"\x01\x02me\x01\0\0\x05what?");
    }
    connection.handle_timeout(Instant::NEVER);
}
