//! One ZMTP connection: bytes in, messages out, and vice versa.

use core::marker::PhantomData;
use ztl_core::Instant;
use ztl_core::sink::Sink;

use super::fault::Fault;
use super::message::{Content, Frames, Message};
use super::wire::{
    DELIMITER, GREETING, HANDSHAKE, LONG, LONGEST_PING, MORE, PARTIAL, Socket, old_greeting,
};

/// Length of the header of a frame of up to 255 bytes: flags and size.
const SHORT_HEADER: usize = 2;
/// Length of the longest frame header: flags and a size of 8 bytes.
const LONGEST_HEADER: usize = 9;

/// A tenth of a second in microseconds.
const TENTH_US: u32 = 100_000;

/// Marks a cut in a reply.
const CUT: &[u8] = "…".as_bytes();

/// State of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    Closed,
    /// This many bytes of the greeting have arrived.
    Greeting(u8),
    /// A ZMTP 2.0 peer sends its socket type next, as part of its greeting.
    OldSocket,
    /// A ZMTP 2.0 peer sends its identity next, as a frame.
    OldIdentity,
    Handshake,
    /// As `Traffic`, with a ZMTP 2.0 peer, which has no commands.
    OldTraffic,
    Traffic,
    /// Sends `ERROR`, then closes.
    Ending,
}

/// The part of a frame that comes next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Next {
    Flags,
    /// This many bytes of the size have arrived.
    Size(u8),
    Body,
}

/// The part of a message that the next frame belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Part {
    Envelope,
    Body,
    /// Dropped: the message has no delimiter and is not answered.
    Nothing,
    /// Frames after a body that is dropped.
    Rest,
}

/// Which side acts next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Turn {
    /// A message may arrive.
    Receive,
    /// A message has arrived.
    Received,
    /// The message is being processed.
    Held,
    /// A reply or request is being sent.
    Send,
}

/// Why a message is dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flaw {
    None,
    Several,
    TooLong,
}

/// What is being sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Out {
    Nothing,
    /// This part of the opening sequence.
    Hello,
    Pong,
    Message,
}

/// One end of a ZMTP connection, without I/O, as a socket of type `S` with buffer `B`.
///
/// It holds one message at a time and takes the next only after a reply. Until then, the bytes of pipelined
/// requests stay in the stream. A `PING` is still answered immediately.
///
/// *Inputs*: [`open`](Self::open), [`handle_bytes`](Self::handle_bytes),
/// [`handle_timeout`](Self::handle_timeout), [`close`](Self::close). *Outputs*, to check after each input:
/// [`message`](Self::message); [`transmit_buf`](Self::transmit_buf) and [`consume`](Self::consume);
/// [`is_open`](Self::is_open). *Commands*: [`reply`](Self::reply), [`hold`](Self::hold) for a later one,
/// [`request`](Self::request), [`discard`](Self::discard). *Next wake-up*:
/// [`poll_timeout`](Self::poll_timeout).
///
/// **The buffer** is an array or a `&mut [u8]` of at least 128 bytes. It holds one message with its envelope,
/// up to 24 bytes less than its size; the envelope takes at most half of that.
///
/// ```
/// use ztl_core::Instant;
/// use ztl_zmtp::{Connection, Content, Rep, Req};
///
/// let now = Instant::ZERO;
/// let mut server = Connection::<Rep, _>::new([0; 128]);
/// let mut client = Connection::<Req, _>::new([0; 128]);
/// server.open(now);
/// client.open(now);
///
/// // The two exchange bytes until neither has more to send.
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
// The order of fields and the inline attributes in this file together save 244 bytes in `microbit-zmtp`.
#[derive(Debug, Clone)]
#[repr(C)]
pub struct Connection<S, B> {
    pub(crate) phase: Phase,
    pub(crate) next: Next,
    /// Flags of the current incoming frame.
    pub(crate) flags: u8,
    /// Whether the current incoming frame is kept.
    pub(crate) keep: bool,
    pub(crate) part: Part,
    pub(crate) turn: Turn,
    pub(crate) flaw: Flaw,
    pub(crate) fault: Option<Fault>,
    out: Out,
    /// How many parts of the opening sequence may be sent, and how many were.
    pub(crate) hello_due: u8,
    hello_done: u8,
    /// Length of the `PONG` that waits at the end of the buffer.
    pub(crate) pong: u8,
    /// The peer's time to live, in tenths of a second.
    pub(crate) ttl: u16,
    /// Bytes of the current frame that are still missing.
    pub(crate) size: u32,
    /// Length of the message's envelope with its delimiter, and of the whole message.
    pub(crate) envelope: usize,
    pub(crate) filled: usize,
    /// Bytes of the command kept so far.
    pub(crate) command: usize,
    /// Bytes sent of the current output.
    sent: usize,
    /// Deadline of the handshake, later of the peer's time to live; see [`poll_timeout`](Self::poll_timeout).
    pub(crate) deadline: Instant,
    pub(crate) buffer: B,
    socket: PhantomData<S>,
}

