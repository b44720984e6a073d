//! A server's socket: requests come as ZeroMQ's messages, answers go the way that they came.

use std::cell::RefCell;

use tracing::debug;
use ztl_core::reply::Reply;

use super::LOG;
use super::access::{Door, Who};
use super::memory::Peer;
use crate::frames;

/// A message's frames, and who sent it, unless that is not known.
pub(super) type Received = (Vec<zmq::Message>, Option<Who>);

/// As many frames as a client of ours sends.
const FRAMES: usize = 5;

/// How many lists of frames are kept to be used again.
const SPARE: usize = 64;

/// Room for a body that is kept, in bytes.
const KEPT: usize = 4096;

/// A ROUTER socket. It uses again what a message needs: of many requests that come together, each
/// would else have its memory from where the others' is, and give it back there.
pub(super) struct Router {
    socket: zmq::Socket,
    /// Lists of frames whose message was answered.
    spare: RefCell<Vec<Peer>>,
    /// An answer's body, while it is written.
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

    /// How many milliseconds a [`receive`](Self::receive) waits that may; -1 is for ever.
    pub(super) fn wait_at_most(&self, milliseconds: i32) -> Result<(), zmq::Error> {
        self.socket.set_rcvtimeo(milliseconds)
    }

    /// The next message, and who sent it, unless that is not known; `None` when there is none.
    pub(super) fn receive(&self, door: &Door, flags: i32) -> Result<Option<Received>, zmq::Error> {
        let spare = self.spare.borrow_mut().pop();
        let mut message = spare.unwrap_or_else(|| Vec::with_capacity(FRAMES));
        loop {
            let mut frame = match self.socket.recv_msg(flags) {
                Ok(frame) => frame,
                // A signal in the middle costs nothing: the rest is there already.
                Err(zmq::Error::EINTR) if !message.is_empty() => continue,
                Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => {
                    self.keep(message);
                    return Ok(None);
                }
                Err(cause) => return Err(cause),
            };
            let who = (!frame.get_more()).then(|| door.who(&mut frame));
            message.push(frame);
            if let Some(who) = who {
                return Ok(Some((message, who)));
            }
        }
    }

    /// Sends an answer, or drops it when its client is gone or takes nothing.
    pub(super) fn answer(&self, mut peer: Peer, reply: &Reply<'_>) {
        let mut body = self.body.borrow_mut();
        body.clear();
        reply.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        peer.push(body.as_slice().into());
        body.shrink_to(KEPT);
        drop(body);
        if let Err(cause) = frames::send(&self.socket, &peer) {
            debug!(target: LOG, "an answer was not taken: {}", cause.message());
        }
        peer.clear();
        self.keep(peer);
    }

    /// Keeps a list for the next message.
    fn keep(&self, list: Peer) {
        let mut spare = self.spare.borrow_mut();
        if spare.len() < SPARE && list.capacity() <= 2 * FRAMES {
            spare.push(list);
        }
    }
}
