//! A client's socket, over one of two transports.

use std::io;
use std::time::Duration;

use ztl_core::envelope::Envelope;
use ztl_zmtp::curve;
use ztl_zmtp::session::{Obstacle, Security};

use crate::keys::{KeyPair, PublicKey};
#[cfg(feature = "libzmq")]
use crate::libzmq::client::Dealer;
use crate::native::Endpoint;
use crate::native::dialer::Dialer;
use crate::random;
use crate::transport::Transport;

/// A socket for one request at a time.
pub(super) enum Socket {
    Native(Box<Dialer>),
    #[cfg(feature = "libzmq")]
    Libzmq(Dealer),
}

impl Socket {
    /// Connects in the background. `keys` are our own and the server's; answers have at most `longest` bytes.
    pub(super) fn open(
        transport: Transport,
        endpoint: &str,
        keys: Option<&(KeyPair, PublicKey)>,
        longest: usize,
    ) -> io::Result<Self> {
        match transport {
            Transport::Native => {
                let endpoint = Endpoint::parse(endpoint)
                    .map_err(|why| io::Error::new(io::ErrorKind::InvalidInput, why))?;
                let keys = keys.map(|(own, server)| {
                    curve::Keys::client(*own.secret(), *server.as_bytes(), random::secret)
                });
                let security = keys.map_or(Security::Null, Security::Curve);
                let dialer = Dialer::new(endpoint, security, longest)?;
                Ok(Self::Native(Box::new(dialer)))
            }
            #[cfg(feature = "libzmq")]
            Transport::Libzmq => Dealer::connect(endpoint, keys, longest).map(Self::Libzmq),
        }
    }

    /// Whether a request can be sent within `limit`: the server is connected.
    pub(super) fn can_send(&mut self, limit: Duration) -> io::Result<bool> {
        match self {
            Self::Native(dialer) => dialer.can_send(limit),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(socket) => socket.can_send(limit),
        }
    }

    /// What ended the last attempt to connect. libzmq does not tell it.
    pub(super) const fn obstacle(&self) -> Option<Obstacle> {
        match self {
            Self::Native(dialer) => dialer.obstacle(),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(_) => None,
        }
    }

    /// How many connections were lost. libzmq does not tell it.
    pub(super) const fn lost(&self) -> u64 {
        match self {
            Self::Native(dialer) => dialer.lost(),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(_) => 0,
        }
    }

    /// Whether closing the connection discards what the system has not delivered yet. libzmq cannot do that.
    pub(super) fn discard_unsent(&mut self, on: bool) {
        match self {
            Self::Native(dialer) => dialer.discard_unsent(on),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(_) => {}
        }
    }

    /// Whether a message arrives within `limit`.
    pub(super) fn can_receive(&mut self, limit: Duration) -> io::Result<bool> {
        match self {
            Self::Native(dialer) => dialer.can_receive(limit),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(socket) => socket.can_receive(limit),
        }
    }

    /// Sends a request.
    pub(super) fn send(&mut self, envelope: Envelope, body: &[u8]) -> io::Result<()> {
        let (client, number) = envelope.frames();
        match self {
            Self::Native(dialer) => {
                dialer.send(&[&client, &number], body);
                Ok(())
            }
            #[cfg(feature = "libzmq")]
            Self::Libzmq(socket) => socket.send([&client, &number], body),
        }
    }

    /// The message that has arrived.
    pub(super) fn receive(&mut self) -> io::Result<Vec<Vec<u8>>> {
        match self {
            Self::Native(dialer) => dialer
                .receive()
                .ok_or_else(|| io::ErrorKind::WouldBlock.into()),
            #[cfg(feature = "libzmq")]
            Self::Libzmq(socket) => socket.receive(),
        }
    }
}
