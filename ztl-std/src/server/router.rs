//! A server's ROUTER socket.

use std::cell::RefCell;

use tracing::debug;
use ztl_core::reply::Reply;

use super::authenticator::{Authenticator, Sender};
use super::memory::ReturnPath;
use crate::log_targets::TASKS;
use crate::sockets;

/// A message's frames, and its sender; `None` if its connection was not accepted.
pub(super) type Received = (Vec<zmq::Message>, Option<Sender>);

/// Frames that a client of this crate sends.
const FRAMES: usize = 5;

/// Most frame lists that are kept for reuse.
const SPARE: usize = 64;

/// Capacity in bytes that the body buffer keeps.
const KEPT: usize = 4096;

/// A ROUTER socket. Reuses buffers to avoid allocator contention.
pub(super) struct Router {
    socket: zmq::Socket,
    /// Frame lists of answered messages.
    spare: RefCell<Vec<ReturnPath>>,
    /// Buffer for the body of an answer.
    body: RefCell<Vec<u8>>,
}

impl Router {
    pub(super) const fn new(socket: zmq::Socket) -> Self {
        Self {
            socket,
            spare: RefCell::new(Vec::new()),
            body: RefCell::new(Vec::new()),
        }
    }

    /// Sets how many milliseconds a blocking [`receive`](Self::receive) waits; -1 means forever.
    pub(super) fn wait_at_most(&self, milliseconds: i32) -> Result<(), zmq::Error> {
        self.socket.set_rcvtimeo(milliseconds)
    }

    /// The next message; `None` if there is none.
    pub(super) fn receive(
        &self,
        authenticator: &Authenticator,
        flags: i32,
    ) -> Result<Option<Received>, zmq::Error> {
        let spare = self.spare.borrow_mut().pop();
        let mut message = spare.unwrap_or_else(|| Vec::with_capacity(FRAMES));
        loop {
            let mut frame = match self.socket.recv_msg(flags) {
                Ok(frame) => frame,
                // A signal: the rest of the message has arrived already.
                Err(zmq::Error::EINTR) if !message.is_empty() => continue,
                Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => {
                    self.keep(message);
                    return Ok(None);
                }
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
        let mut body = self.body.borrow_mut();
        body.clear();
        reply.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        path.push(body.as_slice().into());
        body.shrink_to(KEPT);
        drop(body);
        if let Err(cause) = sockets::send(&self.socket, &path) {
            debug!(target: TASKS, "an answer was not taken: {}", cause.message());
        }
        path.clear();
        self.keep(path);
    }

    /// Keeps a frame list for the next message.
    fn keep(&self, list: ReturnPath) {
        let mut spare = self.spare.borrow_mut();
        if spare.len() < SPARE && list.capacity() <= 2 * FRAMES {
            spare.push(list);
        }
    }
}
