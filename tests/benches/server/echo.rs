//! The least that a server does for each request: a loop around epoll that sends back the bytes it reads.

use std::io::{ErrorKind, Read, Write};

use mio::net::{TcpListener, TcpStream};
use mio::{Events, Interest, Poll, Token};
use ztl_zmtp::{GREETING, Router, Socket};

const LISTENER: Token = Token(usize::MAX);

struct Peer {
    stream: TcpStream,
    /// Its greeting and READY, until they are complete.
    greeting: Vec<u8>,
    is_ready: bool,
}

/// Answers every request until it is killed.
pub(crate) fn serve() {
    let mut listener = TcpListener::bind("127.0.0.1:0".parse().unwrap()).expect("a port");
    println!("tcp://{}", listener.local_addr().expect("bound"));
    let mut poll = Poll::new().expect("a poll");
    let registry = poll.registry().try_clone().expect("a file");
    registry
        .register(&mut listener, LISTENER, Interest::READABLE)
        .expect("a file");
    let mut events = Events::with_capacity(1024);
    let mut peers: Vec<Option<Peer>> = Vec::new();
    let mut bytes = vec![0; 64 * 1024];
    loop {
        poll.poll(&mut events, None).expect("to wait");
        for event in &events {
            if event.token() == LISTENER {
                while let Ok((mut stream, _)) = listener.accept() {
                    stream.set_nodelay(true).expect("an option");
                    registry
                        .register(&mut stream, Token(peers.len()), Interest::READABLE)
                        .expect("a file");
                    stream.write_all(GREETING).expect("room");
                    stream.write_all(Router::READY).expect("room");
                    peers.push(Some(Peer {
                        stream,
                        greeting: Vec::new(),
                        is_ready: false,
                    }));
                }
            } else if !answer(&mut peers[event.token().0], &mut bytes) {
                peers[event.token().0] = None;
            }
        }
    }
}

/// Returns whether the peer is still there.
fn answer(peer: &mut Option<Peer>, bytes: &mut [u8]) -> bool {
    let Some(peer) = peer else {
        return false;
    };
    match peer.stream.read(bytes) {
        Ok(0) => false,
        // So little always has room.
        Ok(count) if peer.is_ready => peer.stream.write_all(&bytes[..count]).is_ok(),
        Ok(count) => {
            peer.greeting.extend_from_slice(&bytes[..count]);
            let ready = peer.greeting.get(GREETING.len()..).unwrap_or_default();
            // A command of so many bytes.
            let [4, length, rest @ ..] = ready else {
                return true;
            };
            let Some((_, request)) = rest.split_at_checked(usize::from(*length)) else {
                return true;
            };
            peer.is_ready = true;
            peer.stream.write_all(request).is_ok()
        }
        Err(error) => error.kind() == ErrorKind::WouldBlock,
    }
}
