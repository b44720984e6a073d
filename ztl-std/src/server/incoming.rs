//! Requests as they arrive, and the way back to their clients.

use std::ops::Deref;

use ztl_core::envelope::Envelope;

use super::access::Sender;
use crate::native::peers::PeerId;

/// Leads an answer back to its client.
#[derive(Debug)]
pub(crate) enum ReturnPath {
    /// The connection, and the frames before the content.
    Native(PeerId, Box<[u8]>),
    /// The ROUTER identity, the envelope, the empty delimiter.
    #[cfg(feature = "libzmq")]
    Libzmq(Vec<zmq::Message>),
}

impl ReturnPath {
    /// The number of its connection; 0 with libzmq, which does not tell it.
    pub(crate) const fn connection(&self) -> u64 {
        match self {
            Self::Native(peer, _) => peer.number(),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(_) => 0,
        }
    }
}

/// The content of a message.
pub(crate) enum Content {
    Native(Box<[u8]>),
    #[cfg(feature = "libzmq")]
    Libzmq(zmq::Message),
}

impl Deref for Content {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Native(bytes) => bytes,
            #[cfg(feature = "libzmq")]
            Self::Libzmq(message) => message,
        }
    }
}

/// A request as it arrived.
pub(crate) struct Request {
    pub(crate) path: ReturnPath,
    pub(crate) envelope: Option<Envelope>,
    /// The only frame after the delimiter; `None` if there are several.
    pub(crate) content: Option<Content>,
    pub(crate) sender: Sender,
}

/// What the router found when it looked for requests.
pub(crate) enum Received {
    Request(Request),
    /// Something that woke the server's thread.
    #[cfg(feature = "libzmq")]
    Wake,
    /// A message that is dropped, for this reason.
    Dropped(&'static str),
}
