//! A server's ROUTER socket.

use tracing::debug;
use ztl_core::reply::Reply;

use super::authenticator::{Authenticator, Sender};
use super::memory::ReturnPath;
use crate::log_targets::TASKS;
use crate::sockets;

/// A message's frames, and its sender; `None` if its connection was not accepted.
pub(super) type Received = (Vec<zmq::Message>, Option<Sender>);

/// A ROUTER socket.
pub(super) struct Router(zmq::Socket);

impl Router {
    pub(super) const fn new(socket: zmq::Socket) -> Self {
        Self(socket)
    }

    /// Sets how many milliseconds a blocking [`receive`](Self::receive) waits; -1 means forever.
    pub(super) fn wait_at_most(&self, milliseconds: i32) -> Result<(), zmq::Error> {
        self.0.set_rcvtimeo(milliseconds)
    }

    /// The next message; `None` if there is none.
    pub(super) fn receive(
        &self,
        authenticator: &Authenticator,
        flags: i32,
    ) -> Result<Option<Received>, zmq::Error> {
        let mut message = Vec::new();
        loop {
            let mut frame = match self.0.recv_msg(flags) {
                Ok(frame) => frame,
                // A signal: the rest of the message has arrived already.
                Err(zmq::Error::EINTR) if !message.is_empty() => continue,
                Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => return Ok(None),
                Err(cause) => return Err(cause),
            };
            let sender = (!frame.get_more()).then(|| authenticator.sender(&mut frame));
            message.push(frame);
            if let Some(sender) = sender {
                return Ok(Some((message, sender)));
            }
        }
    }

    /// Sends an answer; drops it if its client is gone or its queue is full.
    pub(super) fn answer(&self, mut path: ReturnPath, reply: &Reply<'_>) {
        let mut body = Vec::new();
        reply.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        path.push(body.as_slice().into());
        if let Err(cause) = sockets::send(&self.0, &path) {
            debug!(target: TASKS, "a reply could not be sent: {}", cause.message());
        }
    }
}