impl<S: Socket, B: AsRef<[u8]> + AsMut<[u8]>> Connection<S, B> {
    /// Creates a closed connection.
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

    /// Opens the connection on a new stream and resets all state.
    pub fn open(&mut self, now: Instant) {
        self.close();
        self.fault = None;
        self.phase = Phase::Greeting(0);
        self.hello_due = 1;
        self.deadline = now + HANDSHAKE;
    }

    /// Closes the connection: the stream has ended.
    // Not inlined in firmware: with the others in this crate, that saves 268 bytes in `microbit-zmtp`.
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

    /// Handles received bytes, in pieces of any length. Returns how many were taken; pass the others again
    /// after the next output, because a message must be answered first.
    pub fn handle_bytes(&mut self, now: Instant, bytes: &[u8]) -> usize {
        let mut rest = bytes;
        while !rest.is_empty() {
            let taken = self.take(rest);
            if taken == 0 {
                break;
            }
            rest = rest.get(taken..).unwrap_or_default();
        }
        // Bytes that are not taken yet also show that the peer is alive.
        if !bytes.is_empty() && self.is_ready() {
            // In two steps: a 64-bit multiplication is a library call.
            let ttl = u64::from(u32::from(self.ttl) * (TENTH_US / 4)) * 4;
            self.deadline = now.after(ttl);
        }
        bytes.len() - rest.len()
    }

