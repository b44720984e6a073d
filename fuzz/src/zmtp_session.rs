//! One of many connections of a server or client (`ztl_zmtp::session`): any bytes, in any pieces, after any part of
//! what a good peer sends, with and without encryption.
//!
//! | byte | meaning |
//! |---|---|
//! | 1 | who is attacked: a ROUTER, DEALER or PUB (modulo 3), encrypted if the next bit is set (divided by 3) |
//! | 2 | how much of a good peer's handshake comes first: from nothing (0) to all (200 and above) |
//! | 3 | how the bytes are cut: in pieces of this length and one more |
//! | others | without encryption the stream; with it, how the frames of the good peer are changed, see [`changed`] |

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use ztl_core::Instant;
use ztl_zmtp::curve::{Keys, public_key};
use ztl_zmtp::session::{BEFORE, ENVELOPES, Inbound, Outbound, Security, Step};
use ztl_zmtp::{Dealer, Fault, Pub, Router, Socket, Sub};

/// The longest frame, and the longest message with the headers of its frames.
const MOST: usize = 600;
const TOTAL: usize = MOST + ENVELOPES;

/// From here on, the second byte means the whole handshake.
const WHOLE: u8 = 200;

/// Any input.
pub fn zmtp_session(input: &[u8]) {
    let [kind, depth, cut, rest @ ..] = input else {
        return;
    };
    let attack = Attack {
        is_encrypted: kind / 3 % 2 == 1,
        depth: (*depth).min(WHOLE).into(),
        piece: usize::from(*cut) + 1,
        rest,
    };
    match kind % 3 {
        0 => attack.run::<Router, Dealer>(),
        1 => attack.run::<Dealer, Router>(),
        _ => attack.run::<Pub, Sub>(),
    }
}

struct Attack<'a> {
    is_encrypted: bool,
    depth: usize,
    piece: usize,
    rest: &'a [u8],
}

impl Attack<'_> {
    /// Attacks an `S`, whose good peer is a `P`.
    fn run<S: Socket, P: Socket>(&self) {
        let good = self.good_peer::<S, P>();
        let (stream, frames) = good.as_ref();
        let handshake = stream.len() * self.depth / usize::from(WHOLE);
        let mut stream = stream[..handshake].to_vec();
        let mut sent = None;
        match self.is_encrypted {
            true => sent = changed(self.rest, frames, &mut stream),
            false => stream.extend(self.rest),
        }
        let whole = self.attacked::<S>(&stream, stream.len().max(1));
        // Encryption takes long: some inputs are cut.
        let pieces: &[usize] = match self.is_encrypted {
            true if !self.piece.is_multiple_of(4) => &[],
            true => &[self.piece],
            false => &[self.piece, 1],
        };
        for piece in pieces {
            let pieces = self.attacked::<S>(&stream, *piece);
            assert_eq!(pieces, whole, "it depends on how the bytes are cut");
        }
        if self.is_encrypted {
            assert_sent_by_peer(&whole.heard, frames);
            if let Some(sent) = sent.filter(|_| self.depth == usize::from(WHOLE)) {
                let messages = frames.iter().take(sent).filter(|frame| frame.is_last);
                assert_eq!((whole.heard.len(), whole.fault), (messages.count(), None));
            }
        } else if self.depth == usize::from(WHOLE) {
            assert_eq!((whole.heard, whole.fault), read(&stream[handshake..]));
        }
    }

    /// The attacked end and its peer.
    fn ends<S: Socket, P: Socket>(&self) -> (End<S>, End<P>) {
        if !self.is_encrypted {
            return (End::new(Security::Null), End::new(Security::Null));
        }
        // The same in each run.
        DRAWN.set([0; 2]);
        let server = Keys::server([1; 32], random::<0>);
        let client = Keys::client([2; 32], public_key(&[1; 32]), random::<1>);
        let (server, client) = (Security::Curve(server), Security::Curve(client));
        match S::BINDS {
            true => (End::new(server), End::new(client)),
            false => (End::new(client), End::new(server)),
        }
    }

    fn good_peer<S: Socket, P: Socket>(&self) -> Good {
        let key = (S::NAME, self.is_encrypted);
        let known = GOOD.with_borrow(|good| good.get(&key).cloned());
        known.unwrap_or_else(|| {
            let good = Rc::new(self.meet::<S, P>());
            GOOD.with_borrow_mut(|all| all.insert(key, Rc::clone(&good)));
            good
        })
    }

    fn meet<S: Socket, P: Socket>(&self) -> (Vec<u8>, Vec<Frame>) {
        let (mut end, mut peer) = self.ends::<S, P>();
        let mut stream = Vec::new();
        loop {
            let (there, back) = (peer.send(), end.send());
            if there.is_empty() && back.is_empty() {
                break;
            }
            end.take(&there);
            peer.take(&back);
            stream.extend(there);
        }
        assert!(end.inbound.is_ready() && peer.inbound.is_ready());
        let mut frames = Vec::new();
        for (number, body) in [&b"one"[..], b"", &[7; 300], &[8; 500], b"\x01a"]
            .iter()
            .enumerate()
        {
            let (envelope, mut bodies): (&[u8], Vec<&[u8]>) = match number % 3 {
                0 => (b"", vec![]),
                1 => (b"\x01\0", vec![b""]),
                _ => (b"\x01\x02id\x01\0", vec![b"id", b""]),
            };
            bodies.push(body);
            peer.out.message(envelope, body);
            let sent = peer.send();
            let mut rest = sent.as_slice();
            for (place, body) in bodies.iter().enumerate() {
                let (_, header, size) = header(rest).expect("a frame");
                let (frame, after) = rest.split_at(header + size);
                rest = after;
                frames.push(Frame {
                    bytes: frame.to_vec(),
                    body: body.to_vec(),
                    is_last: place + 1 == bodies.len(),
                });
            }
        }
        (stream, frames)
    }

    /// What a new connection makes of a stream in pieces.
    fn attacked<S: Socket>(&self, stream: &[u8], piece: usize) -> Outcome {
        let (mut end, _) = self.ends::<S, S>();
        let mut sent = Vec::new();
        for piece in stream.chunks(piece) {
            end.take(piece);
            sent.extend(end.send());
        }
        sent.extend(end.send());
        Outcome {
            heard: end.heard,
            fault: end.fault,
            sent,
        }
    }
}

