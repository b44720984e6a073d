//! One connection: bytes in, messages out, and the other way round.

use core::marker::PhantomData;
use ztl_core::Instant;
use ztl_core::sink::Sink;

use super::HANDSHAKE;
use super::message::{Content, Frames, Message};
use super::wire::{DELIMITER, GREETING, LONG, LONGEST_PING, MORE, PARTIAL, Socket, old_greeting};

/// The header of a frame of up to 255 bytes: flags, and the size.
const SHORT_HEADER: usize = 2;
/// The longest header of a frame: flags, and a size of 8 bytes.
const LONGEST_HEADER: usize = 9;

/// A tenth of a second, in microseconds.
const TENTH_US: u32 = 100_000;

/// Marks where an answer was cut.
const CUT: &[u8] = "…".as_bytes();

/// Why a connection was closed by this end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Fault {
    /// What came first is no signature: no ZMTP at all, or ZMTP 1.0.
    // From 1, so that no fault is 0, and a new connection all zeros, which take no flash.
    NotZmtp = 1,
    /// The peer's mechanism is not NULL: it wants a password or keys.
    Mechanism,
    /// The peer is a kind of socket that this kind does not talk to.
    SocketType,
    /// A frame with flags that do not exist or do not go together.
    Flags,
    /// Something other than `READY` in the handshake.
    Unexpected,
    /// A frame of more than [`SKIPPED`](super::SKIPPED) bytes, or an envelope that cannot be kept.
    TooLong,
    /// The peer has sent `ERROR`.
    Refused,
    /// The handshake took longer than [`HANDSHAKE`], or the peer's own time to live has passed.
    Silent,
}

impl Fault {
    /// What was wrong, as a text.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::NotZmtp => "the peer does not speak ZMTP 2.0 or newer",
            Self::Mechanism => "the peer's mechanism is not NULL",
            Self::SocketType => "the peer is of another kind of socket",
            Self::Flags => "a frame has flags that do not exist",
            Self::Unexpected => "something other than READY in the handshake",
            Self::TooLong => "a frame is too long",
            Self::Refused => "the peer sent ERROR",
            Self::Silent => "the peer was silent for too long",
        }
    }
}

impl core::fmt::Display for Fault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

impl core::error::Error for Fault {}

/// How far a connection is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Phase {
    Closed,
    /// So many bytes of the greeting have come.
    Greeting(u8),
    /// Of a peer of ZMTP 2.0 the kind of socket comes next, which it tells in its greeting.
    OldSocket,
    /// Of a peer of ZMTP 2.0 the identity comes next, which is a frame.
    OldIdentity,
    Handshake,
    /// So with ZMTP 2.0, which has no commands.
    OldTraffic,
    Traffic,
    /// `ERROR` goes out, then it is closed.
    Ending,
}

/// What of a frame comes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Next {
    Flags,
    /// So many bytes of the size.
    Size(u8),
    Body,
}

/// Of which part of a message the frame is that comes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Part {
    Envelope,
    Body,
    /// Whatever it is, the message is not answered: it has no delimiter.
    Nothing,
    /// After a body that is dropped.
    Rest,
}

/// Whose turn it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Turn {
    /// A message comes, or may come.
    Receive,
    /// One has come.
    Received,
    /// And is being dealt with.
    Held,
    /// A message goes out.
    Send,
}

/// What is dropped of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Flaw {
    None,
    Several,
    TooLong,
}

/// What is on its way out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Out {
    Nothing,
    /// This part of what opens a connection.
    Hello,
    Pong,
    Message,
}

