//! One of many connections of a server or client, on a machine with a heap.
//!
//! Each connection has two halves, so that a message can be answered while it is read: [`Inbound`] makes messages of
//! received bytes, [`Outbound`] holds bytes to send. Neither does I/O.
//!
//! Memory: an idle connection holds no buffer. Before the handshake is complete a peer can make it hold at most
//! [`BEFORE`] bytes, after that a message of the chosen length, counted with the headers of all its frames.

mod frames;
mod inbound;
mod obstacle;
mod outbound;
mod security;

pub use frames::Message;
#[cfg(feature = "curve")]
pub(crate) use frames::put_header;
pub use inbound::{Inbound, Stage, Step};
pub use obstacle::Obstacle;
pub use outbound::Outbound;
pub use security::Security;

/// The most bytes that are held for a peer before the handshake is complete.
pub const BEFORE: usize = 1024;

/// What frames around a message's body may take: routing ids of proxies, our envelope, and headers.
pub const ENVELOPES: usize = 1024;

#[cfg(test)]
mod tests;
