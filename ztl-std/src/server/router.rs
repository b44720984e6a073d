//! Receives requests and sends answers, over one of two transports.

use std::io;
use std::ops::Deref;
use std::time::Duration;

use tracing::debug;
use ztl_core::envelope::Envelope;
use ztl_core::reply::Reply;

use super::authenticator::{Authenticator, CurrentAccess, Sender};
use super::peers::{self, Peers};
use super::waker::is_wake;
use crate::keys::PublicKey;
use crate::log_targets::TASKS;
use crate::sockets;

/// Leads an answer back to its client.
#[derive(Debug)]
pub(super) enum ReturnPath {
    /// The ROUTER identity, the envelope, the empty delimiter.
    Libzmq(Vec<zmq::Message>),
    Own(peers::Path),
}

/// The content of a message.
pub(super) enum Content {
    Libzmq(zmq::Message),
    Own(Box<[u8]>),
}

impl Deref for Content {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Libzmq(message) => message,
            Self::Own(bytes) => bytes,
        }
    }
}

/// A request as it arrived.
pub(super) struct Request {
    pub(super) path: ReturnPath,
    pub(super) envelope: Option<Envelope>,
    /// The only frame after the delimiter; `None` if there are several.
    pub(super) content: Option<Content>,
    pub(super) sender: Sender,
}

/// What [`Router::receive`] found.
pub(super) enum Received {
    Request(Request),
    /// Something that woke the server's thread.
    Wake,
    /// A message that is dropped, for this reason.
    Dropped(&'static str),
}

/// The server's end of its connections.
pub(super) enum Router {
    Libzmq {
        socket: zmq::Socket,
        authenticator: Authenticator,
    },
    Own {
        peers: Peers,
        access: CurrentAccess,
    },
}

impl Router {
    /// Who may use the server.
    pub(super) const fn access(&self) -> &CurrentAccess {
        match self {
            Self::Libzmq { authenticator, .. } => authenticator.access(),
            Self::Own { access, .. } => access,
        }
    }

    /// Waits for a message at most for `longest`, or until the server is woken, and returns it.
    pub(super) fn wait(&mut self, longest: Duration) -> Result<Option<Received>, zmq::Error> {
        match self {
            Self::Libzmq { socket, .. } => {
                let millis = longest.as_micros().div_ceil(1000);
                let millis = i32::try_from(millis).unwrap_or(i32::MAX).min(3_600_000);
                socket.set_rcvtimeo(if longest == Duration::MAX { -1 } else { millis })?;
                self.receive_with(0)
            }
            Self::Own { peers, .. } => {
                let longest = (longest != Duration::MAX).then_some(longest);
                peers.wait(longest).map_err(as_zmq)?;
                self.receive()
            }
        }
    }

    /// The next message, if there is one.
    pub(super) fn receive(&mut self) -> Result<Option<Received>, zmq::Error> {
        self.receive_with(zmq::DONTWAIT)
    }

    fn receive_with(&mut self, flags: i32) -> Result<Option<Received>, zmq::Error> {
        match self {
            Self::Libzmq {
                socket,
                authenticator,
            } => receive(socket, authenticator, flags),
            Self::Own { peers, access } => Ok(next(peers, access)),
        }
    }

    /// Looks for messages without waiting.
    pub(super) fn look(&mut self) -> Result<Option<Received>, zmq::Error> {
        match self {
            Self::Libzmq { .. } => self.receive(),
            Self::Own { .. } => self.wait(Duration::ZERO),
        }
    }

    /// Sends an answer. It is dropped if its client is gone; libzmq also drops it if its queue is full.
    pub(super) fn answer(&mut self, path: ReturnPath, reply: &Reply<'_>) {
        let mut body = Vec::new();
        reply.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        match (self, path) {
            (Self::Libzmq { socket, .. }, ReturnPath::Libzmq(mut frames)) => {
                frames.push(body.as_slice().into());
                if let Err(cause) = sockets::send(socket, &frames) {
                    debug!(target: TASKS, "an answer was not taken: {}", cause.message());
                }
            }
            (Self::Own { peers, .. }, ReturnPath::Own(path)) => peers.answer(&path, &body),
            _ => {}
        }
    }
}

/// The next message of libzmq.
fn receive(
    socket: &zmq::Socket,
    authenticator: &Authenticator,
    flags: i32,
) -> Result<Option<Received>, zmq::Error> {
    let mut frames = Vec::new();
    let sender = loop {
        let mut frame = match socket.recv_msg(flags) {
            Ok(frame) => frame,
            // A signal: the rest of the message has arrived already.
            Err(zmq::Error::EINTR) if !frames.is_empty() => continue,
            Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => return Ok(None),
            Err(cause) => return Err(cause),
        };
        let sender = (!frame.get_more()).then(|| authenticator.sender(&mut frame));
        frames.push(frame);
        if let Some(sender) = sender {
            break sender;
        }
    };
    if is_wake(&frames) {
        return Ok(Some(Received::Wake));
    }
    let Some(sender) = sender else {
        return Ok(Some(Received::Dropped("of an unknown sender")));
    };
    // Identity, any envelope, an empty frame, then the body. Like a REP socket, drops a message without the
    // empty frame.
    let Some(delimiter) = frames.iter().position(|frame| frame.is_empty()) else {
        return Ok(Some(Received::Dropped("without a delimiter")));
    };
    let content = match frames.len() == delimiter + 2 {
        true => frames.pop().map(Content::Libzmq),
        false => None,
    };
    frames.truncate(delimiter + 1);
    let envelope = match frames.as_slice() {
        // A proxy puts its own frames before these two.
        [_identity, .., client, number, _delimiter] => Envelope::parse(client, number),
        _ => None,
    };
    Ok(Some(Received::Request(Request {
        path: ReturnPath::Libzmq(frames),
        envelope,
        content,
        sender,
    })))
}

/// The next message of our own connections.
fn next(peers: &mut Peers, access: &CurrentAccess) -> Option<Received> {
    let message =
        peers.next(&mut |address, key| access.admits(address, key.map(PublicKey::from_bytes)))?;
    let key = message.key.map(PublicKey::from_bytes);
    // The rules may have changed since the client connected.
    let Some(sender) = access.sender(message.from, key) else {
        return Some(Received::Dropped("of an unknown sender"));
    };
    let envelope = ztl_zmtp::envelope(&message.path.envelope);
    Some(Received::Request(Request {
        path: ReturnPath::Own(message.path),
        envelope,
        content: message.body.map(Content::Own),
        sender,
    }))
}

/// The error that libzmq would have returned.
fn as_zmq(error: io::Error) -> zmq::Error {
    match error.raw_os_error() {
        Some(number) => zmq::Error::from_raw(number),
        None => zmq::Error::EFAULT,
    }
}
