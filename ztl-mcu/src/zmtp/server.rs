//! A device that is a ZTL server by itself: clients, tasks, components.

use ztl_core::base64::{self, DecodeError};
use ztl_core::dispatcher::{Action, Config, Dispatcher};
use ztl_core::memory::{Fixed, Memory};
use ztl_core::reply::Reply;
use ztl_core::sink::Sink;
use ztl_core::spec::{SpecError, TaskSpec};
use ztl_core::tasks::TaskRules;
use ztl_core::{Event, Instant, State, TaskId};

use crate::component::Components;
use crate::node::utf8::push_utf8;
use crate::node::{Identity, TaskRunner};
use ztl_zmtp::{Connection, Content, Fault, Rep};

/// Longest stored text of a task, in bytes.
const TEXT: usize = crate::node::tasks::TEXT;

/// How much longer scope, state and id can be in a reply than in its request, if the id is a task's, plus the
/// `…` that marks a cut.
const HEADER_GROWS: usize = ";2;4294967295;…".len();

type Words<const N: usize> = heapless::String<N>;

/// A client of a server, numbered from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Peer(pub u8);

/// A ZTL server over ZMTP, without I/O. Up to `PEERS` clients at a time, each with a buffer of `BUFFER`
/// bytes, send tasks to the components `C`; the table holds `TASKS` tasks. `PEERS` must be 1 to 255, `BUFFER`
/// at least 128, and `CLIENTS` at least `PEERS`; the compiler checks this.
///
/// Its scope is the one given to [`new`](Self::new), its handler the identity's name: `gripper:finger:80`
/// moves the component `finger` of the device `gripper`. Tasks continue when their client leaves.
///
/// To deduplicate the INITs of our own clients, it stores the last reply of up to `CLIENTS` of them. Each is
/// kept for at most a minute, and can be evicted once the client has asked about the task. Without room an
/// INIT is rejected. Other clients need no such record.
///
/// *Inputs*: [`open`](Self::open) and [`close`](Self::close) as connections come and go,
/// [`handle_bytes`](Self::handle_bytes), and [`handle_timeout`](Self::handle_timeout) in every turn of the
/// main loop. *Outputs*, for each client after each input: [`transmit_buf`](Self::transmit_buf) and
/// [`consume`](Self::consume); [`is_open`](Self::is_open), and if not, close the stream. *Next wake-up*:
/// [`poll_timeout`](Self::poll_timeout).
///
/// **Work.** `handle_bytes` copies the bytes. At the end of a request it searches the tasks and calls `check`
/// and `start`, or `abort`, once. `handle_timeout` calls `poll` once for each running task.
///
/// ```
/// # use ztl_mcu::{Component, Identity, Refused, Report, Run, Instant};
/// # use ztl_mcu::link::Offer;
/// # struct Lamp;
/// # impl Component for Lamp {
/// #     fn offer(&self) -> Offer<'_> {
/// #         Offer::new("lamp").with_words("on off")
/// #     }
/// #     fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> { Ok(()) }
/// #     fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> { Ok(()) }
/// #     fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run { report.text("on"); Run::Completed }
/// #     fn abort(&mut self, _: Instant) {}
/// #     fn make_safe(&mut self, _: Instant) {}
/// # }
/// use ztl_mcu::zmtp::{Peer, Server};
///
/// // Two clients, four tasks, requests and replies of up to about 200 bytes.
/// let identity = Identity::new("desk", "1.0.0", 4711);
/// let mut server = Server::<_, 2, 4, 256, 4>::new("/lab", identity, [Lamp]);
///
/// // A TCP connection is accepted: feed bytes, advance time, send bytes.
/// let now = Instant::ZERO;
/// server.open(now, Peer(0));
/// let taken = server.handle_bytes(now, Peer(0), b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03");
/// server.handle_timeout(now);
/// assert_eq!(taken, 11);
/// assert_eq!(server.transmit_buf(Peer(0)), b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03");
/// ```
#[derive(Debug)]
pub struct Server<
    'a,
    C,
    const PEERS: usize,
    const TASKS: usize,
    const BUFFER: usize,
    const CLIENTS: usize,
