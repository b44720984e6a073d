//! The connections of a node: one thread, sockets that never block, queues with an end.

use std::cmp::Reverse;
use std::collections::{HashMap, VecDeque};
use std::io::{self, Read as _};
use std::mem;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use mio::net::{TcpListener, TcpStream};
use mio::{Events, Interest, Poll, Token, Waker};

use super::connection::Connection;
use super::net_error::{NetError, plain};
use super::outbox::{Outbox, is_later};
use super::sockets;
use super::unacknowledged::{self, Ends, Missing};
use crate::uri::Address;

/// Bytes that are read from a connection in one turn, so that a node that floods keeps no other waiting.
pub(crate) const PIECE: usize = 64 * 1024;

/// Connections that others may hold open.
const MOST_ACCEPTED: usize = 512;

/// Host names that are looked up at a time, each on a thread.
const MOST_LOOKUPS: usize = 8;

/// The pause after the system had no room for another connection.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);

const WAKER: Token = Token(0);
const LISTENERS: [(Token, Listener); 2] = [(Token(1), Listener::Api), (Token(2), Listener::Tcpros)];

/// How often a connection that closes is looked at, until everything is acknowledged.
const LOOK: Duration = Duration::from_millis(10);

/// Longer than any wait.
const FAR: Duration = Duration::from_secs(3600);

/// What a listening socket is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Listener {
    /// The node's own API, XML-RPC.
    Api,
    /// Subscribers of the node's topics.
    Tcpros,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct ConnectionId(usize);

/// What happened to a connection.
#[derive(Debug)]
pub(crate) enum NetEvent {
    Accepted(Listener, ConnectionId),
    /// [`Net::read`] may return something.
    Readable(ConnectionId),
    /// It is closed.
    Failed(ConnectionId, NetError),
}

/// What [`Net::read`] found.
pub(crate) enum Read {
    Bytes(usize),
    /// Nothing for now.
    Later,
    Ended(NetError),
}

/// The way to the thread of a node.
#[derive(Debug)]
pub(crate) struct Wake(Waker);

impl Wake {
    pub(crate) fn wake(&self) {
        let _ = self.0.wake();
    }
}

/// All connections of a node.
pub(crate) struct Net {
    poll: Poll,
    system_events: Events,
    listeners: [TcpListener; 2],
    connections: HashMap<ConnectionId, Connection>,
    next_id: usize,
    readable: VecDeque<ConnectionId>,
    events: VecDeque<NetEvent>,
    /// Hosts that are looked up or were, with the time when the answer is too old.
    hosts: HashMap<String, Host>,
    /// Host names to look up, and how many are being looked up.
    to_look_up: VecDeque<String>,
    lookups: usize,
    /// When something is to be done next.
    next: Instant,
}

enum Host {
    Asked,
    Known(Option<IpAddr>, Instant),
}

impl Net {
    /// Listens at two ports of this address that the system chooses.
    pub(crate) fn bind(address: Ipv4Addr) -> io::Result<(Self, Wake)> {
        let poll = Poll::new()?;
        let registry = poll.registry();
        let wake = Wake(Waker::new(registry, WAKER)?);
        let listen = || TcpListener::bind((address, 0).into());
        let mut listeners = [listen()?, listen()?];
        for (listener, (token, _)) in listeners.iter_mut().zip(LISTENERS) {
            registry.register(listener, token, Interest::READABLE)?;
        }
        let net = Self {
            poll,
            system_events: Events::with_capacity(256),
            listeners,
            connections: HashMap::new(),
            next_id: LISTENERS.len() + 1,
            readable: VecDeque::new(),
            events: VecDeque::new(),
            hosts: HashMap::new(),
            to_look_up: VecDeque::new(),
            lookups: 0,
            next: Instant::now(),
        };
        Ok((net, wake))
    }

    /// The ports of the API and of TCPROS.
    pub(crate) fn ports(&self) -> io::Result<[u16; 2]> {
        let [api, tcpros] = &self.listeners;
        Ok([api.local_addr()?.port(), tcpros.local_addr()?.port()])
    }

