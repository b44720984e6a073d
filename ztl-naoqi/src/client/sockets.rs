//! The sockets of a session.

use std::collections::VecDeque;
use std::io::{self, Read as _, Write as _};
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Instant;

use mio::net::TcpStream;
use mio::{Interest, Poll, Token, Waker};

use crate::endpoint::Endpoint;
use crate::session::{LinkId, Session};
use crate::table::Table;

use super::ClientCommand;

/// How much is read from one socket before the others get their turn, in bytes.
const TURN: usize = 256 << 10;

/// The addresses of an endpoint.
pub(super) struct Found {
    link: LinkId,
    addresses: io::Result<VecDeque<SocketAddr>>,
}

/// Looks up an endpoint: at once if its host is an address, else on a thread, which sends the result.
pub(super) fn look_up(
    link: LinkId,
    endpoint: &Endpoint,
    worker: &(Sender<ClientCommand>, Arc<Waker>),
) -> Option<Found> {
    let Endpoint { host, port } = endpoint.clone();
    if let Ok(address) = host.parse() {
        let addresses = Ok([SocketAddr::new(address, port)].into());
        return Some(Found { link, addresses });
    }
    let (commands, waker) = worker.clone();
    let look_up = move || {
        let addresses = (host.as_str(), port).to_socket_addrs();
        let addresses = addresses.map(|addresses| {
            let mut addresses: Vec<SocketAddr> = addresses.take(8).collect();
            // NAOqi listens on IPv4 only, unless told otherwise.
            addresses.sort_by_key(SocketAddr::is_ipv6);
            addresses.into()
        });
        let _ = commands.send(ClientCommand::Found(Found { link, addresses }));
        let _ = waker.wake();
    };
    let thread = std::thread::Builder::new().name("ztl-lookup".to_owned());
    let error = thread.spawn(look_up).err()?;
    Some(Found {
        link,
        addresses: Err(error),
    })
}

#[derive(Default)]
pub(super) struct Sockets {
    sockets: Table<LinkId, Socket>,
    last_token: usize,
    buffer: Vec<u8>,
}

struct Socket {
    stream: TcpStream,
    token: Token,
    /// Further addresses to try.
    others: VecDeque<SocketAddr>,
    connected: bool,
    writable: bool,
    readable: bool,
}

impl Sockets {
    /// Whether something is left to read.
    pub(super) fn is_readable(&self) -> bool {
        let mut sockets = self.sockets.values();
        sockets.any(|socket| socket.connected && socket.readable)
    }

    /// Remembers what the system has reported.
    pub(super) fn mark(&mut self, event: &mio::event::Event) {
        let mut sockets = self.sockets.values_mut();
        if let Some(socket) = sockets.find(|socket| socket.token == event.token()) {
            socket.writable |= event.is_writable();
            socket.readable |= event.is_readable() || event.is_read_closed() || event.is_error();
        }
    }

    /// Connects to the first of the addresses.
    pub(super) fn found(&mut self, found: Found, poll: &Poll, session: &mut Session, now: Instant) {
        // Given up meanwhile.
        if !session.links().any(|link| link == found.link) {
            return;
        }
        let connected = found
            .addresses
            .and_then(|addresses| self.connect(found.link, addresses, poll));
        if let Err(error) = connected {
            session.handle_closed(found.link, &error.to_string(), now);
        }
    }

    fn connect(
        &mut self,
        link: LinkId,
        mut addresses: VecDeque<SocketAddr>,
        poll: &Poll,
    ) -> io::Result<()> {
        let address = addresses
            .pop_front()
            .ok_or_else(|| io::Error::other("the name has no address"))?;
        let mut stream = TcpStream::connect(address)?;
        self.last_token = self.last_token.wrapping_add(1) % (usize::MAX - 1);
        let token = Token(self.last_token);
        let interests = Interest::READABLE | Interest::WRITABLE;
        poll.registry().register(&mut stream, token, interests)?;
        let socket = Socket {
            stream,
            token,
            others: addresses,
            connected: false,
            writable: false,
            readable: false,
        };
        self.sockets.insert(link, socket);
        Ok(())
    }

    /// Finds out about sockets that are connecting.
    pub(super) fn connect_further(&mut self, poll: &Poll, session: &mut Session, now: Instant) {
        let mut failed = Vec::new();
        for (link, socket) in self.sockets.iter_mut() {
            if socket.connected || !(socket.writable || socket.readable) {
                continue;
            }
            let error = socket.stream.take_error().unwrap_or_else(Some);
            match error.map_or_else(|| socket.stream.peer_addr(), Err) {
                Ok(peer) => {
                    socket.connected = true;
                    // Only a matter of speed.
                    let _ = socket.stream.set_nodelay(true);
                    session.handle_connected(*link, peer.ip(), now);
                }
                Err(error) if error.kind() == io::ErrorKind::NotConnected => {
                    socket.writable = false
                }
                Err(error) => failed.push((*link, error)),
            }
        }
        for (link, error) in failed {
            let others = self.sockets.remove(&link).map(|socket| socket.others);
            let others = others.filter(|others| !others.is_empty());
            let next = others.map_or(Err(error), |others| self.connect(link, others, poll));
            if let Err(error) = next {
                session.handle_closed(link, &error.to_string(), now);
            }
        }
    }

    /// Reads what has arrived, some of it if it is much.
    pub(super) fn read(&mut self, session: &mut Session, now: Instant) {
        self.buffer.resize(64 << 10, 0);
        let mut closed = Vec::new();
        for (link, socket) in self.sockets.iter_mut() {
            let mut taken = 0;
            while socket.connected && socket.readable && taken < TURN {
                match socket.stream.read(&mut self.buffer) {
                    Ok(0) => {
                        closed.push((*link, "the connection was closed".to_owned()));
                        break;
                    }
                    Ok(count) => {
                        taken += count;
                        let bytes = self.buffer.get(..count).unwrap_or_default();
                        session.handle_bytes(*link, bytes, now);
                    }
                    Err(error) => match error.kind() {
                        io::ErrorKind::WouldBlock => socket.readable = false,
                        io::ErrorKind::Interrupted => {}
                        _ => {
                            closed.push((*link, error.to_string()));
                            break;
                        }
                    },
                }
            }
        }
        for (link, reason) in closed {
            self.sockets.remove(&link);
            session.handle_closed(link, &reason, now);
        }
    }

    /// Writes what the session sends.
    pub(super) fn write(&mut self, session: &mut Session) {
        for (link, socket) in self.sockets.iter_mut() {
            while socket.connected && socket.writable {
                let Some(output) = session.output(*link).filter(|output| !output.is_empty()) else {
                    break;
                };
                match socket.stream.write(output) {
                    Ok(count) => drop(output.drain(..count.min(output.len()))),
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) => {
                        socket.writable = false;
                        // What the peer has sent before is read first; then reading fails, too.
                        socket.readable |= error.kind() != io::ErrorKind::WouldBlock;
                    }
                }
            }
        }
    }

    /// Closes a socket.
    pub(super) fn close(&mut self, link: LinkId) {
        self.sockets.remove(&link);
    }
}
