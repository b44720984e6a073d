//! A client's socket.

use std::io;
use std::sync::OnceLock;
use std::time::Duration;

use super::{NO_HANDSHAKE_LIMIT, io_error, sockets};
use crate::keys::{KeyPair, PublicKey};
use crate::transport::RETRY;

/// Most answers that wait to be read: one to the current request, and one that came too late.
const ANSWERS: i32 = 2;

/// A DEALER socket.
pub(crate) struct Dealer(zmq::Socket);

impl Dealer {
    /// Connects in the background. `keys` are our own and the server's; answers have at most `longest` bytes.
    pub(crate) fn connect(
        endpoint: &str,
        keys: Option<&(KeyPair, PublicKey)>,
        longest: usize,
    ) -> io::Result<Self> {
        /// All clients of a process share one thread of libzmq.
        static CONTEXT: OnceLock<zmq::Context> = OnceLock::new();
        sockets::check_port(endpoint).map_err(io_error)?;
        let context = CONTEXT.get_or_init(zmq::Context::new);
        open(context, endpoint, keys, longest)
            .map(Self)
            .map_err(io_error)
    }

    /// Whether a request can be sent within `limit`: the server is connected.
    pub(crate) fn can_send(&self, limit: Duration) -> io::Result<bool> {
        self.poll(zmq::POLLOUT, limit)
    }

    /// Whether a message arrives within `limit`.
    pub(crate) fn can_receive(&self, limit: Duration) -> io::Result<bool> {
        self.poll(zmq::POLLIN, limit)
    }

    fn poll(&self, events: zmq::PollEvents, limit: Duration) -> io::Result<bool> {
        let millis = i64::try_from(limit.as_micros().div_ceil(1000));
        match self.0.poll(events, millis.unwrap_or(i64::MAX)) {
            Ok(count) => Ok(count > 0),
            Err(zmq::Error::EINTR) => Ok(false),
            Err(cause) => Err(io_error(cause)),
        }
    }

    /// Sends a message: frames before the delimiter, and the one after it.
    pub(crate) fn send(&self, envelope: [&[u8]; 2], body: &[u8]) -> io::Result<()> {
        let [client, number] = envelope;
        sockets::send(&self.0, &[client, number, b"", body]).map_err(io_error)
    }

    /// The message that has arrived.
    pub(crate) fn receive(&self) -> io::Result<Vec<Vec<u8>>> {
        sockets::receive(&self.0).map_err(io_error)
    }
}

fn open(
    context: &zmq::Context,
    endpoint: &str,
    keys: Option<&(KeyPair, PublicKey)>,
    longest: usize,
) -> zmq::Result<zmq::Socket> {
    let socket = context.socket(zmq::DEALER)?;
    socket.set_linger(0)?;
    // Queues nothing for a server that is not there, which would act on it when it starts.
    socket.set_immediate(true)?;
    socket.set_maxmsgsize(i64::try_from(longest).unwrap_or(i64::MAX))?;
    // One request at a time is under way, so a server cannot fill the memory with answers.
    socket.set_rcvhwm(ANSWERS)?;
    // Clients do not all reconnect to a restarted server at the same moment.
    let millis = |pause: Duration| i32::try_from(pause.as_millis()).unwrap_or(i32::MAX);
    socket.set_reconnect_ivl(millis(RETRY.0))?;
    socket.set_reconnect_ivl_max(millis(RETRY.1))?;
    if let Some((own, server)) = keys {
        socket.set_curve_publickey(own.public().as_bytes())?;
        socket.set_curve_secretkey(own.secret())?;
        socket.set_curve_serverkey(server.as_bytes())?;
    } else {
        socket.set_handshake_ivl(NO_HANDSHAKE_LIMIT)?;
    }
    // RFC 6761: this name is this machine, even if the system has no hosts file. ZeroMQ would ask a name
    // server.
    match endpoint.strip_prefix("tcp://localhost:") {
        Some(port) => socket.connect(&format!("tcp://127.0.0.1:{port}"))?,
        None => socket.connect(endpoint)?,
    }
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_port_is_not_truncated() {
        assert!(Dealer::connect("tcp://localhost:65536", None, 1).is_err());
    }
}
