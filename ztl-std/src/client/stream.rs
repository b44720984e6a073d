//! A client's connection without libzmq: a session of [`ztl_zmtp`] on a TCP stream. It has no thread: it connects, and
//! connects again, while it is waited for.

use std::collections::VecDeque;
use std::io::{self, Read as _, Write as _};
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::time::{Duration, Instant};

use mio::net::TcpStream;
use mio::{Events, Interest, Poll, Token};
use ztl_zmtp::Dealer;
use ztl_zmtp::session::{Inbound, Outbound, Security, Step};

use super::connection::RETRY;
use crate::time::now;

/// Bytes read at once.
const PIECE: usize = 64 * 1024;

/// A connection that is being made, or open.
struct Open {
    stream: TcpStream,
    inbound: Inbound<Dealer>,
    out: Outbound,
}

/// A connection to one server.
pub(super) struct Stream {
    /// `127.0.0.1:12345`
    place: String,
    security: Security,
    /// Longest accepted message in bytes.
    longest: usize,
    poll: Poll,
    events: Events,
    open: Option<Open>,
    /// When to connect again, and how long to wait the next time.
    again: Instant,
    pause: Duration,
    received: VecDeque<Vec<Vec<u8>>>,
    piece: Box<[u8]>,
}

impl Stream {
    pub(super) fn new(place: &str, security: Security, longest: usize) -> io::Result<Self> {
        Ok(Self {
            place: place.to_owned(),
            security,
            longest,
            poll: Poll::new()?,
            events: Events::with_capacity(4),
            open: None,
            again: Instant::now(),
            pause: shortest_pause(),
            received: VecDeque::new(),
            piece: vec![0; PIECE].into_boxed_slice(),
        })
    }

    /// Connects if needed, at most for `limit`; returns whether a message can be sent.
    pub(super) fn can_send(&mut self, limit: Duration) -> io::Result<bool> {
        let end = Instant::now() + limit;
        // Notices that the server has closed the connection.
        self.read();
        loop {
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
    pub(super) fn can_receive(&mut self, limit: Duration) -> io::Result<bool> {
        let end = Instant::now() + limit;
        loop {
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
    pub(super) fn send(&mut self, envelope: &[&[u8]], body: &[u8]) {
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
    pub(super) fn receive(&mut self) -> Option<Vec<Vec<u8>>> {
        self.received.pop_front()
    }

    fn is_ready(&self) -> bool {
        let ready = |open: &Open| open.inbound.is_ready();
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
            return self.connect();
        }
        // The handshake has a limit of its own.
        let handshake = self.open.as_ref().map(|open| open.inbound.deadline());
        let handshake = handshake.map_or(limit, |deadline| deadline.since(now()));
        if handshake.is_zero() {
            self.close();
            return Ok(());
        }
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

    fn connect(&mut self) -> io::Result<()> {
        self.again = Instant::now() + self.pause;
        self.pause = (self.pause * 2).min(longest_pause());
        // A name without an address may get one.
        let addresses = self.place.to_socket_addrs().into_iter().flatten();
        let addresses: Vec<SocketAddr> = addresses.collect();
        let v4 = addresses.iter().find(|address| address.is_ipv4());
        let Some(address) = v4.or(addresses.first()) else {
            return Ok(());
        };
        let Ok(mut stream) = TcpStream::connect(*address) else {
            return Ok(());
        };
        let both = Interest::READABLE | Interest::WRITABLE;
        self.poll.registry().register(&mut stream, Token(0), both)?;
        let mut out = Outbound::default();
        let inbound = Inbound::open(now(), self.security.clone(), self.longest, &mut out);
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
                Err(_) => return self.close(),
            }
        }
    }

    /// Reads what has arrived.
    fn read(&mut self) {
        loop {
            let Some(open) = &mut self.open else {
                return;
            };
            let count = match open.stream.read(&mut self.piece) {
                Ok(0) => return self.close(),
                Ok(count) => count,
                Err(error) if is_later(&error) => return,
                Err(_) => return self.close(),
            };
            let mut bytes = self.piece.get(..count).unwrap_or_default();
            loop {
                match open.inbound.next(&mut bytes, &mut open.out) {
                    Ok(Step::Taken) => break,
                    Ok(Step::Asks) => {
                        open.inbound.accept(&mut open.out);
                        self.pause = shortest_pause();
                    }
                    Ok(Step::Message(message)) => {
                        let frames = message.frames().map(<[u8]>::to_vec);
                        self.received.push_back(frames.collect());
                    }
                    Err(_) => return self.close(),
                }
            }
            self.flush();
            if count < PIECE {
                return;
            }
        }
    }

    fn close(&mut self) {
        if let Some(mut open) = self.open.take() {
            let _ = self.poll.registry().deregister(&mut open.stream);
        }
        self.again = self.again.max(Instant::now() + shortest_pause());
    }
}

/// Whether a call would have to wait: also while the connection is being made.
fn is_later(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, NotConnected, WouldBlock};
    matches!(error.kind(), WouldBlock | Interrupted | NotConnected)
}

const fn shortest_pause() -> Duration {
    Duration::from_millis(RETRY.0 as u64)
}

const fn longest_pause() -> Duration {
    Duration::from_millis(RETRY.1 as u64)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use crate::controller::{ExecutableTask, TaskContext, TaskController, TaskError};
    use crate::server::{TaskServer, Transport};
    use crate::{Access, RemoteTask, State, TaskRequest};

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
            (Transport::Own, Transport::Own),
            (Transport::Own, Transport::Libzmq),
            (Transport::Libzmq, Transport::Own),
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
        let builder = TaskServer::builder().transport(Transport::Own);
        let server = builder.access(access).bind("tcp://127.0.0.1:*");
        let mut server = server.unwrap();
        let echo = Echo::default();
        server.register("/lab", echo.clone());
        let server = server.spawn().unwrap();
        let connect = || {
            let remote = RemoteTask::connect(server.endpoint(), "/lab").unwrap();
            remote.with_transport(Transport::Own).unwrap()
        };
        let run = |mut remote: RemoteTask| remote.run("p", "echo", "hi", LIMIT);
        let end = run(connect().with_keys(allowed, public).unwrap()).unwrap();
        assert_eq!((end.state, end.text.as_str()), (State::Completed, "hi"));
        let short = std::time::Duration::from_millis(500);
        assert!(
            run(connect()
                .with_timeout(short)
                .with_keys(stranger, public)
                .unwrap())
            .is_err()
        );
        assert!(run(connect().with_timeout(short)).is_err());
        assert_eq!(echo.0.load(Ordering::SeqCst), 1);
    }

    #[test]
    fn a_client_meets_a_server_that_comes_later_and_one_that_was_restarted() {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("tcp://{}", port.local_addr().unwrap());
        drop(port);
        let remote = RemoteTask::connect(&endpoint, "/lab").unwrap();
        let mut remote = remote.with_transport(Transport::Own).unwrap();
        let run = {
            let mut remote = remote.clone().with_timeout(LIMIT.unwrap());
            std::thread::spawn(move || remote.run("p", "echo", "hi", LIMIT))
        };
        std::thread::sleep(std::time::Duration::from_millis(50));
        let serve = || {
            let builder = TaskServer::builder().transport(Transport::Own);
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
