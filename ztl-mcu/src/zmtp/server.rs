//! A device that is a ZTL server by itself: clients, tasks, components.

use ztl_core::base64::{self, DecodeError};
use ztl_core::dispatcher::{Action, Config, Dispatcher};
use ztl_core::memory::{Fixed, Memory};
use ztl_core::reply::Reply;
use ztl_core::sink::Sink;
use ztl_core::spec::{SpecError, TaskSpec};
use ztl_core::tasks::TaskRules;
use ztl_core::{Event, Instant, State, TaskId};

use super::connection::{Connection, Fault};
use super::message::Content;
use super::wire::Rep;
use crate::component::Components;
use crate::node::text::push_bytes;
use crate::node::{Identity, Runner};

/// Longest text that is remembered of a task, in bytes.
const TEXT: usize = crate::node::tasks::TEXT;

/// By how much scope, state and id can be longer in an answer than in its request: it has all of them, and the id
/// can be a task's; and `…` stands behind them where it is cut.
const HEADER_GROWS: usize = ";2;4294967295;…".len();

type Words<const N: usize> = heapless::String<N>;

/// Which of a server's clients, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Peer(pub u8);

/// A ZTL server over ZMTP, without I/O: up to `PEERS` clients at a time, each with a buffer of `BUFFER`
/// bytes, give tasks to the components `C`; `TASKS` are remembered. It compiles with `PEERS` from 1 to 255, `BUFFER`
/// from 128, and `CLIENTS` from `PEERS`.
///
/// Its scope is that of [`new`](Self::new), its handler the identity's name: `gripper:finger:80` moves the
/// component `finger` of the device `gripper`. Tasks go on when their client leaves.
///
/// Of our own clients, which never send an INIT twice, the last answer is kept: until the client has
/// asked about the task and another needs the place, and for a minute at most. There is room for
/// `CLIENTS` of them; without it an INIT is refused. Others need no such place.
///
/// *Inputs*: [`open`](Self::open) and [`close`](Self::close) as connections come and go,
/// [`handle_bytes`](Self::handle_bytes), [`handle_timeout`](Self::handle_timeout) in every turn of the main loop.
/// *Outputs*, after each input and for each client: [`transmit_buf`](Self::transmit_buf) and
/// [`consume`](Self::consume); [`is_open`](Self::is_open), else its stream is to be closed. *Next wake-up*:
/// [`poll_timeout`](Self::poll_timeout).
///
/// **Work.** `handle_bytes` copies the bytes, and at the end of a request goes through the tasks, and calls
/// `check` and `start`, or `abort`, once. `handle_timeout` calls `poll` once for each task that moves.
///
/// ```
/// # use ztl_mcu::{Component, Identity, Refused, Report, Run, Instant};
/// # use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
/// # struct Lamp;
/// # impl Component for Lamp {
/// #     fn offer(&self) -> Offer<'_> {
/// #         let goal = GoalShape { range: None, unit: "", words: "on off" };
/// #         Offer { name: "lamp", goal, busy: Busy::Refuse, loss: Loss::Abort, topics: "" }
/// #     }
/// #     fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> { Ok(()) }
/// #     fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> { Ok(()) }
/// #     fn poll(&mut self, _: Instant, report: &mut Report<'_>) -> Run { report.text("on"); Run::Completed }
/// #     fn abort(&mut self, _: Instant) {}
/// #     fn make_safe(&mut self, _: Instant) {}
/// # }
/// use ztl_mcu::zmtp::{Peer, Server};
///
/// // Two clients, four tasks, requests and answers of up to some 200 bytes.
/// let identity = Identity::new("desk", "1.0.0", 4711);
/// let mut server = Server::<_, 2, 4, 256, 4>::new("/lab", identity, [Lamp]);
///
/// // A TCP connection has come: bytes in, time passes, bytes out.
/// let now = Instant::ZERO;
/// server.open(now, Peer(0));
/// let taken = server.handle_bytes(now, Peer(0), b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03");
/// server.handle_timeout(now);
/// assert_eq!(taken, 11);
/// assert_eq!(server.transmit_buf(Peer(0)), b"\xFF\0\0\0\0\0\0\0\x01\x7F\x03");
/// ```
#[derive(Debug)]
#[repr(C)]
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
    tasks: Runner<C, TASKS>,
    peers: [Connection<Rep, [u8; BUFFER]>; PEERS],
    /// A copy of the request that is dealt with, so that every client can be answered meanwhile; then what is said
    /// of it.
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
    /// A server after its reset. `components` are at most 255; the link timeout of the identity does
    /// not matter. The scope's name is of letters and signs that can be printed.
    pub const fn new(scope: &'static str, identity: Identity<'a>, components: C) -> Self {
        const {
            assert!(BUFFER >= 128, "a buffer has at least 128 bytes");
            assert!(PEERS >= 1 && PEERS <= 255, "there are 1 to 255 peers");
            assert!(
                CLIENTS >= PEERS,
                "there are at least as many clients as peers"
            );
        };
        Self {
            name: identity.name,
            dispatcher: Dispatcher::new(
                Fixed::new([scope]),
                Config::new(first_id(identity.boot), identity.boot),
            ),
            tasks: Runner::new(components),
            peers: [const { Connection::new([0; BUFFER]) }; PEERS],
            request: Words::new(),
        }
    }

    /// A place for another client, if one is free; the stream that had it before is to be closed first.
    /// Without one the client's stream is to be closed at once, which a ZeroMQ client takes for a passing
    /// trouble (RFC 37, Error Handling).
    pub fn vacant(&self) -> Option<Peer> {
        let place = self.peers.iter().position(|peer| !peer.is_open())?;
        u8::try_from(place).ok().map(Peer)
    }

    /// A client has connected, in this place; whoever was there is forgotten.
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

    /// Bytes of a client have arrived, in pieces of any length; says how many were taken. The others
    /// are to be given again when an answer has been sent.
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

    /// Time has passed: moves the components on, answers what was held long enough, and closes
    /// connections that never got beyond their greeting.
    pub fn handle_timeout(&mut self, now: Instant) {
        for place in 0..PEERS {
            if let Some(connection) = self.peers.get_mut(place)
                && connection.poll_timeout() <= now
            {
                connection.handle_timeout(now);
                self.forget_waiting(Peer(place as u8));
            }
        }
        self.tasks.handle_timeout(now);
        self.tell_news(now);
        self.dispatcher
            .handle_timeout(now, &mut answer(&mut self.peers));
    }

    /// The next bytes for a client; empty when there are none. To be followed by
    /// [`consume`](Self::consume).
    pub fn transmit_buf(&mut self, peer: Peer) -> &[u8] {
        let connection = self.peers.get_mut(usize::from(peer.0));
        connection.map_or(&[], |connection| connection.transmit_buf())
    }

    /// The first `count` bytes of [`transmit_buf`](Self::transmit_buf) are sent.
    pub fn consume(&mut self, peer: Peer, count: usize) {
        if let Some(connection) = self.peers.get_mut(usize::from(peer.0)) {
            connection.consume(count);
        }
    }

    /// Whether a client's stream is still needed; else it is to be closed.
    pub fn is_open(&self, peer: Peer) -> bool {
        let connection = self.peers.get(usize::from(peer.0));
        connection.is_some_and(Connection::is_open)
    }

    /// Why this end has closed a client's connection, if it has.
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

    /// Emergency stop, as [`Node::stop_everything`](crate::Node::stop_everything).
    pub fn stop_everything(&mut self, now: Instant) {
        self.tasks.stop_everything(now);
        self.tell_news(now);
    }

    /// Ends the emergency stop.
    pub const fn clear_stop(&mut self) {
        self.tasks.clear_stop();
    }

    /// Whether there was an emergency stop that is not cleared.
    #[must_use]
    pub const fn is_stopped(&self) -> bool {
        self.tasks.is_stopped()
    }

    /// What it moves.
    #[must_use]
    pub const fn components(&self) -> &C {
        self.tasks.components()
    }

    /// What it moves, for what firmware has to tell a component.
    pub const fn components_mut(&mut self) -> &mut C {
        self.tasks.components_mut()
    }

    /// Nobody is left whom a held answer could reach.
    fn forget_waiting(&mut self, peer: Peer) {
        let memory = self.dispatcher.memory_mut();
        while memory.release(|waiter| waiter.peer == peer).is_some() {}
    }

    /// Deals with the request of a client that has come whole.
    fn on_request(&mut self, now: Instant, peer: Peer) {
        let Some(connection) = self.peers.get_mut(usize::from(peer.0)) else {
            return;
        };
        let Some(message) = connection.message() else {
            return;
        };
        let envelope = message.envelope();
        // The answer repeats these fields, and has to be one that can be read after it was cut.
        let room = connection.answer_room();
        let fits = |body| header_len(body) + HEADER_GROWS <= room;
        self.request.clear();
        let body = match message.content {
            Content::One(body) if fits(body) => {
                let whole = push_bytes(&mut self.request, body).is_some();
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
                // Its answer is held, so there is room in its buffer.
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
        self.tell_news(now);
    }

    /// Tells the dispatcher what has become of tasks.
    fn tell_news(&mut self, now: Instant) {
        let out = &mut answer(&mut self.peers);
        let dispatcher = &mut self.dispatcher;
        self.tasks.tell_news(|id, state, text| {
            let event = match state {
                State::Completed => Event::Complete,
                State::Aborted => Event::Abort,
                State::Failed | State::Rejected => Event::Fail,
                State::Initiated | State::Accepted => {
                    // What is not known yet stays `None`, as the original says.
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

/// How the dispatcher's answers get to the clients.
fn answer<const PEERS: usize, const BUFFER: usize>(
    peers: &mut [Connection<Rep, [u8; BUFFER]>; PEERS],
) -> impl FnMut(Peer, &Reply<'_>) {
    |peer, reply| {
        if let Some(connection) = peers.get_mut(usize::from(peer.0)) {
            connection.reply(&mut |sink| reply.put(sink));
        }
    }
}

/// Starts a task, or says why not. What is `said` is a place for that; it needs no mark of a cut, since an answer
/// has less room, and is marked where it is cut.
// Apart in firmware, so that its stack is free again when the answer is written.
#[cfg_attr(target_os = "none", inline(never))]
fn start<'t, C: Components, const TASKS: usize, const BUFFER: usize>(
    now: Instant,
    name: &str,
    tasks: &mut Runner<C, TASKS>,
    id: TaskId,
    spec: Result<&[u8], DecodeError>,
    said: &'t mut Words<BUFFER>,
) -> (State, Event, &'t str) {
    let mut text = Words::<BUFFER>::new();
    let spec = match spec {
        Ok(bytes) if push_bytes(&mut text, bytes).is_some() => TaskSpec::split(&text),
        Ok(_) => Err(SpecError::NotUtf8 { at: text.len() }),
        Err(error) => Err(SpecError::Base64(error)),
    };
    let spec = match spec {
        Ok(spec) => spec,
        // The original's words where it has some (wire specification 4.6).
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
            let _ = push_bytes(said, bytes);
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

/// Starts a task; says whether it did.
fn try_start<C: Components, const TASKS: usize>(
    now: Instant,
    name: &str,
    tasks: &mut Runner<C, TASKS>,
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

/// How long scope, state and id of a request are, with their marks.
fn header_len(body: &[u8]) -> usize {
    let mut marks = body.iter().enumerate().filter(|(_, byte)| **byte == b';');
    marks.nth(2).map_or(body.len(), |(at, _)| at + 1)
}

fn put_all(sink: &mut dyn Sink, parts: &[&str]) {
    for part in parts {
        sink.put(part.as_bytes());
    }
}

/// The first id of a boot: far from those of the boots before, also where those are counted
/// (Fibonacci hashing).
const fn first_id(boot: u32) -> TaskId {
    match TaskId::new(boot.wrapping_mul(0x9E37_79B1) >> 2 | 1) {
        Some(id) => id,
        // Never: it is odd.
        None => TaskId::MAX,
    }
}