/// One end of a ZMTP connection, without I/O, as a socket of the kind `S`; `B` is its buffer.
///
/// It holds one message at a time, which is answered before the next is taken; of pipelined requests
/// the bytes are left to the stream until then. A `PING` is answered at once also meanwhile.
///
/// *Inputs*: [`open`](Self::open), [`handle_bytes`](Self::handle_bytes),
/// [`handle_timeout`](Self::handle_timeout), [`close`](Self::close). *Outputs*:
/// [`message`](Self::message); [`transmit_buf`](Self::transmit_buf) and [`consume`](Self::consume), to be asked
/// after each input; [`is_open`](Self::is_open). *Commands*: [`reply`](Self::reply), [`hold`](Self::hold) for a later one,
/// [`request`](Self::request), [`discard`](Self::discard). *Next wake-up*: [`poll_timeout`](Self::poll_timeout).
///
/// **The buffer** holds a message with its envelope, 24 bytes less than it has; the envelope at most half of
/// that. An array or a `&mut [u8]`, of 128 bytes or more.
///
/// ```
/// use ztl_mcu::Instant;
/// use ztl_mcu::zmtp::{Connection, Content, Rep, Req};
///
/// let now = Instant::ZERO;
/// let mut server = Connection::<Rep, _>::new([0; 128]);
/// let mut client = Connection::<Req, _>::new([0; 128]);
/// server.open(now);
/// client.open(now);
///
/// // The two talk until neither has anything to say.
/// fn talk(now: Instant, server: &mut Connection<Rep, [u8; 128]>, client: &mut Connection<Req, [u8; 128]>) {
///     loop {
///         let to_server = server.handle_bytes(now, client.transmit_buf());
///         client.consume(to_server);
///         let to_client = client.handle_bytes(now, server.transmit_buf());
///         server.consume(to_client);
///         if to_server + to_client == 0 {
///             break;
///         }
///     }
/// }
/// talk(now, &mut server, &mut client);
/// assert!(client.is_ready());
///
/// client.request(&[], &mut |sink| sink.put(b"what time is it?"));
/// talk(now, &mut server, &mut client);
/// assert_eq!(server.message().unwrap().content, Content::One(b"what time is it?"));
/// server.reply(&mut |sink| sink.put(b"late"));
/// talk(now, &mut server, &mut client);
/// assert_eq!(client.message().unwrap().content, Content::One(b"late"));
/// client.discard();
/// ```
// In this order: a Cortex-M0 reaches what comes first with shorter code.
#[derive(Debug, Clone)]
#[repr(C)]
pub struct Connection<S, B> {
    pub(super) phase: Phase,
    pub(super) next: Next,
    /// Of the frame that comes.
    pub(super) flags: u8,
    /// Whether the frame that comes is kept.
    pub(super) keep: bool,
    pub(super) part: Part,
    pub(super) turn: Turn,
    pub(super) flaw: Flaw,
    pub(super) fault: Option<Fault>,
    out: Out,
    /// How many parts of what opens a connection may go out, and how many have.
    pub(super) hello_due: u8,
    hello_done: u8,
    /// Bytes of the `PONG` that waits at the end of the buffer.
    pub(super) pong: u8,
    /// A peer's time to live, in tenths of a second.
    pub(super) ttl: u16,
    /// Bytes of the frame that are still to come.
    pub(super) size: u32,
    /// Of the message: bytes of its envelope with the delimiter, and of all.
    pub(super) envelope: usize,
    pub(super) filled: usize,
    /// Bytes of the command that are kept.
    pub(super) command: usize,
    /// Of what is on its way out.
    sent: usize,
    /// Of the handshake, then of the peer's time to live: see [`poll_timeout`](Self::poll_timeout).
    pub(super) deadline: Instant,
    pub(super) buffer: B,
    socket: PhantomData<S>,
}

impl<S: Socket, B: AsRef<[u8]> + AsMut<[u8]>> Connection<S, B> {
    /// A connection that is not open yet.
    pub const fn new(buffer: B) -> Self {
        Self {
            phase: Phase::Closed,
            next: Next::Flags,
            flags: 0,
            keep: false,
            part: Part::Envelope,
            turn: Turn::Receive,
            flaw: Flaw::None,
            fault: None,
            out: Out::Nothing,
            hello_due: 0,
            hello_done: 0,
            pong: 0,
            ttl: 0,
            size: 0,
            envelope: 0,
            filled: 0,
            command: 0,
            sent: 0,
            deadline: Instant::ZERO,
            buffer,
            socket: PhantomData,
        }
    }

