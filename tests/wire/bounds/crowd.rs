//! Anonymous connections that are opened again and again.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// What a connection says first.
#[derive(Debug, Clone, Copy)]
pub(super) enum Says {
    Nothing,
    /// The greeting and the READY of a REQ socket.
    Null,
    /// The greeting of an encrypted client, and no HELLO.
    Garbage,
}

impl Says {
    fn bytes(self) -> Vec<u8> {
        let mut greeting = [0; 64];
        greeting[0] = 0xFF;
        greeting[9] = 0x7F;
        greeting[10] = 3;
        let (mechanism, rest): (_, &[u8]) = match self {
            Self::Nothing => return Vec::new(),
            Self::Null => (
                &b"NULL"[..],
                b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ",
            ),
            Self::Garbage => (
                &b"CURVE"[..],
                &[b"\x04\xc8\x05HELLO\x01\x00", &[7; 192][..]].concat(),
            ),
        };
        greeting[12..12 + mechanism.len()].copy_from_slice(mechanism);
        [&greeting[..], rest].concat()
    }
}

/// Opens a connection, which the server may close at any time.
pub(super) fn open(port: u16, says: Says) -> Option<TcpStream> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
    let _ = stream.write_all(&says.bytes());
    stream.set_nonblocking(true).ok()?;
    Some(stream)
}

/// Whether the server has closed a connection.
pub(super) fn is_closed(stream: &mut TcpStream) -> bool {
    loop {
        match stream.read(&mut [0; 512]) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) => return error.kind() != ErrorKind::WouldBlock,
        }
    }
}

/// Whether the server has taken a connection: it greets first, or closes it.
fn is_taken(stream: &TcpStream) -> bool {
    !matches!(stream.peek(&mut [0]), Err(error) if error.kind() == ErrorKind::WouldBlock)
}

/// Threads that open connections until this is dropped.
pub(super) struct Crowd {
    stop: Arc<AtomicBool>,
    opened: Arc<AtomicUsize>,
    threads: Vec<JoinHandle<()>>,
}

impl Crowd {
    /// Two threads keep `count` connections open: one that the server closes is opened again, and with `restless`, the
    /// oldest ones are closed and opened without end.
    pub(super) fn besiege(port: u16, count: usize, restless: bool) -> Self {
        let (stop, opened) = (
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicUsize::new(0)),
        );
        let thread = || {
            let (stop, opened) = (Arc::clone(&stop), Arc::clone(&opened));
            std::thread::spawn(move || {
                let mut streams = VecDeque::new();
                let mut kinds = [Says::Nothing, Says::Null, Says::Garbage]
                    .into_iter()
                    .cycle();
                while !stop.load(Ordering::SeqCst) {
                    if restless && streams.len() >= count / 2 {
                        streams.drain(..20);
                    }
                    streams.retain_mut(|stream| !is_closed(stream));
                    let start = Instant::now();
                    let mut is_pending = streams.len() < count / 2;
                    while streams.len() < count / 2 {
                        streams.extend(open(port, kinds.next().unwrap_or(Says::Nothing)));
                        opened.fetch_add(1, Ordering::SeqCst);
                    }
                    // Not faster than the server takes connections: those that do not fit into the system's queue wait for
                    // seconds, also a good client's, whatever the server does.
                    while is_pending && !stop.load(Ordering::SeqCst) {
                        std::thread::sleep(Duration::from_millis(1));
                        is_pending = !streams.back().is_none_or(is_taken);
                    }
                    // Leaves the server and its clients as much time as it took for the crowd.
                    std::thread::sleep(start.elapsed().max(Duration::from_millis(1)));
                }
            })
        };
        let threads = vec![thread(), thread()];
        Self {
            stop,
            opened,
            threads,
        }
    }

    /// How many connections were opened.
    pub(super) fn opened(&self) -> usize {
        self.opened.load(Ordering::SeqCst)
    }
}

impl Drop for Crowd {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}
