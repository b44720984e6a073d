//! ZMTP, the protocol between ZeroMQ sockets: a client with libzmq talks to the device directly.
//!
//! It requires a *reliable* stream: TCP, or USB behind `socat`. A bare UART neither detects errors nor
//! repeats lost bytes; use the [link](crate::link) and a gateway there. `docs/zmtp.md` cites the clause of
//! the specification for each behaviour.
//!
//! | to | use |
//! |---|---|
//! | serve tasks | [`Server`]: components, tasks and a fixed number of clients |
//! | run one connection, of either side | [`Connection`], as a [`Rep`], [`Req`] or [`Dealer`] |
//! | serve on a serial port | [`Line`], which detects when a new client begins |
//!
//! This module does no I/O, does not allocate, and reads no clock.
//!
//! # Over TCP
//!
//! Each client has a slot in the server and a socket of the network stack. The following is a complete main
//! loop; `examples/firmware` runs it with `smoltcp`, `examples/zmtp.rs` with threads.
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
//!         // Bytes not taken stay in the socket until a reply has been sent.
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
//!         // Close only after sending: the last bytes may tell the reason.
//!         if !server.is_open(peer) {
//!             socket.close();
//!         }
//!     }
//!     // After sending, there may be more to send or to take. Received bytes also wake it.
//!     if sent == 0 {
//!         sleep_until(server.poll_timeout(now));
//!     }
//! }
//! # }
//! ```
//!
//! Enable the stack's keep-alive. Otherwise a client that was switched off is never detected and keeps its
//! slot.

mod line;
mod server;

pub use line::Line;
pub use server::{Peer, Server};
pub use ztl_zmtp::{
    Connection, Content, Dealer, Fault, Frames, HANDSHAKE, Message, Rep, Req, SKIPPED, Socket,
};

#[cfg(test)]
mod tests;
