//! A client's or subscriber's connection without libzmq: a session of [`ztl_zmtp`] on a TCP stream. It has no thread: it
//! connects, and connects again, while it is waited for.

use std::collections::VecDeque;
use std::io::{self, Read as _, Write as _};
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use mio::{Events, Poll, Token};
use ztl_zmtp::session::{Inbound, Obstacle, Outbound, Security, Step};
use ztl_zmtp::{Dealer, Fault, HANDSHAKE, Socket};

use super::sockets::{Endpoint, Stream};
use crate::time::now;
use crate::transport::RETRY;

/// Bytes read at once.
const PIECE: usize = 64 * 1024;
/// While so many messages wait to be received, no more is read: one answers the current request, and one came too late.
const WAITING: usize = 2;

/// Most frames of a message. One with more is received as one without any, which means nothing: each small frame takes
/// many times its length.
const FRAMES: usize = 16;

/// Pauses before connecting again.
const SHORTEST: Duration = RETRY.0;
const LONGEST: Duration = RETRY.1;

/// A connection that is being made, or open.
struct Open<S> {
    stream: Stream,
    inbound: Inbound<S>,
    out: Outbound,
}

/// A connection to one server or publisher, as a socket of type `S`.
pub(crate) struct Dialer<S = Dealer> {
    endpoint: Endpoint,
    security: Security,
    /// Longest accepted message in bytes.
    longest: usize,
    poll: Poll,
    events: Events,
    open: Option<Open<S>>,
    /// Messages that are sent first on each connection.
    first: Vec<Vec<u8>>,
    /// How many connections were lost after the handshake.
    lost: u64,
    /// When to connect again, and how long to wait the next time.
    again: Instant,
    pause: Duration,
    received: VecDeque<Vec<Vec<u8>>>,
    /// Whether the system may have more bytes.
    more: bool,
    piece: Box<[u8]>,
    /// Looks up the host's address, which may take long.
    lookup: Option<Receiver<Option<SocketAddr>>>,
    /// What ended the last attempt to connect.
    obstacle: Option<Obstacle>,
    /// Whether closing the connection discards what was not delivered.
    discards: bool,
}

impl<S: Socket> Dialer<S> {
    pub(crate) fn new(endpoint: Endpoint, security: Security, longest: usize) -> io::Result<Self> {
        Ok(Self {
            endpoint,
            security,
            longest,
            poll: Poll::new()?,
            events: Events::with_capacity(4),
            open: None,
            first: Vec::new(),
            lost: 0,
            again: Instant::now(),
            pause: SHORTEST,
            received: VecDeque::new(),
            more: false,
            piece: vec![0; PIECE].into_boxed_slice(),
            lookup: None,
            obstacle: None,
            discards: false,
        })
    }

    /// Sends these messages first on each connection.
    #[cfg(feature = "publish")]
    pub(crate) fn with_first(mut self, messages: Vec<Vec<u8>>) -> Self {
        self.first = messages;
        self
    }

    /// Sends these messages first on each later connection.
    #[cfg(feature = "publish")]
    pub(crate) fn set_first(&mut self, messages: Vec<Vec<u8>>) {
        self.first = messages;
    }

    /// Sends a message of one frame, if there is a connection.
    #[cfg(feature = "publish")]
    pub(crate) fn send_frame(&mut self, frame: &[u8]) {
        if let Some(open) = self.open.as_mut().filter(|open| open.inbound.is_ready()) {
            open.out.message(b"", frame);
        }
        self.flush();
    }

    /// How many connections were lost after the handshake.
    pub(crate) const fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether closing the connection discards what the system has not delivered yet.
    pub(crate) fn discard_unsent(&mut self, on: bool) {
        self.discards = on;
        if let Some(open) = &self.open {
            open.stream.discard_unsent(on);
        }
    }

    /// Connects if needed, at most for `limit`; returns whether a message can be sent.
    pub(crate) fn can_send(&mut self, limit: Duration) -> io::Result<bool> {
        let end = Instant::now() + limit;
        loop {
            // Notices that the server has closed the connection, perhaps together with its last bytes.
            self.read();
            if self.is_ready() {
                return Ok(true);
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(false);
            }
            self.turn(left)?;
        }
    }

    /// Whether a message arrives within `limit`.
    pub(crate) fn can_receive(&mut self, limit: Duration) -> io::Result<bool> {
        let end = Instant::now() + limit;
        loop {
            self.read();
            if !self.received.is_empty() {
                return Ok(true);
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(false);
            }
            self.turn(left)?;
        }
    }

