//! ZMTP, the protocol between ZeroMQ sockets: a client with libzmq talks to this device with nothing in
//! between.
//!
//! For a stream that is *reliable*: TCP, or USB behind `socat`. A bare UART has no check for errors and
//! no way to repeat what was lost: there the [link](crate::link) belongs, with a gateway. `docs/zmtp.md` cites
//! the clauses of the specification that each behaviour comes from.
//!
//! | for | look at |
//! |---|---|
//! | a device that carries out tasks | [`Server`]: components, tasks and a fixed number of clients |
//! | one connection, of either side | [`Connection`], as a [`Rep`], [`Req`] or [`Dealer`] |
//! | a serial port | [`Line`], which notices that another client has begun |
//!
//! None of it does I/O, allocates, or reads a clock.
//!
//! # Over TCP
//!
//! Each client has a place in the server and a socket of the stack. This is all that a main loop does; `examples/firmware`
//! has it with `smoltcp`, `examples/zmtp.rs` with threads.
//!
//! ```no_run
//! use ztl_mcu::zmtp::{Peer, Server};
//! # use ztl_mcu::{Components, Instant};
//! # struct Socket;
//! # impl Socket {
//! #     fn has_just_connected(&self) -> bool { true }
//! #     fn has_just_gone(&self) -> bool { true }
//! #     fn received(&self) -> &[u8] { &[] }
//! #     fn drop_received(&mut self, _: usize) {}
//! #     fn send(&mut self, _: &[u8]) -> usize { 0 }
//! #     fn close(&mut self) {}
//! # }
//! # fn clock() -> Instant { Instant::ZERO }
//! # fn sleep_until(_: Instant) {}
//! # fn firmware<C: Components>(mut server: Server<'_, C, 2, 4, 256, 4>, mut sockets: [Socket; 2]) {
//!
//! loop {
//!     let now = clock();
//!     for (socket, peer) in sockets.iter_mut().zip((0..).map(Peer)) {
//!         if socket.has_just_connected() {
//!             server.open(now, peer);
//!         }
//!         // What it does not take stays in the socket: an answer has to go out first.
//!         let taken = server.handle_bytes(now, peer, socket.received());
//!         socket.drop_received(taken);
//!         if socket.has_just_gone() {
//!             server.close(peer);
//!         }
//!     }
//!     server.handle_timeout(now);
//!     let mut sent = 0;
//!     for (socket, peer) in sockets.iter_mut().zip((0..).map(Peer)) {
//!         let count = socket.send(server.transmit_buf(peer));
//!         server.consume(peer, count);
//!         sent += count;
//!         // Only now: with its last bytes it may have said why.
//!         if !server.is_open(peer) {
//!             socket.close();
//!         }
//!     }
//!     // Once something was sent there may be more to send, or to take. Bytes that arrive wake it too.
//!     if sent == 0 {
//!         sleep_until(server.poll_timeout(now));
//!     }
//! }
//! # }
//! ```
//!
//! Turn on the stack's keep-alive: nothing else tells that a client was switched off, and it would keep its place.

mod connection;
mod line;
mod message;
mod receive;
mod server;
mod wire;

pub use connection::{Connection, Fault};
pub use line::Line;
pub use message::{Content, Frames, Message};
pub use server::{Peer, Server};
pub use wire::{Dealer, Rep, Req, Socket};

/// How long a peer may take from the beginning of a connection to its `READY`.
pub const HANDSHAKE: core::time::Duration = core::time::Duration::from_secs(5);

/// The longest frame that is skipped, and answered, when it does not fit; after a longer one the
/// connection is closed.
pub const SKIPPED: u32 = 65536;

#[cfg(test)]
mod tests;
