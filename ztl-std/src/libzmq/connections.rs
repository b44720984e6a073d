//! Counts a server's connections by ZeroMQ's socket monitor.

use std::cell::Cell;

use tracing::warn;

use super::sockets;
use crate::log_targets::TASKS;

const MONITOR: &str = "inproc://connections";

/// The number of connections of a socket.
pub(super) struct Connections {
    monitor: zmq::Socket,
    open: Cell<usize>,
    most: usize,
    /// Whether the limit was logged since it was last reached.
    logged: Cell<bool>,
}

impl Connections {
    /// Counts those of a socket that is bound afterwards; `most` is the limit.
    pub(super) fn of(
        socket: &zmq::Socket,
        context: &zmq::Context,
        most: usize,
    ) -> Result<Self, zmq::Error> {
        let events = zmq::SocketEvent::ACCEPTED as i32 | zmq::SocketEvent::DISCONNECTED as i32;
        socket.monitor(MONITOR, events)?;
        let monitor = context.socket(zmq::PAIR)?;
        monitor.set_linger(0)?;
        monitor.connect(MONITOR)?;
        Ok(Self {
            monitor,
            open: Cell::new(0),
            most,
            logged: Cell::new(false),
        })
    }

    /// The socket to poll. ZeroMQ stalls if its events are not read.
    pub(super) const fn socket(&self) -> &zmq::Socket {
        &self.monitor
    }

    /// Reads all pending events.
    pub(super) fn count(&self) {
        // Each is two frames: the event's number and a value, then the address.
        while let Ok(frames) = sockets::receive(&self.monitor) {
            let event = frames.first().and_then(|frame| frame.first_chunk::<2>());
            let Some(event) = event.map(|event| u16::from_le_bytes(*event)) else {
                continue;
            };
            let open = self.open.get();
            if event == zmq::SocketEvent::ACCEPTED as u16 {
                self.open.set(open.saturating_add(1));
            } else {
                self.open.set(open.saturating_sub(1));
                let full = self.open.get() >= self.most;
                self.logged.set(self.logged.get() && full);
            }
        }
    }

    /// Whether the newest connection, which is already counted, exceeds the limit. Logs it once.
    pub(super) fn are_too_many(&self) -> bool {
        self.count();
        let too_many = self.open.get() > self.most;
        if too_many && !self.logged.replace(true) {
            let most = self.most;
            warn!(target: TASKS, "The limit of {most} connections is reached; further ones are rejected.");
        }
        too_many
    }
}