/// What a good peer sends until the handshake is done, and the frames of some messages that it sends then.
type Good = Rc<(Vec<u8>, Vec<Frame>)>;

thread_local! {
    /// How often the server and the client have drawn random bytes.
    static DRAWN: Cell<[u8; 2]> = const { Cell::new([0; 2]) };
    /// By socket type and encryption, because encryption takes long.
    static GOOD: RefCell<BTreeMap<(&'static [u8], bool), Good>> = const { RefCell::new(BTreeMap::new()) };
}

/// Bytes that differ between the ends, and within a run.
fn random<const END: usize>() -> [u8; 32] {
    let mut drawn = DRAWN.get();
    drawn[END] += 1;
    DRAWN.set(drawn);
    [16 * (END as u8 + 1) + drawn[END]; 32]
}

/// A frame of the good peer as sent, and what it says.
struct Frame {
    bytes: Vec<u8>,
    body: Vec<u8>,
    is_last: bool,
}

#[derive(Debug, PartialEq)]
enum Heard {
    Message(Vec<Vec<u8>>),
    Subscription(bool, Vec<u8>),
}

#[derive(Debug, PartialEq)]
struct Outcome {
    heard: Vec<Heard>,
    fault: Option<Fault>,
    sent: Vec<u8>,
}

/// One end of a connection.
struct End<S> {
    inbound: Inbound<S>,
    out: Outbound,
    heard: Vec<Heard>,
    fault: Option<Fault>,
}

impl<S: Socket> End<S> {
    fn new(security: Security) -> Self {
        let mut out = Outbound::default();
        Self {
            inbound: Inbound::open(Instant::NEVER, security, MOST, &mut out),
            out,
            heard: Vec::new(),
            fault: None,
        }
    }

    /// Takes a piece, as a server does. After a fault the connection is closed.
    fn take(&mut self, piece: &[u8]) {
        let mut rest = piece;
        while self.fault.is_none() {
            match self.inbound.next(&mut rest, &mut self.out) {
                Ok(Step::Taken) => {
                    assert!(rest.is_empty(), "bytes are left");
                    break;
                }
                Ok(Step::Asks) => self.inbound.accept(&mut self.out),
                Ok(Step::Message(message)) => {
                    let frames: Vec<_> = message.frames().map(<[u8]>::to_vec).collect();
                    let total: usize = frames.iter().map(|frame| frame.len() + 2).sum();
                    assert!(frames.iter().all(|frame| frame.len() <= MOST) && total <= TOTAL);
                    self.heard.push(Heard::Message(frames));
                }
                Ok(Step::Subscription(begins, topic)) => {
                    assert!(topic.len() <= MOST);
                    self.heard.push(Heard::Subscription(begins, topic));
                }
                Err(fault) => self.fault = Some(fault),
            }
        }
        // A vector may have room for twice its bytes; a piece is kept as a whole.
        let most = match self.inbound.is_ready() {
            true => 2 * (2 * TOTAL + piece.len()),
            false => 2 * BEFORE,
        };
        let held = self.inbound.held();
        assert!(held <= most, "{held} bytes are held, at most {most} may be");
        // What is sent unasked answers a PING, or is part of the handshake.
        let held = self.out.held();
        assert!(
            held <= 2 * (BEFORE + 8 * piece.len()),
            "{held} bytes are to be sent"
        );
    }

    fn send(&mut self) -> Vec<u8> {
        let sent = self.out.transmit_buf().to_vec();
        self.out.consume(sent.len());
        sent
    }
}

/// Appends the good peer's frames in an order, and changed, as these steps say: two bytes each. Returns how many, if
/// they are all as they were sent.
fn changed(steps: &[u8], frames: &[Frame], stream: &mut Vec<u8>) -> Option<usize> {
    let mut next = 0;
    let mut is_same = true;
    for step in steps.chunks_exact(2).take(60) {
        let frame = |place: usize| frames[place % frames.len()].bytes.clone();
        let number = usize::from(step[1]);
        is_same &= step[0] % 8 < 4 && next < frames.len();
        let bytes = match step[0] % 8 {
            // The next one; one that is left out; any.
            0..4 => {
                next += 1;
                frame(next - 1)
            }
            4 => {
                next += 1;
                continue;
            }
            5 => frame(number),
            // A flipped bit, at the beginning or end; cut.
            6 => {
                let mut frame = frame(next);
                let place = match number % 2 {
                    0 => number / 2 % frame.len(),
                    _ => frame.len() - 1 - number / 2 % frame.len(),
                };
                frame[place] ^= 1 << (step[0] / 8 % 8);
                frame
            }
            _ => {
                let mut frame = frame(next);
                frame.truncate(number);
                frame
            }
        };
        stream.extend(bytes);
    }
    is_same.then_some(next)
}

/// Checks that each frame was sent by the good peer, in this order, and once at most.
fn assert_sent_by_peer(heard: &[Heard], frames: &[Frame]) {
    let mut rest = frames.iter();
    for heard in heard {
        let Heard::Message(bodies) = heard else {
            panic!("it sent no subscription: {heard:?}");
        };
        for (place, body) in bodies.iter().enumerate() {
            let is_last = place + 1 == bodies.len();
            let is_same = |frame: &Frame| frame.body == *body && frame.is_last == is_last;
            assert!(rest.any(is_same), "it did not send this: {heard:?}");
        }
    }
}

/// Flags, and the lengths of header and body.
fn header(bytes: &[u8]) -> Option<(u8, usize, usize)> {
    let (flags, rest) = bytes.split_first()?;
    let (header, size) = match flags & 2 {
        0 => (2, u64::from(*rest.first()?)),
        _ => (9, u64::from_be_bytes(*rest.first_chunk()?)),
    };
    Some((*flags, header, usize::try_from(size).unwrap_or(usize::MAX)))
}

/// What a stream after the handshake says, by a second, simpler reader.
fn read(stream: &[u8]) -> (Vec<Heard>, Option<Fault>) {
    let (mut heard, mut message, mut total) = (Vec::new(), Vec::new(), 0);
    let mut rest = stream;
    let fault = loop {
        match rest.first() {
            None => break None,
            Some(flags) if *flags > 6 || *flags == 5 => break Some(Fault::Flags),
            Some(_) => {}
        }
        let Some((flags, header, size)) = header(rest) else {
            break None;
        };
        if size > MOST || total + header + size > TOTAL {
            break Some(Fault::TooLong);
        }
        let Some(body) = rest.get(header..header + size) else {
            break None;
        };
        rest = &rest[header + size..];
        if flags & 4 != 0 {
            if body.starts_with(b"\x05ERROR") {
                break Some(Fault::Refused);
            }
            if let Some(topic) = body.strip_prefix(b"\x09SUBSCRIBE") {
                heard.push(Heard::Subscription(true, topic.to_vec()));
            }
            if let Some(topic) = body.strip_prefix(b"\x06CANCEL") {
                heard.push(Heard::Subscription(false, topic.to_vec()));
            }
            continue;
        }
        total += header + size;
        message.push(body.to_vec());
        if flags & 1 == 0 {
            heard.push(Heard::Message(std::mem::take(&mut message)));
            total = 0;
        }
    };
    (heard, fault)
}