    /// Closes the connection if the peer has been silent for too long.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.poll_timeout() <= now {
            self.fail(Fault::Silent);
        }
    }

    /// When to call [`handle_timeout`](Self::handle_timeout); [`Instant::NEVER`] if there is nothing to do.
    pub const fn poll_timeout(&self) -> Instant {
        match self.phase {
            Phase::Closed => Instant::NEVER,
            Phase::Traffic | Phase::OldTraffic if self.ttl == 0 => Instant::NEVER,
            _ => self.deadline,
        }
    }

    /// The message that has arrived and is not held, answered or discarded yet.
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

    /// The part of the buffer that is free while a message is held.
    pub fn spare(&mut self) -> &mut [u8] {
        let (room, envelope) = (self.room(), self.envelope);
        let spare = match self.turn {
            Turn::Held => self.buffer.as_mut().get_mut(envelope..room),
            _ => None,
        };
        spare.unwrap_or_default()
    }

    /// Length of the longest reply to the message that is not cut.
    pub fn answer_room(&self) -> usize {
        self.room().saturating_sub(self.envelope + LONGEST_HEADER)
    }

    /// Replies to the message, in its envelope. A reply that does not fit the buffer is cut and ends in `…`.
    /// Does nothing without a message.
    pub fn reply(&mut self, put: &mut dyn FnMut(&mut dyn Sink)) {
        if matches!(self.turn, Turn::Received | Turn::Held) {
            self.send(put);
        }
    }

    /// Sends a message in an envelope of these frames, cut like a reply. Returns `false` if the handshake is
    /// not done, another message is in progress, or the envelope does not fit.
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

    /// Drops the received message, so that the next one can arrive.
    pub fn discard(&mut self) {
        if matches!(self.turn, Turn::Received | Turn::Held) {
            self.forget();
        }
    }

    /// The next bytes to send; may be empty. Call [`consume`](Self::consume) after sending.
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

    /// Marks the first `count` bytes of [`transmit_buf`](Self::transmit_buf) as sent.
    // Not inlined in firmware: with the others in this crate, that saves 268 bytes in `microbit-zmtp`.
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

    /// Whether the stream is still needed. If not, close it; [`fault`](Self::fault) tells the reason.
    pub fn is_open(&self) -> bool {
        self.phase != Phase::Closed
    }

    /// Whether the handshake is complete.
    pub fn is_ready(&self) -> bool {
        matches!(self.phase, Phase::Traffic | Phase::OldTraffic)
    }

    /// Why this end closed the connection, until it is opened again.
    pub const fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// This part of the opening sequence.
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

    /// Closes the connection because of `fault`.
    // Not inlined in firmware: with the others in this crate, that saves 268 bytes in `microbit-zmtp`.
    #[cfg_attr(target_os = "none", inline(never))]
    pub(crate) fn fail(&mut self, fault: Fault) {
        self.close();
        self.fault = Some(fault);
    }

    /// Closes the connection because of `fault`, once this many parts of the opening sequence are sent.
    pub(crate) fn end(&mut self, fault: Fault, parts: u8) {
        if self.hello_done >= parts {
            return self.fail(fault);
        }
        self.phase = Phase::Ending;
        self.fault = Some(fault);
        self.hello_due = parts;
    }

    /// Clears the state for the next message.
    pub(crate) fn forget(&mut self) {
        self.turn = Turn::Receive;
        self.part = Part::Envelope;
        self.flaw = Flaw::None;
        self.envelope = 0;
        self.filled = 0;
    }

    /// How much of the buffer messages may use; the rest is for a `PING`.
    pub(crate) fn room(&self) -> usize {
        self.buffer.as_ref().len().saturating_sub(LONGEST_PING)
    }

    /// Stores the header of an envelope frame; returns whether it and the frame fit.
    pub(crate) fn keep_header(&mut self, size: u32) -> bool {
        // Computed first: with a small buffer, the compiler then sees that all lengths are short.
        let most = self.room() / 2;
        if size as usize > most {
            return false;
        }
        let [a, b, c, d] = size.to_be_bytes();
        let (short, long) = ([MORE, d], [MORE | LONG, 0, 0, 0, 0, a, b, c, d]);
        let header = if size < 256 { short.as_slice() } else { &long };
        self.filled + header.len() + size as usize <= most && self.keep_bytes(header)
    }

    /// Stores bytes of the message; returns whether they fit.
    #[cfg_attr(target_os = "none", inline(always))]
    pub(crate) fn keep_bytes(&mut self, bytes: &[u8]) -> bool {
        let room = self.room();
        let rest = self.buffer.as_mut().get_mut(self.filled..room);
        let Some(to) = rest.and_then(|rest| rest.get_mut(..bytes.len())) else {
            return false;
        };
        // The compiler cannot always remove the panic branch of `copy_from_slice`.
        for (to, from) in to.iter_mut().zip(bytes) {
            *to = *from;
        }
        self.filled += bytes.len();
        true
    }

    /// Writes a message after the envelope.
    fn send(&mut self, put: &mut dyn FnMut(&mut dyn Sink)) {
        let (room, envelope) = (self.answer_room(), self.envelope);
        let begin = envelope + SHORT_HEADER;
        let all = self.buffer.as_mut();
        let mut sink = CutSink::new(all.get_mut(begin..begin + room).unwrap_or_default());
        put(&mut sink);
        // Never longer; for a small buffer, `min` tells the compiler so.
        let size = sink.finish().min(room);
        let [a, b, c, d] = (size as u32).to_be_bytes();
        let (short, long) = ([0, d], [LONG, 0, 0, 0, 0, a, b, c, d]);
        let mut header = short.as_slice();
        if size > 255 {
            header = &long;
            // Backwards, because source and destination overlap.
            for index in (begin..begin + size).rev() {
                let byte = all.get(index).copied().unwrap_or_default();
                if let Some(to) = all.get_mut(index + LONGEST_HEADER - SHORT_HEADER) {
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

/// A sink that cuts what does not fit and marks the cut.
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

    /// Completes the output and returns its length.
    fn finish(&mut self) -> usize {
        if !self.cut {
            return self.len;
        }
        self.len = self.len.min(self.buffer.len().saturating_sub(CUT.len()));
        // Do not cut within a character.
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
