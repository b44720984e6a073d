//! Receives requests and sends answers, over one of two transports.

use std::io;
use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use tracing::warn;
use ztl_core::reply::Reply;
use ztl_zmtp::session::Security;
use ztl_zmtp::{Router as RouterType, curve};

use super::access::{Access, CurrentAccess};
use super::bind::{BindError, group, not_here};
use super::incoming::{Content, Received, Request, ReturnPath};
use super::limits::Limits;
use super::waker::Signal;
use crate::keys::PublicKey;
#[cfg(feature = "libzmq")]
use crate::libzmq::server::RouterSocket;
use crate::log_targets::TASKS;
use crate::native::Endpoint;
use crate::native::peers::{Peers, Rules};
use crate::random;
use crate::transport::Transport;

/// The server's end of its connections.
pub(crate) enum Router {
    Native {
        peers: Box<Peers<RouterType>>,
        access: CurrentAccess,
    },
    #[cfg(feature = "libzmq")]
    Libzmq(RouterSocket),
}

impl Router {
    /// Binds; also returns the endpoint, with the port that was chosen, and what wakes the thread.
    pub(crate) fn bind(
        transport: Transport,
        access: Access,
        limits: Limits,
        endpoint: &str,
    ) -> Result<(Self, String, Signal), BindError> {
        match transport {
            Transport::Native => {
                let rules = rules(&access, &limits);
                let access = CurrentAccess::new(access);
                let failed = |error| BindError::at_endpoint(endpoint, &error);
                let peers = Box::new(Peers::bind(&to_bind(endpoint)?, rules).map_err(failed)?);
                let bound = peers.endpoint().map_err(failed)?;
                let signal = Signal::Native(peers.waker().map_err(failed)?);
                Ok((Self::Native { peers, access }, bound, signal))
            }
            #[cfg(feature = "libzmq")]
            Transport::Libzmq => {
                accessible(endpoint)?;
                let (router, bound, waking) = RouterSocket::bind(access, limits, endpoint)?;
                Ok((Self::Libzmq(router), bound, Signal::Libzmq(waking)))
            }
        }
    }

    /// Who may use the server.
    pub(super) const fn access(&self) -> &CurrentAccess {
        match self {
            Self::Native { access, .. } => access,
            #[cfg(feature = "libzmq")]
            Self::Libzmq(router) => router.access(),
        }
    }

    /// Waits for a message at most for `longest`, or until the server is woken, and returns it.
    pub(crate) fn wait(&mut self, longest: Duration) -> io::Result<Option<Received>> {
        match self {
            Self::Native { peers, .. } => {
                let longest = (longest != Duration::MAX).then_some(longest);
                peers.wait(longest)?;
                self.receive()
            }
            #[cfg(feature = "libzmq")]
            Self::Libzmq(router) => router.wait(longest),
        }
    }

    /// The next message, if there is one.
    pub(crate) fn receive(&mut self) -> io::Result<Option<Received>> {
        match self {
            Self::Native { peers, access } => Ok(next(peers, access)),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(router) => router.look(),
        }
    }

    /// Looks for messages without waiting.
    pub(crate) fn look(&mut self) -> io::Result<Option<Received>> {
        match self {
            Self::Native { .. } => self.wait(Duration::ZERO),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(_) => self.receive(),
        }
    }

    /// Sends an answer. It is dropped if its client is gone; libzmq also drops it if its queue is full.
    pub(super) fn answer(&mut self, path: ReturnPath, reply: &Reply<'_>) {
        let mut body = Vec::new();
        reply.put(&mut |bytes: &[u8]| body.extend_from_slice(bytes));
        self.send(path, &body);
    }

    /// As [`answer`](Self::answer), for a body that is complete.
    pub(crate) fn send(&mut self, path: ReturnPath, body: &[u8]) {
        match (self, path) {
            (Self::Native { peers, .. }, ReturnPath::Native(peer, envelope)) => {
                peers.send(peer, &envelope, body);
            }
            #[cfg(feature = "libzmq")]
            (Self::Libzmq(router), ReturnPath::Libzmq(frames)) => router.answer(frames, body),
            #[cfg(feature = "libzmq")]
            _ => {}
        }
    }
}

/// Refuses an address that the system binds, although no client can connect to it.
fn accessible(endpoint: &str) -> Result<(), BindError> {
    let parsed = Endpoint::parse(endpoint).ok();
    let Some(address) = parsed.and_then(|parsed| parsed.to_bind()) else {
        return Ok(());
    };
    let kind = match address.ip().to_canonical() {
        address if address.is_multicast() => "multicast",
        IpAddr::V4(Ipv4Addr::BROADCAST) => "broadcast",
        _ => return Ok(()),
    };
    Err(BindError::Endpoint {
        endpoint: endpoint.to_owned(),
        why: group(&address.ip(), kind),
    })
}

/// An endpoint to listen at.
pub(crate) fn to_bind(endpoint: &str) -> Result<Endpoint, BindError> {
    let invalid = |why| BindError::Endpoint {
        endpoint: endpoint.to_owned(),
        why,
    };
    let parsed = Endpoint::parse(endpoint).map_err(invalid)?;
    accessible(endpoint)?;
    match &parsed {
        Endpoint::Tcp { host, .. } if parsed.to_bind().is_none() => Err(invalid(not_here(host))),
        _ => Ok(parsed),
    }
}

/// After this time, an idle connection of a server without keys may make room for another (docs/limits.md).
const IDLE: Duration = Duration::from_secs(60);

/// What applies to each connection of a server.
pub(crate) fn rules(access: &Access, limits: &Limits) -> Rules {
    let (connections, warning) = limits.possible_connections();
    if let Some(warning) = warning {
        warn!(target: TASKS, "{warning}");
    }
    let keys = access
        .keys()
        .map(|keys| curve::Keys::server(*keys.secret(), random::secret));
    Rules {
        security: keys.map_or(Security::Null, Security::Curve),
        message: limits.longest_message(),
        connections,
        handshake: limits.handshake,
        idle: IDLE,
        memory: limits.buffers(),
    }
}

/// The next message of our own connections.
fn next(peers: &mut Peers<RouterType>, access: &CurrentAccess) -> Option<Received> {
    let message =
        peers.next(&mut |address, key| access.admits(address, key.map(PublicKey::from_bytes)))?;
    let key = message.key.map(PublicKey::from_bytes);
    // The rules may have changed since the client connected.
    let Some(sender) = access.sender(message.from, key) else {
        return Some(Received::Dropped("of an unknown sender"));
    };
    let Some(frames) = message.envelope else {
        return Some(Received::Dropped("without a delimiter"));
    };
    let envelope = ztl_zmtp::envelope(&frames);
    Some(Received::Request(Request {
        path: ReturnPath::Native(message.peer, frames),
        envelope,
        content: message.body.map(Content::Native),
        sender,
    }))
}
