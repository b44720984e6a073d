//! ZMTP without libzmq: sessions of [`ztl_zmtp`] on non-blocking sockets.
//!
//! [`Peers`](peers::Peers) are the connections of a server, [`Dialer`](dialer::Dialer) is the one of a client.

pub(crate) mod dialer;
pub(crate) mod peers;
#[cfg(feature = "publish")]
pub(crate) mod publisher;
mod sockets;

pub(crate) use sockets::Endpoint;

/// An endpoint that no other test has, so that a server can follow another one there.
#[cfg(all(test, unix))]
pub(crate) fn own_endpoint() -> String {
    let name = format!("ztl-{}", crate::random::number());
    format!("ipc://{}", std::env::temp_dir().join(name).display())
}