> {
    name: &'a str,
    dispatcher: Dispatcher<Fixed<Peer, 1, TASKS, TEXT, CLIENTS>>,
    tasks: TaskRunner<C, TASKS>,
    peers: [Connection<Rep, [u8; BUFFER]>; PEERS],
    /// A copy of the current request, so that every client can be answered meanwhile; then the text of its
    /// reply.
    request: Words<BUFFER>,
}

impl<
    'a,
    C: Components,
    const PEERS: usize,
    const TASKS: usize,
    const BUFFER: usize,
    const CLIENTS: usize,
> Server<'a, C, PEERS, TASKS, BUFFER, CLIENTS>
{
    /// Creates a server. There may be at most 255 `components`. The identity's link timeout has no effect.
    /// The scope's name must consist of printable characters.
    pub const fn new(scope: &'static str, identity: Identity<'a>, components: C) -> Self {
        const {
            assert!(BUFFER >= 128, "BUFFER must be at least 128");
            assert!(PEERS >= 1 && PEERS <= 255, "PEERS must be 1 to 255");
            assert!(CLIENTS >= PEERS, "CLIENTS must be at least PEERS");
        };
        Self {
            name: identity.name,
            dispatcher: Dispatcher::new(
                Fixed::new([scope]),
                Config::new(first_id(identity.boot), identity.boot),
            ),
            tasks: TaskRunner::new(components),
            peers: [const { Connection::new([0; BUFFER]) }; PEERS],
            request: Words::new(),
        }
    }

    /// A free slot for another client; first close the stream that had it before. If there is none, close the
    /// client's stream immediately: a ZeroMQ client treats this as a temporary failure (RFC 37, Error
    /// Handling).
    pub fn vacant(&self) -> Option<Peer> {
        let index = self.peers.iter().position(|peer| !peer.is_open())?;
        u8::try_from(index).ok().map(Peer)
    }

    /// A client has connected in this slot; its former client is dropped.
    pub fn open(&mut self, now: Instant, peer: Peer) {
        self.close(peer);
        if let Some(connection) = self.peers.get_mut(usize::from(peer.0)) {
            connection.open(now);
        }
    }

    /// A client's stream has ended.
    pub fn close(&mut self, peer: Peer) {
        if let Some(connection) = self.peers.get_mut(usize::from(peer.0)) {
            connection.close();
        }
        self.forget_waiting(peer);
    }

    /// Handles bytes received from a client, in pieces of any length. Returns how many were taken; pass the
    /// others again after a reply has been sent.
    pub fn handle_bytes(&mut self, now: Instant, peer: Peer, bytes: &[u8]) -> usize {
        let Some(connection) = self.peers.get_mut(usize::from(peer.0)) else {
            return bytes.len();
        };
        let taken = connection.handle_bytes(now, bytes);
        if !connection.is_open() {
            self.forget_waiting(peer);
        } else if connection.message().is_some() {
            self.on_request(now, peer);
        }
        taken
    }

    /// Advances the components, sends held replies that are due, and closes connections stuck in the
    /// handshake.
    pub fn handle_timeout(&mut self, now: Instant) {
        for index in 0..PEERS {
            if let Some(connection) = self.peers.get_mut(index)
                && connection.poll_timeout() <= now
            {
                connection.handle_timeout(now);
                self.forget_waiting(Peer(index as u8));
            }
        }
        self.tasks.handle_timeout(now);
        self.report_changes(now);
        self.dispatcher
            .handle_timeout(now, &mut answer(&mut self.peers));
    }

    /// The next bytes for a client; may be empty. Call [`consume`](Self::consume) after sending.
    pub fn transmit_buf(&mut self, peer: Peer) -> &[u8] {
        let connection = self.peers.get_mut(usize::from(peer.0));
        connection.map_or(&[], |connection| connection.transmit_buf())
    }

    /// Marks the first `count` bytes of [`transmit_buf`](Self::transmit_buf) as sent.
    pub fn consume(&mut self, peer: Peer, count: usize) {
        if let Some(connection) = self.peers.get_mut(usize::from(peer.0)) {
            connection.consume(count);
        }
    }

    /// Whether a client's stream is still needed; if not, close it.
    pub fn is_open(&self, peer: Peer) -> bool {
        let connection = self.peers.get(usize::from(peer.0));
        connection.is_some_and(Connection::is_open)
    }

    /// Why this end closed a client's connection, if it did.
    pub fn fault(&self, peer: Peer) -> Option<Fault> {
        self.peers.get(usize::from(peer.0))?.fault()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called even if no byte arrives;
    /// [`Instant::NEVER`] if there is nothing to do.
    pub fn poll_timeout(&self, _now: Instant) -> Instant {
        let peers = self.peers.iter().map(Connection::poll_timeout);
        let wake = peers.fold(self.tasks.next_move(), Ord::min);
        let answers = self.dispatcher.poll_timeout();
        answers.map_or(wake, |at| wake.min(at))
    }

    /// Emergency stop; see [`Node::stop_everything`](crate::Node::stop_everything).
    pub fn stop_everything(&mut self, now: Instant) {
        self.tasks.stop_everything(now);
        self.report_changes(now);
    }

    /// Ends the emergency stop.
    pub const fn clear_stop(&mut self) {
        self.tasks.clear_stop();
    }

    /// Whether an emergency stop is in effect.
    #[must_use]
    pub const fn is_stopped(&self) -> bool {
        self.tasks.is_stopped()
    }

    /// The components.
    #[must_use]
    pub const fn components(&self) -> &C {
        self.tasks.components()
    }

    /// The components, mutable, so that firmware can configure them.
    pub const fn components_mut(&mut self) -> &mut C {
        self.tasks.components_mut()
    }

    /// Drops the held replies to a client that has left.
    fn forget_waiting(&mut self, peer: Peer) {
        let memory = self.dispatcher.memory_mut();
        while memory.release(|waiter| waiter.peer == peer).is_some() {}
    }

    /// Handles a complete request of a client.
    fn on_request(&mut self, now: Instant, peer: Peer) {
        let Some(connection) = self.peers.get_mut(usize::from(peer.0)) else {
            return;
        };
        let Some(message) = connection.message() else {
            return;
        };
        let envelope = message.envelope();
        // The reply repeats these fields, and must stay readable after it is cut.
        let room = connection.answer_room();
        let fits = |body| header_len(body) + HEADER_GROWS <= room;
        self.request.clear();
        let body = match message.content {
            Content::One(body) if fits(body) => {
                let whole = push_utf8(&mut self.request, body).is_some();
                (self.request.as_str(), whole)
            }
            Content::Several => ("", true),
            Content::One(_) | Content::TooLong => {
                return connection
                    .reply(&mut |sink| sink.put(b";2;-1;the request is too long for this device"));
            }
        };
        connection.hold();
        let action = {
            let out = &mut answer(&mut self.peers);
            self.dispatcher.handle_text(now, peer, envelope, body, out)
        };
        match action {
            Some(Action::Start { id, payload, .. }) => {
                // Its reply is held, so its buffer has room.
                let connection = self.peers.get_mut(usize::from(peer.0));
                let room = connection.map_or(&mut [][..], Connection::spare);
                let spec = base64::decode(payload.as_bytes(), room);
                let said = &mut self.request;
                let (told, step, text) = start(now, self.name, &mut self.tasks, id, spec, said);
                let out = &mut answer(&mut self.peers);
                self.dispatcher
                    .handle_step(now, id, told, Some(step), text, out);
            }
            Some(Action::Abort { id, .. }) => self.tasks.abort_local(now, id),
            None => return,
        }
        self.report_changes(now);
    }

    /// Reports changes of tasks to the dispatcher.
    fn report_changes(&mut self, now: Instant) {
        let out = &mut answer(&mut self.peers);
        let dispatcher = &mut self.dispatcher;
        self.tasks.report_changes(|id, state, text| {
            let event = match state {
                State::Completed => Event::Complete,
                State::Aborted => Event::Abort,
                State::Failed | State::Rejected => Event::Fail,
                State::Initiated | State::Accepted => {
                    // Unknown progress stays `None`, as in the original.
                    if !text.is_empty() {
                        dispatcher.memory_mut().tasks_mut().progress(id, text);
                    }
                    return;
                }
            };
            dispatcher.handle_step(now, id, State::Accepted, Some(event), text, out);
        });
    }
}

/// Delivers the dispatcher's replies to the clients.
fn answer<const PEERS: usize, const BUFFER: usize>(
    peers: &mut [Connection<Rep, [u8; BUFFER]>; PEERS],
) -> impl FnMut(Peer, &Reply<'_>) {
    |peer, reply| {
        if let Some(connection) = peers.get_mut(usize::from(peer.0)) {
            connection.reply(&mut |sink| reply.put(sink));
        }
    }
}

/// Starts a task, or writes the reason into `said`. No mark of a cut is needed there: a reply has less room
/// and is marked when it is cut.
// Not inlined in firmware, so that its stack is free when the reply is written: with `remember` of the dispatcher, that saves 264
// bytes of stack in `microbit-zmtp`.
#[cfg_attr(target_os = "none", inline(never))]
fn start<'t, C: Components, const TASKS: usize, const BUFFER: usize>(
    now: Instant,
    name: &str,
    tasks: &mut TaskRunner<C, TASKS>,
    id: TaskId,
    spec: Result<&[u8], DecodeError>,
    said: &'t mut Words<BUFFER>,
) -> (State, Event, &'t str) {
    let mut text = Words::<BUFFER>::new();
    let spec = match spec {
        Ok(bytes) if push_utf8(&mut text, bytes).is_some() => TaskSpec::split(&text),
        Ok(_) => Err(SpecError::NotUtf8 { at: text.len() }),
        Err(error) => Err(SpecError::Base64(error)),
    };
    let spec = match spec {
        Ok(spec) => spec,
        // Uses the original's texts where it has them (`docs/protocol.md` [5.3]).
        Err(error) => {
            let message = match error {
                SpecError::NoComponent => "'component'",
                SpecError::NoGoal => "'goal'",
                SpecError::NotUtf8 { .. } => "the task is not UTF-8",
                _ => "Incorrect padding",
            };
            return (State::Failed, Event::Reject, message);
        }
    };
    said.clear();
    let accepted = {
        let sink: &mut dyn Sink = &mut |bytes: &[u8]| {
            let _ = push_utf8(said, bytes);
        };
        try_start(now, name, tasks, id, &spec, sink)
    };
    let text = said.as_str();
    if accepted {
        (State::Accepted, Event::Accept, text)
    } else {
        (State::Rejected, Event::Reject, text)
    }
}