    /// Sends a message: frames before the delimiter, and the one after it.
    pub(crate) fn send(&mut self, envelope: &[&[u8]], body: &[u8]) {
        let mut frames = Vec::new();
        for frame in envelope {
            // Our frames are short.
            frames.extend_from_slice(&[1, u8::try_from(frame.len()).unwrap_or_default()]);
            frames.extend_from_slice(frame);
        }
        frames.extend_from_slice(&[1, 0]);
        if let Some(open) = &mut self.open {
            open.out.message(&frames, body);
        }
        self.flush();
    }

    /// The next message.
    pub(crate) fn receive(&mut self) -> Option<Vec<Vec<u8>>> {
        self.received.pop_front()
    }

    /// What ended the last attempt to connect, if the server's side of the handshake tells it.
    pub(crate) const fn obstacle(&self) -> Option<Obstacle> {
        self.obstacle
    }

    pub(crate) fn is_ready(&self) -> bool {
        let ready = |open: &Open<S>| open.inbound.is_ready();
        self.open.as_ref().is_some_and(ready)
    }

    /// Waits for something to happen, at most for `limit`.
    fn turn(&mut self, limit: Duration) -> io::Result<()> {
        if self.open.is_none() {
            let pause = self.again.saturating_duration_since(Instant::now());
            if !pause.is_zero() {
                std::thread::sleep(pause.min(limit));
                return Ok(());
            }
            return self.connect(limit);
        }
        // The handshake has a limit of its own.
        let handshake = self.open.as_ref().map(|open| open.inbound.deadline());
        let handshake = handshake.map_or(limit, |deadline| deadline.since(now()));
        if handshake.is_zero() {
            self.close(Some(Fault::Silent));
            return Ok(());
        }
        let limit = if self.more { Duration::ZERO } else { limit };
        match self.poll.poll(&mut self.events, Some(limit.min(handshake))) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => return Ok(()),
            done => done?,
        }
        if !self.events.is_empty() {
            self.flush();
            self.read();
        }
        Ok(())
    }

    /// Begins to connect, if the address is known within `limit`.
    fn connect(&mut self, limit: Duration) -> io::Result<()> {
        let stream = match &self.endpoint {
            #[cfg(unix)]
            Endpoint::Ipc(path) => Stream::connect_ipc(path),
            #[cfg(not(unix))]
            Endpoint::Ipc(_) => Err(io::ErrorKind::Unsupported.into()),
            Endpoint::Tcp { host, port } => {
                let lookup = self.lookup.take();
                let lookup = match lookup {
                    Some(lookup) => lookup,
                    None => look_up(host, *port)?,
                };
                match lookup.recv_timeout(limit) {
                    Ok(Some(address)) => Stream::connect_tcp(address),
                    // A name without an address may get one.
                    Ok(None) | Err(RecvTimeoutError::Disconnected) => {
                        Err(io::ErrorKind::NotFound.into())
                    }
                    Err(RecvTimeoutError::Timeout) => {
                        self.lookup = Some(lookup);
                        return Ok(());
                    }
                }
            }
        };
        self.again = Instant::now() + self.pause;
        self.pause = (self.pause * 2).min(LONGEST);
        let Ok(mut stream) = stream else {
            self.obstacle = None;
            return Ok(());
        };
        stream.register(self.poll.registry(), Token(0))?;
        stream.discard_unsent(self.discards);
        let mut out = Outbound::default();
        let inbound = Inbound::open(
            now() + HANDSHAKE,
            self.security.clone(),
            self.longest,
            &mut out,
        );
        self.open = Some(Open {
            stream,
            inbound,
            out,
        });
        Ok(())
    }

    /// Sends what can be sent without waiting.
    fn flush(&mut self) {
        let Some(open) = &mut self.open else {
            return;
        };
        while open.out.waiting() > 0 {
            match open.stream.write(open.out.transmit_buf()) {
                Ok(count) => open.out.consume(count),
                Err(error) if is_later(&error) => return,
                Err(_) => return self.close(None),
            }
        }
    }

    /// Reads a piece of what has arrived, unless enough messages wait to be received, or bytes to be sent.
    fn read(&mut self) {
        self.more = false;
        let Some(open) = &mut self.open else {
            return;
        };
        if self.received.len() >= WAITING || open.out.waiting() > PIECE {
            return;
        }
        let count = match open.stream.read(&mut self.piece) {
            Ok(0) => return self.close(None),
            Ok(count) => count,
            Err(error) if is_later(&error) => return,
            Err(_) => return self.close(None),
        };
        let mut bytes = self.piece.get(..count).unwrap_or_default();
        loop {
            match open.inbound.next(&mut bytes, &mut open.out) {
                Ok(Step::Taken) => break,
                Ok(Step::Asks) => {
                    open.inbound.accept(&mut open.out);
                    self.pause = SHORTEST;
                    for message in &self.first {
                        open.out.message(b"", message);
                    }
                    self.obstacle = None;
                }
                Ok(Step::Subscription(..)) => {}
                Ok(Step::Message(message)) => {
                    let frames = message.frames().map(<[u8]>::to_vec);
                    let mut frames: Vec<_> = frames.take(FRAMES + 1).collect();
                    if frames.len() > FRAMES {
                        frames.clear();
                    }
                    self.received.push_back(frames);
                }
                Err(fault) => return self.close(Some(fault)),
            }
        }
        open.inbound.on_heard(now());
        self.more = count == PIECE;
        self.flush();
    }

    /// Closes the connection after a fault, or because the server or the system closed it.
    fn close(&mut self, fault: Option<Fault>) {
        if let Some(mut open) = self.open.take() {
            self.lost += u64::from(open.inbound.is_ready());
            self.obstacle = open.inbound.obstacle(fault);
            open.stream.deregister(self.poll.registry());
        }
        self.again = self.again.max(Instant::now() + SHORTEST);
    }
}

