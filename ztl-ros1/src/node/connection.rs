//! A connection of a node: its socket, and what waits on it.

use std::io;
use std::time::Instant;

use mio::net::TcpStream;

use super::net_error::{NetError, plain};
use super::outbox::Outbox;
use super::unacknowledged::{self, Ends};
use crate::uri::Address;

/// A connection of a node.
pub(super) struct Connection {
    pub(super) peer: Address,
    /// Missing while the host's name is looked up.
    pub(super) stream: Option<TcpStream>,
    /// The addresses of both ends, remembered: a connection that the system has closed has none.
    pub(super) ends: Option<Ends>,
    pub(super) outbox: Outbox,
    /// Close it once everything is sent.
    pub(super) closing: bool,
    pub(super) accepted: bool,
    pub(super) deadline: Option<Instant>,
    /// It is in the list of those that may be readable.
    pub(super) listed: bool,
    /// The other end has ended its stream. The system reports that once, perhaps with the last bytes.
    pub(super) ended: bool,
}

impl Connection {
    pub(super) fn failure(&self, error: &io::Error) -> NetError {
        let peer = self.peer.to_string();
        let (kind, error) = (error.kind(), plain(error));
        match kind {
            // The system has waited for what it sent to be acknowledged.
            io::ErrorKind::TimedOut if self.accepted || self.outbox.has_limit() => {
                NetError::Silent { peer }
            }
            // It may say why the network lost it.
            io::ErrorKind::HostUnreachable | io::ErrorKind::NetworkUnreachable if self.accepted => {
                NetError::Silent { peer }
            }
            io::ErrorKind::ConnectionRefused => NetError::Refused { peer },
            // The other end had closed it before.
            io::ErrorKind::BrokenPipe => NetError::Closed { peer },
            _ if self.accepted => NetError::Broken { peer, error },
            _ => NetError::Failed { peer, error },
        }
    }

    /// Whether everything was sent, and acknowledged if that is limited.
    pub(super) fn is_settled(&mut self, table: &mut unacknowledged::Table) -> bool {
        self.outbox.acknowledge(self.ends, table);
        self.outbox.is_settled()
    }
}