    /// The stream is there: everything begins anew.
    pub fn open(&mut self, now: Instant) {
        self.close();
        self.fault = None;
        self.phase = Phase::Greeting(0);
        self.hello_due = 1;
        self.deadline = now + HANDSHAKE;
    }

    /// The stream is gone.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn close(&mut self) {
        self.phase = Phase::Closed;
        self.next = Next::Flags;
        self.out = Out::Nothing;
        self.sent = 0;
        (self.hello_due, self.hello_done) = (0, 0);
        self.pong = 0;
        self.ttl = 0;
        self.forget();
    }

    /// Bytes have arrived, in pieces of any length; says how many were taken. The others are to be
    /// given again after the next output: a message has to be answered first.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) -> usize {
        let mut rest = bytes;
        while !rest.is_empty() {
            let taken = self.take(rest);
            if taken == 0 {
                break;
            }
            rest = rest.get(taken..).unwrap_or_default();
        }
        // Those that wait are a sign of life too.
        if !bytes.is_empty() && self.is_ready() {
            // In two steps, since a multiplication of 64 bits is a library call.
            let ttl = u64::from(u32::from(self.ttl) * (TENTH_US / 4)) * 4;
            self.deadline = now.after(ttl);
        }
        bytes.len() - rest.len()
    }

    /// Closes the connection when the peer has been silent for too long.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.poll_timeout() <= now {
            self.fail(Fault::Silent);
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do; [`Instant::NEVER`] if nothing.
    pub const fn poll_timeout(&self) -> Instant {
        match self.phase {
            Phase::Closed => Instant::NEVER,
            Phase::Traffic | Phase::OldTraffic if self.ttl == 0 => Instant::NEVER,
            _ => self.deadline,
        }
    }

    /// The message that has come and is not held, answered or discarded yet.
    #[must_use]
    pub fn message(&self) -> Option<Message<'_>> {
        if self.turn != Turn::Received {
            return None;
        }
        let (envelope, body) = self
            .buffer
            .as_ref()
            .get(..self.filled)?
            .split_at_checked(self.envelope)?;
        Some(Message {
            envelope: Frames { bytes: envelope },
            content: match self.flaw {
                Flaw::None => Content::One(body),
                Flaw::Several => Content::Several,
                Flaw::TooLong => Content::TooLong,
            },
        })
    }

    /// Keeps the message's envelope for a later [`reply`](Self::reply).
    pub fn hold(&mut self) {
        if self.turn == Turn::Received {
            self.turn = Turn::Held;
        }
    }

    /// What of the buffer is not needed while a message is held.
    pub(super) fn spare(&mut self) -> &mut [u8] {
        let (room, envelope) = (self.room(), self.envelope);
        let spare = match self.turn {
            Turn::Held => self.buffer.as_mut().get_mut(envelope..room),
            _ => None,
        };
        spare.unwrap_or_default()
    }

    /// How long an answer to the message may be that is not cut.
    pub(super) fn answer_room(&self) -> usize {
        self.room().saturating_sub(self.envelope + LONGEST_HEADER)
    }

    /// Answers the message, in its envelope. What does not fit into the buffer is cut, and `…` marks the
    /// cut. Without a message nothing happens.
    pub fn reply(&mut self, put: &mut dyn FnMut(&mut dyn Sink)) {
        if matches!(self.turn, Turn::Received | Turn::Held) {
            self.send(put);
        }
    }

    /// Sends a message of one's own, in an envelope of these frames; cut as a reply is. Says whether
    /// it is on its way: the handshake is done, no message is under way, and the envelope fits.
    pub fn request(&mut self, envelope: &[&[u8]], put: &mut dyn FnMut(&mut dyn Sink)) -> bool {
        let idle = self.turn == Turn::Receive && self.filled == 0 && self.next == Next::Flags;
        if !idle || !self.is_ready() {
            return false;
        }
        let fits = envelope.iter().all(|frame| {
            let size = frame.len() as u32;
            !frame.is_empty() && self.keep_header(size) && self.keep_bytes(frame)
        });
        if !fits || !self.keep_bytes(&DELIMITER) {
            self.forget();
            return false;
        }
        self.envelope = self.filled;
        self.send(put);
        true
    }

    /// Drops the message that has come, so that the next may.
    pub fn discard(&mut self) {
        if matches!(self.turn, Turn::Received | Turn::Held) {
            self.forget();
        }
    }

    /// The next bytes to be sent; empty when there is nothing. To be followed by
    /// [`consume`](Self::consume).
    pub fn transmit_buf(&mut self) -> &[u8] {
        if self.out == Out::Nothing {
            self.out = match self.turn {
                _ if self.hello_done < self.hello_due => Out::Hello,
                _ if self.pong > 0 => Out::Pong,
                Turn::Send => Out::Message,
                _ => Out::Nothing,
            };
        }
        let buffer = self.buffer.as_ref();
        let all = match self.out {
            Out::Nothing => None,
            Out::Hello => Some(self.hello()),
            Out::Pong => {
                let begin = buffer.len().saturating_sub(LONGEST_PING);
                buffer.get(begin..begin + usize::from(self.pong))
            }
            Out::Message => buffer.get(..self.filled),
        };
        all.and_then(|all| all.get(self.sent..)).unwrap_or_default()
    }

    /// The first `count` bytes of [`transmit_buf`](Self::transmit_buf) are sent.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn consume(&mut self, count: usize) {
        if count < self.transmit_buf().len() {
            self.sent += count;
            return;
        }
        match self.out {
            Out::Nothing => return,
            Out::Hello => {
                self.hello_done += 1;
                if self.hello_done == self.hello_due && self.phase == Phase::Ending {
                    self.close();
                }
            }
            Out::Pong => self.pong = 0,
            Out::Message => self.forget(),
        }
        self.out = Out::Nothing;
        self.sent = 0;
    }

    /// Whether the stream is still needed. When it no longer is, it is to be closed, and
    /// [`fault`](Self::fault) says why.
    pub fn is_open(&self) -> bool {
        self.phase != Phase::Closed
    }

    /// Whether the handshake is done.
    pub fn is_ready(&self) -> bool {
        matches!(self.phase, Phase::Traffic | Phase::OldTraffic)
    }

    /// Why this end has closed the connection, until it is opened again.
    pub const fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// This part of what opens a connection.
    fn hello(&self) -> &'static [u8] {
        let (partial, rest) = GREETING.split_at(PARTIAL);
        let old = matches!(
            self.phase,
            Phase::OldSocket | Phase::OldIdentity | Phase::OldTraffic
        );
        match self.hello_done {
            0 => partial,
            1 if old => const { &old_greeting(S::CODE) },
            1 => rest,
            2 if S::BINDS && self.phase == Phase::Ending => S::ERROR,
            2 => S::READY,
            _ => S::ERROR,
        }
    }

    /// Gives the connection up.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(super) fn fail(&mut self, fault: Fault) {
        self.close();
        self.fault = Some(fault);
    }

    /// Gives the connection up when so many parts of what opens it have been sent.
    pub(super) fn end(&mut self, fault: Fault, parts: u8) {
        if self.hello_done >= parts {
            return self.fail(fault);
        }
        self.phase = Phase::Ending;
        self.fault = Some(fault);
        self.hello_due = parts;
    }

    /// Makes room for the next message.
    pub(super) fn forget(&mut self) {
        self.turn = Turn::Receive;
        self.part = Part::Envelope;
        self.flaw = Flaw::None;
        self.envelope = 0;
        self.filled = 0;
    }

    /// How much of the buffer messages may take: behind it there is room for a `PING`.
    pub(super) fn room(&self) -> usize {
        self.buffer.as_ref().len().saturating_sub(LONGEST_PING)
    }

    /// Adds the header of an envelope's frame to what is kept; says whether it and the frame fit.
    pub(super) fn keep_header(&mut self, size: u32) -> bool {
        // First, so that with a small buffer the compiler sees that none is long.
        let most = self.room() / 2;
        if size as usize > most {
            return false;
        }
        let [a, b, c, d] = size.to_be_bytes();
        let (short, long) = ([MORE, d], [MORE | LONG, 0, 0, 0, 0, a, b, c, d]);
        let header = if size < 256 { short.as_slice() } else { &long };
        self.filled + header.len() + size as usize <= most && self.keep_bytes(header)
    }

    /// Adds to what is kept; says whether it fits.
    #[cfg_attr(target_os = "none", inline(always))]
    pub(super) fn keep_bytes(&mut self, bytes: &[u8]) -> bool {
        let room = self.room();
        let rest = self.buffer.as_mut().get_mut(self.filled..room);
        let Some(to) = rest.and_then(|rest| rest.get_mut(..bytes.len())) else {
            return false;
        };
        // Not `copy_from_slice`, of which the compiler does not see everywhere that it never panics.
        for (to, from) in to.iter_mut().zip(bytes) {
            *to = *from;
        }
        self.filled += bytes.len();
        true
    }

    /// Writes a message behind the envelope.
    fn send(&mut self, put: &mut dyn FnMut(&mut dyn Sink)) {
        let (room, envelope) = (self.answer_room(), self.envelope);
        let begin = envelope + SHORT_HEADER;
        let all = self.buffer.as_mut();
        let mut sink = CutSink::new(all.get_mut(begin..begin + room).unwrap_or_default());
        put(&mut sink);
        // It is no longer; with a small buffer the compiler sees that it is short.
        let size = sink.finish().min(room);
        let [a, b, c, d] = (size as u32).to_be_bytes();
        let (short, long) = ([0, d], [LONG, 0, 0, 0, 0, a, b, c, d]);
        let mut header = short.as_slice();
        if size > 255 {
            header = &long;
            // From the end, since the two overlap.
            for place in (begin..begin + size).rev() {
                let byte = all.get(place).copied().unwrap_or_default();
                if let Some(to) = all.get_mut(place + LONGEST_HEADER - SHORT_HEADER) {
                    *to = byte;
                }
            }
        }
        if let Some(to) = all.get_mut(envelope..) {
            for (to, from) in to.iter_mut().zip(header) {
                *to = *from;
            }
        }
        self.filled = envelope + header.len() + size;
        self.turn = Turn::Send;
    }
}

/// A sink that keeps the beginning of what does not fit, and marks the cut.
struct CutSink<'a> {
    buffer: &'a mut [u8],
    len: usize,
    cut: bool,
}

impl<'a> CutSink<'a> {
    fn new(buffer: &'a mut [u8]) -> Self {
        Self {
            buffer,
            len: 0,
            cut: false,
        }
    }

    /// How many bytes there are.
    fn finish(&mut self) -> usize {
        if !self.cut {
            return self.len;
        }
        self.len = self.len.min(self.buffer.len().saturating_sub(CUT.len()));
        // Not within a character.
        let within = |byte: Option<&u8>| byte.is_some_and(|byte| byte & 0xC0 == 0x80);
        while self.len > 0 && within(self.buffer.get(self.len)) {
            self.len -= 1;
        }
        self.cut = false;
        self.put(CUT);
        self.len
    }
}

impl Sink for CutSink<'_> {
    fn put(&mut self, bytes: &[u8]) {
        if self.cut {
            return;
        }
        let room = self.buffer.get_mut(self.len..).unwrap_or_default();
        self.cut = room.len() < bytes.len();
        for (to, from) in room.iter_mut().zip(bytes) {
            *to = *from;
            self.len += 1;
        }
    }
}