/// Looks up an address on a thread of its own, unless the host is an address.
fn look_up(host: &str, port: u16) -> io::Result<Receiver<Option<SocketAddr>>> {
    let (found, lookup) = channel();
    if let Ok(address) = host.parse() {
        let _ = found.send(Some(SocketAddr::new(address, port)));
        return Ok(lookup);
    }
    let host = host.to_owned();
    let look_up = move || {
        let addresses = (host.as_str(), port).to_socket_addrs();
        let addresses: Vec<SocketAddr> = addresses.into_iter().flatten().collect();
        let v4 = addresses.iter().find(|address| address.is_ipv4());
        let _ = found.send(v4.or(addresses.first()).copied());
    };
    let thread = std::thread::Builder::new().name("ztl-lookup".to_owned());
    thread.spawn(look_up).map(|_| lookup)
}

/// Whether a call would have to wait: also while the connection is being made.
fn is_later(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, NotConnected, WouldBlock};
    matches!(error.kind(), WouldBlock | Interrupted | NotConnected)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use crate::controller::{ExecutableTask, TaskContext, TaskController, TaskError};
    use crate::{Access, RemoteTask, State, TaskRequest, TaskServer, Transport};

    const LIMIT: Option<std::time::Duration> = Some(std::time::Duration::from_secs(20));

    /// Completes each task with its goal, and counts.
    #[derive(Clone, Default)]
    struct Echo(Arc<AtomicU32>);

    impl TaskController for Echo {
        fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
            self.0.fetch_add(1, Ordering::SeqCst);
            let goal = request.goal.clone();
            Ok(Box::new(move |_: &TaskContext| {
                Ok::<_, TaskError>(goal.clone())
            }))
        }
    }

    #[test]
    fn both_transports_talk_to_each_other() {
        for (there, here) in [
            (Transport::Native, Transport::Native),
            (Transport::Native, Transport::Libzmq),
            (Transport::Libzmq, Transport::Native),
        ] {
            let builder = TaskServer::builder().transport(there);
            let mut server = builder.bind("tcp://127.0.0.1:*").unwrap();
            server.register("/lab", Echo::default());
            let server = server.spawn().unwrap();
            let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
            let mut remote = remote.with_transport(here).unwrap();
            for goal in ["hi", "", &"long ".repeat(30_000)] {
                let end = remote.run("p", "echo", goal, LIMIT).unwrap();
                assert_eq!((end.state, end.text.as_str()), (State::Completed, goal));
            }
            let mut other = remote.clone();
            let end = other.run("p", "echo", "other", LIMIT).unwrap();
            assert_eq!(end.text, "other");
        }
    }

    #[test]
    fn encrypted_only_an_allowed_client_is_served() {
        let [own, allowed, stranger] = [(); 3].map(|()| crate::keys::KeyPair::generate());
        let public = own.public();
        let access = Access::everybody().with_keys(own).allow(allowed.public());
        let builder = TaskServer::builder().transport(Transport::Native);
        let server = builder.access(access).bind("tcp://127.0.0.1:*");
        let mut server = server.unwrap();
        let echo = Echo::default();
        server.register("/lab", echo.clone());
        let server = server.spawn().unwrap();
        let connect = || {
            let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
            remote.with_transport(Transport::Native).unwrap()
        };
        let run = |mut remote: RemoteTask| remote.run("p", "echo", "hi", LIMIT);
        let end = run(connect().with_keys(allowed, public).unwrap()).unwrap();
        assert_eq!((end.state, end.text.as_str()), (State::Completed, "hi"));
        let soon = |remote: RemoteTask| remote.with_timeout(std::time::Duration::from_millis(500));
        assert!(run(soon(connect().with_keys(stranger, public).unwrap())).is_err());
        assert!(run(soon(connect())).is_err());
        assert_eq!(echo.0.load(Ordering::SeqCst), 1);
    }

    /// Tries until the error begins like this, since a slow machine may need several tries.
    #[track_caller]
    fn told(remote: RemoteTask, expected: &str) -> RemoteTask {
        let mut remote = remote.with_timeout(std::time::Duration::from_millis(300));
        let end = std::time::Instant::now() + LIMIT.unwrap();
        loop {
            let error = remote.run("p", "echo", "hi", LIMIT).unwrap_err();
            let error = error.to_string();
            assert!(error.ends_with("; nothing was sent"), "{error}");
            if error.starts_with(expected) {
                return remote;
            }
            assert!(std::time::Instant::now() < end, "{error}");
        }
    }

    #[test]
    fn a_client_says_what_keeps_it_from_its_server() {
        let [own, allowed, stranger] = [(); 3].map(|()| crate::keys::KeyPair::generate());
        let (public, other) = (own.public(), stranger.public());
        let open = Access::everybody;
        let secret = open().with_keys(own).allow(allowed.public());
        let elsewhere = open().from_network("10.1.2.0/24".parse().unwrap());
        for (there, access, keys, message) in [
            (
                Transport::Native,
                &secret,
                None,
                "encrypts, and this client has no keys: give",
            ),
            (
                Transport::Native,
                &secret,
                Some((allowed.clone(), other)),
                "does not have the key that this client expects: the client's --server-key must be",
            ),
            (
                Transport::Native,
                &secret,
                Some((stranger.clone(), public)),
                "does not admit this client: the server's --client-key must name",
            ),
            (
                Transport::Native,
                &open(),
                Some((allowed.clone(), public)),
                "does not encrypt, and this client has keys: start",
            ),
            (
                Transport::Libzmq,
                &open(),
                Some((allowed, public)),
                "does not encrypt, and this client has keys: start",
            ),
            (
                Transport::Native,
                &elsewhere,
                None,
                "does not admit this client: the server's --allow must name",
            ),
            (
                Transport::Libzmq,
                &elsewhere,
                None,
                "does not admit this client: the server's --allow must name",
            ),
        ] {
            let builder = TaskServer::builder().transport(there);
            let server = builder.access(access.clone()).bind("tcp://127.0.0.1:*");
            let mut server = server.unwrap();
            let echo = Echo::default();
            server.register("/lab", echo.clone());
            let server = server.spawn().unwrap();
            let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
            let mut remote = remote.with_transport(Transport::Native).unwrap();
            if let Some((own, server)) = keys {
                remote = remote.with_keys(own, server).unwrap();
            }
            told(
                remote,
                &format!("the server at {} {message}", server.endpoint()),
            );
            assert_eq!(echo.0.load(Ordering::SeqCst), 0);
        }
    }

    #[test]
    #[cfg(unix)]
    fn an_obstacle_that_is_gone_is_not_reported() {
        let allowed = crate::keys::KeyPair::generate();
        let endpoint = crate::native::own_endpoint();
        let serve = |access| {
            let builder = TaskServer::builder().transport(Transport::Native);
            let mut server = builder.access(access).bind(&endpoint).unwrap();
            server.register("/lab", Echo::default());
            server.spawn().unwrap()
        };
        let remote = RemoteTask::connect(&endpoint, "/lab").unwrap();
        let mut remote = remote.with_transport(Transport::Native).unwrap();
        let server = serve(Access::everybody().with_keys(allowed));
        remote = told(remote, &format!("the server at {endpoint} encrypts"));
        drop(server);
        remote = told(remote, &format!("no answer from {endpoint}"));
        let server = serve(Access::everybody());
        let mut remote = remote.with_timeout(LIMIT.unwrap());
        assert_eq!(remote.run("p", "echo", "hi", LIMIT).unwrap().text, "hi");
        drop(server);
    }

    #[test]
    #[cfg(unix)]
    fn a_client_meets_a_server_that_comes_later_and_one_that_was_restarted() {
        let endpoint = crate::native::own_endpoint();
        let remote = RemoteTask::connect(&endpoint, "/lab").unwrap();
        let mut remote = remote.with_transport(Transport::Native).unwrap();
        let run = {
            let mut remote = remote.clone().with_timeout(LIMIT.unwrap());
            std::thread::spawn(move || remote.run("p", "echo", "hi", LIMIT))
        };
        std::thread::sleep(std::time::Duration::from_millis(50));
        let serve = || {
            let builder = TaskServer::builder().transport(Transport::Native);
            let mut server = builder.bind(&endpoint).unwrap();
            server.register("/lab", Echo::default());
            server.spawn().unwrap()
        };
        let server = serve();
        assert_eq!(run.join().unwrap().unwrap().text, "hi");
        assert_eq!(remote.run("p", "echo", "one", LIMIT).unwrap().text, "one");
        drop(server);
        let _server = serve();
        let mut remote = remote.with_timeout(LIMIT.unwrap());
        assert_eq!(remote.run("p", "echo", "two", LIMIT).unwrap().text, "two");
    }
}