/// Starts a task; returns whether it did.
fn try_start<C: Components, const TASKS: usize>(
    now: Instant,
    name: &str,
    tasks: &mut TaskRunner<C, TASKS>,
    id: TaskId,
    spec: &TaskSpec<'_>,
    sink: &mut dyn Sink,
) -> bool {
    if spec.handler != name {
        put_all(sink, &["no device '", spec.handler, "'; this is ", name]);
        return false;
    }
    let named = |index: &usize| {
        let component = tasks.components().component(*index);
        component.is_some_and(|component| component.offer().name == spec.component)
    };
    let Some(index) = (0..tasks.components().count()).find(named) else {
        put_all(sink, &["no component '", spec.component, "'; it has: "]);
        for index in 0..tasks.components().count() {
            if let Some(component) = tasks.components().component(index) {
                let comma = if index > 0 { ", " } else { "" };
                put_all(sink, &[comma, component.offer().name]);
            }
        }
        return false;
    };
    let started = tasks.start_local(now, id, index as u8, spec.goal);
    match started {
        Ok(()) => spec.put_initiated_small(id, sink),
        Err(reason) => sink.put(reason.as_bytes()),
    }
    started.is_ok()
}

/// Length of a request's scope, state and id with their separators.
fn header_len(body: &[u8]) -> usize {
    let mut marks = body.iter().enumerate().filter(|(_, byte)| **byte == b';');
    marks.nth(2).map_or(body.len(), |(at, _)| at + 1)
}

fn put_all(sink: &mut dyn Sink, parts: &[&str]) {
    for part in parts {
        sink.put(part.as_bytes());
    }
}

/// The first id of a boot: far from those of earlier boots, even if boots are merely counted (Fibonacci
/// hashing).
const fn first_id(boot: u32) -> TaskId {
    match TaskId::new(boot.wrapping_mul(0x9E37_79B1) >> 2 | 1) {
        Some(id) => id,
        // Unreachable: the value is odd.
        None => TaskId::MAX,
    }
}
