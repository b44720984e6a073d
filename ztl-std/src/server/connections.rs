//! How many connections a server has, as ZeroMQ's monitor tells it.

use std::cell::Cell;

use tracing::warn;

use super::LOG;

use crate::frames;

const MONITOR: &str = "inproc://connections";

/// Counts the connections of a socket.
pub(super) struct Connections {
    monitor: zmq::Socket,
    open: Cell<usize>,
    most: usize,
    /// Whether it was said that there are too many.
    said: Cell<bool>,
}

impl Connections {
    /// Of a socket that is to be bound afterwards; at most `most` are wanted.
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
            said: Cell::new(false),
        })
    }

    /// What is to be waited for: unread, its messages would stop ZeroMQ.
    pub(super) const fn socket(&self) -> &zmq::Socket {
        &self.monitor
    }

    /// Counts what has happened.
    pub(super) fn count(&self) {
        // Each is two frames: the event's number and a value, then the address.
        while let Ok(frames) = frames::receive(&self.monitor) {
            let event = frames.first().and_then(|frame| frame.first_chunk::<2>());
            let Some(event) = event.map(|event| u16::from_le_bytes(*event)) else {
                continue;
            };
            let open = self.open.get();
            if event == zmq::SocketEvent::ACCEPTED as u16 {
                self.open.set(open.saturating_add(1));
            } else {
                self.open.set(open.saturating_sub(1));
                self.said
                    .set(self.said.get() && self.open.get() >= self.most);
            }
        }
    }

    /// Whether one that asks to be let in, and is counted already, is too many; says so once.
    pub(super) fn are_too_many(&self) -> bool {
        self.count();
        let too_many = self.open.get() > self.most;
        if too_many && !self.said.replace(true) {
            let most = self.most;
            warn!(target: LOG, "There are {most} connections, as many as are allowed; more are not let in.");
        }
        too_many
    }
}
