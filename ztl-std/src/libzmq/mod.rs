//! ZMTP by libzmq: the fallback, and a second opinion.

pub(crate) mod authenticator;
pub(crate) mod client;
mod connections;
pub(crate) mod server;
pub(crate) mod sockets;

use std::io;

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
