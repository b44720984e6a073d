//! ZMTP by libzmq: the fallback, and a second opinion.

pub(crate) mod authenticator;
pub(crate) mod client;
mod connections;
pub(crate) mod server;
pub(crate) mod sockets;

use std::io;

/// No limit for the handshake, where peers older than ZMTP 3.0 may connect: libzmq 4.3.4 forgets to end its timer for
/// them, and would close their connections after that time, with any answer under way.
const NO_HANDSHAKE_LIMIT: i32 = 0;

/// Whether this libzmq can encrypt.
pub(crate) fn can_encrypt() -> bool {
    zmq::has("curve") == Some(true)
}

/// The system's error behind one of libzmq.
pub(crate) fn io_error(cause: zmq::Error) -> io::Error {
    /// libzmq's own errors begin here.
    const OWN: i32 = 156_384_712;
    match cause.to_raw() {
        number if number < OWN => io::Error::from_raw_os_error(number),
        _ => io::Error::other(cause.message()),
    }
}
