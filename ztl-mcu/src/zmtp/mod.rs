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