    /// Has [`is_due`](Self::is_due) return true at this time.
    pub(crate) fn wake_by(&mut self, at: Instant) {
        self.next = self.next.min(at);
    }

    /// Whether it is time for everything that waits for a time; each thing then says again when its next time is.
    pub(crate) fn is_due(&mut self, now: Instant) -> bool {
        let due = now >= self.next;
        if due {
            self.next = now + FAR;
        }
        due
    }

    /// Waits for something to happen.
    pub(crate) fn poll(&mut self) -> io::Result<()> {
        let idle = self.readable.is_empty() && self.events.is_empty();
        let limit = match idle {
            true => self.next.saturating_duration_since(Instant::now()),
            false => Duration::ZERO,
        };
        match self.poll.poll(&mut self.system_events, Some(limit)) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Ok(()),
            done => done?,
        }
        let events = mem::replace(&mut self.system_events, Events::with_capacity(0));
        for event in &events {
            match LISTENERS
                .iter()
                .position(|(token, _)| *token == event.token())
            {
                Some(index) => self.accept(index),
                None => {
                    let id = ConnectionId(event.token().0);
                    if let Some(connection) = self.connections.get_mut(&id) {
                        connection.ended |= event.is_read_closed() || event.is_error();
                    }
                    self.flush(id);
                    self.list(id);
                }
            }
        }
        self.system_events = events;
        for id in mem::take(&mut self.readable) {
            if let Some(connection) = self.connections.get_mut(&id) {
                connection.listed = false;
                self.events.push_back(NetEvent::Readable(id));
            }
        }
        Ok(())
    }

    /// What has happened.
    pub(crate) fn next_event(&mut self) -> Option<NetEvent> {
        self.events.pop_front()
    }

    /// A host name to look up, for [`handle_host`](Self::handle_host).
    pub(crate) fn next_lookup(&mut self) -> Option<String> {
        if self.lookups >= MOST_LOOKUPS {
            return None;
        }
        while let Some(host) = self.to_look_up.pop_front() {
            let mut connections = self.connections.values();
            if connections.any(|of| of.stream.is_none() && of.peer.host == host) {
                self.lookups += 1;
                return Some(host);
            }
            // Whoever waited for it has given up.
            self.hosts.remove(&host);
        }
        None
    }

    /// A host name was looked up.
    pub(crate) fn handle_host(&mut self, now: Instant, host: &str, address: Option<IpAddr>) {
        self.lookups = self.lookups.saturating_sub(1);
        // An unknown name is looked up again soon: a person may be adding it.
        let valid = Duration::from_secs(if address.is_some() { 30 } else { 1 });
        let known = Host::Known(address, now + valid);
        self.hosts.insert(host.to_owned(), known);
        let waits =
            |connection: &Connection| connection.stream.is_none() && connection.peer.host == host;
        let waiting = self
            .connections
            .iter()
            .filter(|(_, connection)| waits(connection));
        let waiting: Vec<ConnectionId> = waiting.map(|(id, _)| *id).collect();
        waiting.into_iter().for_each(|id| self.connect(now, id));
    }

    /// Closes what has passed its deadline, and what acknowledges nothing.
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        let mut table = unacknowledged::Table::default();
        let (mut late, mut settled, mut next) = (Vec::new(), Vec::new(), self.next);
        for (id, connection) in &mut self.connections {
            if connection.closing && connection.is_settled(&mut table) {
                settled.push(*id);
                continue;
            }
            if connection.closing && connection.outbox.has_limit() {
                next = next.min(now + LOOK);
            }
            if connection.outbox.deadline().is_some_and(|at| at <= now) {
                connection.is_settled(&mut table);
            }
            let peer = || connection.peer.to_string();
            match (connection.deadline, connection.outbox.deadline()) {
                (_, Some(at)) if at <= now => late.push((*id, NetError::Silent { peer: peer() })),
                (Some(at), _) if at <= now => late.push((*id, NetError::TimedOut { peer: peer() })),
                (one, other) => {
                    next = one.into_iter().chain(other).fold(next, Instant::min);
                }
            }
        }
        self.next = next;
        for (id, error) in late {
            self.discard(id, error);
        }
        for id in settled {
            let peer = self.peer(id);
            self.fail(id, NetError::Closed { peer });
        }
        self.hosts.retain(|_, host| match host {
            Host::Asked => true,
            Host::Known(_, until) => *until > now,
        });
        for index in 0..LISTENERS.len() {
            self.accept(index);
        }
    }

    /// Begins to connect. An event reports a failure.
    pub(crate) fn open(&mut self, now: Instant, peer: Address, deadline: Instant) -> ConnectionId {
        let id = self.insert(peer, None, Some(deadline));
        self.connect(now, id);
        id
    }

    /// Sends a message. If `most` messages wait already, drops the oldest; returns whether it did.
    pub(crate) fn send(&mut self, id: ConnectionId, message: Arc<[u8]>, most: usize) -> bool {
        let Some(connection) = self.connections.get_mut(&id) else {
            return false;
        };
        let was_empty = connection.outbox.is_empty();
        let full = connection.outbox.push(Instant::now(), message, most);
        let late = connection.outbox.deadline();
        if was_empty {
            self.flush(id);
        }
        self.next = late.map_or(self.next, |late| self.next.min(late));
        full
    }

    /// From now on, the other end must acknowledge each message within this time. If it does not, the connection fails, and
    /// the system sends nothing of what waits. So it is also if this process is killed: the system would go on sending for
    /// minutes, and deliver when the network is back.
    pub(crate) fn limit(&mut self, id: ConnectionId, limit: Duration) {
        let Some(connection) = self.connections.get_mut(&id) else {
            return;
        };
        connection.outbox.limit(limit);
        if let Some(stream) = &connection.stream {
            sockets::limit(stream, limit);
        }
    }

    /// Whether all that was sent is acknowledged, on a connection with a limit. One that has failed never is.
    pub(crate) fn is_settled(
        &mut self,
        id: ConnectionId,
        table: &mut unacknowledged::Table,
    ) -> bool {
        let connection = self.connections.get_mut(&id);
        connection.is_some_and(|connection| connection.is_settled(table))
    }

    /// Whether the system tells that the other end has not acknowledged something.
    pub(crate) fn has_unacknowledged(
        &self,
        id: ConnectionId,
        table: &mut unacknowledged::Table,
    ) -> bool {
        let ends = self.connections.get(&id).and_then(|of| of.ends);
        ends.is_some_and(|ends| matches!(table.bytes(ends), Missing::Bytes(1..)))
    }

    /// Closes a connection of which all that waits is too late.
    pub(crate) fn discard(&mut self, id: ConnectionId, error: NetError) {
        if let Some(stream) = self.connections.get(&id).and_then(|of| of.stream.as_ref()) {
            sockets::discard_at_close(stream);
        }
        self.fail(id, error);
    }

    /// Whether nothing must be sent or acknowledged any more on connections with a limit.
    pub(crate) fn has_settled(&mut self) -> bool {
        let mut table = unacknowledged::Table::default();
        let mut limited = self
            .connections
            .values_mut()
            .filter(|of| of.outbox.has_limit());
        limited.all(|connection| connection.is_settled(&mut table))
    }

    /// Reads at most [`PIECE`] bytes.
    pub(crate) fn read(&mut self, id: ConnectionId, piece: &mut [u8]) -> Read {
        let Some(connection) = self.connections.get_mut(&id) else {
            return Read::Later;
        };
        let Some(stream) = &mut connection.stream else {
            return Read::Later;
        };
        match stream.read(piece) {
            Ok(0) => Read::Ended(NetError::Closed {
                peer: connection.peer.to_string(),
            }),
            Ok(count) => {
                if count == piece.len() || connection.ended {
                    self.list(id);
                }
                Read::Bytes(count)
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {
                self.list(id);
                Read::Later
            }
            Err(error) if is_later(&error) => Read::Later,
            Err(error) => Read::Ended(connection.failure(&error)),
        }
    }

    pub(crate) fn close(&mut self, id: ConnectionId) {
        if let Some(mut connection) = self.connections.remove(&id)
            && let Some(stream) = &mut connection.stream
        {
            let _ = self.poll.registry().deregister(stream);
            let mut table = unacknowledged::Table::default();
            if connection.outbox.has_limit() && connection.is_settled(&mut table) {
                connection.stream.iter().for_each(sockets::deliver_at_close);
            }
        }
    }

    pub(crate) fn close_all(&mut self) {
        let ids: Vec<ConnectionId> = self.connections.keys().copied().collect();
        ids.into_iter().for_each(|id| self.close(id));
    }

    /// Closes the connection once everything is sent, or after a second.
    pub(crate) fn close_when_sent(&mut self, now: Instant, id: ConnectionId) {
        if let Some(connection) = self.connections.get_mut(&id) {
            connection.closing = true;
        }
        self.set_deadline(id, Some(now + Duration::from_secs(1)));
        self.flush(id);
    }

    /// When the connection fails as timed out.
    pub(crate) fn set_deadline(&mut self, id: ConnectionId, deadline: Option<Instant>) {
        if let Some(connection) = self.connections.get_mut(&id) {
            connection.deadline = deadline;
            self.next = deadline.map_or(self.next, |deadline| self.next.min(deadline));
        }
    }

    /// The address of the other end, for messages.
    pub(crate) fn peer(&self, id: ConnectionId) -> String {
        let connection = self.connections.get(&id);
        connection
            .map(|connection| connection.peer.to_string())
            .unwrap_or_default()
    }

    fn insert(
        &mut self,
        peer: Address,
        stream: Option<TcpStream>,
        deadline: Option<Instant>,
    ) -> ConnectionId {
        let id = ConnectionId(self.next_id);
        self.next_id = self.next_id.wrapping_add(1).max(LISTENERS.len() + 1);
        let accepted = stream.is_some();
        self.connections.insert(
            id,
            Connection {
                peer,
                ends: None,
                stream,
                outbox: Outbox::default(),
                closing: false,
                accepted,
                deadline: None,
                listed: false,
                ended: false,
            },
        );
        self.set_deadline(id, deadline);
        id
    }

    /// Connects, or asks for the address.
    fn connect(&mut self, now: Instant, id: ConnectionId) {
        let Some(connection) = self.connections.get_mut(&id) else {
            return;
        };
        let host = &connection.peer.host;
        let address = match host.as_str() {
            // RFC 6761: this name is this machine.
            "localhost" => Ok(Ipv4Addr::LOCALHOST.into()),
            host => host.parse::<IpAddr>(),
        };
        let address = match (address, self.hosts.get(host)) {
            (Ok(address), _) => Some(address),
            (Err(_), Some(Host::Known(address, until))) if *until > now => *address,
            (Err(_), Some(Host::Asked)) => return,
            (Err(_), _) => {
                self.hosts.insert(host.clone(), Host::Asked);
                self.to_look_up.push_back(host.clone());
                return;
            }
        };
        let Some(address) = address else {
            let host = host.clone();
            return self.fail(id, NetError::UnknownHost { host });
        };
        let port = connection.peer.port;
        let registry = self.poll.registry();
        let theirs = SocketAddr::new(address, port);
        let stream = TcpStream::connect(theirs).and_then(|mut stream| {
            let both = Interest::READABLE | Interest::WRITABLE;
            registry.register(&mut stream, Token(id.0), both)?;
            Ok(stream)
        });
        match stream {
            Ok(stream) => {
                sockets::prepare(&stream);
                connection.ends = Ends::of(&stream, theirs);
                connection.stream = Some(stream);
            }
            Err(error) => {
                let (peer, error) = (connection.peer.to_string(), plain(&error));
                self.fail(id, NetError::Failed { peer, error });
            }
        }
    }

    fn accept(&mut self, index: usize) {
        let (Some(listener), Some((_, kind))) = (self.listeners.get(index), LISTENERS.get(index))
        else {
            return;
        };
        let mut arrived = Vec::new();
        loop {
            match listener.accept() {
                Ok(accepted) => arrived.push(accepted),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) => {
                    tracing::debug!(%error, "cannot accept a connection");
                    let again = Instant::now() + ACCEPT_AGAIN;
                    self.next = self.next.min(again);
                    break;
                }
            }
        }
        for (stream, address) in arrived {
            let peer = Address {
                host: address.ip().to_canonical().to_string(),
                port: address.port(),
            };
            let id = self.insert(peer, Some(stream), None);
            let connection = self.connections.get_mut(&id);
            let stream = connection.and_then(|connection| {
                let stream = connection.stream.as_mut()?;
                connection.ends = Ends::of(stream, address);
                Some(stream)
            });
            let both = Interest::READABLE | Interest::WRITABLE;
            let registry = self.poll.registry();
            let registered = stream.map(|stream| {
                sockets::prepare(stream);
                registry.register(stream, Token(id.0), both)
            });
            match registered {
                Some(Ok(())) => self.events.push_back(NetEvent::Accepted(*kind, id)),
                _ => self.close(id),
            }
        }
        self.make_room();
    }

    /// Whether another connection is accepted only instead of one that is there.
    pub(crate) fn is_full(&self) -> bool {
        let accepted = self.connections.values().filter(|of| of.accepted);
        accepted.count() >= MOST_ACCEPTED
    }

    /// Closes accepted connections beyond the limit: first those that would time out first, and then the newest of the host
    /// that has most.
    fn make_room(&mut self) {
        let connections = self.connections.iter();
        let accepted = connections.filter(|(_, connection)| connection.accepted);
        let accepted: Vec<(ConnectionId, &Connection)> =
            accepted.map(|(id, connection)| (*id, connection)).collect();
        let Some(surplus @ 1..) = accepted.len().checked_sub(MOST_ACCEPTED) else {
            return;
        };
        let mut hosts: HashMap<&str, usize> = HashMap::new();
        for (_, connection) in &accepted {
            *hosts.entry(&connection.peer.host).or_default() += 1;
        }
        let rank = |(id, connection): &(ConnectionId, &Connection)| {
            let count = hosts.get(&*connection.peer.host).copied();
            let deadline = connection.deadline;
            (deadline.is_none(), deadline, Reverse((count, id.0)))
        };
        let mut accepted = accepted;
        accepted.sort_by_cached_key(rank);
        let surplus: Vec<ConnectionId> = accepted.iter().take(surplus).map(|(id, _)| *id).collect();
        for id in surplus {
            let peer = self.peer(id);
            self.fail(id, NetError::Crowded { peer });
        }
    }

    fn flush(&mut self, id: ConnectionId) {
        let Some(connection) = self.connections.get_mut(&id) else {
            return;
        };
        let Some(stream) = &mut connection.stream else {
            return;
        };
        if let Err(error) = connection.outbox.flush(stream) {
            let error = connection.failure(&error);
            return self.fail(id, error);
        }
        if connection.closing && connection.outbox.is_settled() {
            let peer = connection.peer.to_string();
            self.fail(id, NetError::Closed { peer });
        }
    }

    fn list(&mut self, id: ConnectionId) {
        if let Some(connection) = self.connections.get_mut(&id)
            && !mem::replace(&mut connection.listed, true)
        {
            self.readable.push_back(id);
        }
    }

    fn fail(&mut self, id: ConnectionId, error: NetError) {
        self.close(id);
        self.events.push_back(NetEvent::Failed(id, error));
    }
}
