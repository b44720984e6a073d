//! A client's socket, of either transport.

use std::io;
use std::time::Duration;

use ztl_core::envelope::Envelope;

use super::stream::Stream;
use crate::sockets;

/// A socket for one request at a time.
pub(super) enum Socket {
    Libzmq(zmq::Socket),
    Own(Box<Stream>),
}

impl Socket {
    /// Whether a request can be sent within `limit`: the server is connected.
    pub(super) fn can_send(&mut self, limit: Duration) -> Result<bool, zmq::Error> {
        match self {
            Self::Libzmq(socket) => poll(socket, zmq::POLLOUT, limit),
            Self::Own(stream) => stream.can_send(limit).map_err(|error| as_zmq(&error)),
        }
    }

    /// Whether a message arrives within `limit`.
    pub(super) fn can_receive(&mut self, limit: Duration) -> Result<bool, zmq::Error> {
        match self {
            Self::Libzmq(socket) => poll(socket, zmq::POLLIN, limit),
            Self::Own(stream) => stream.can_receive(limit).map_err(|error| as_zmq(&error)),
        }
    }

    /// Sends a request.
    pub(super) fn send(&mut self, envelope: Envelope, body: &[u8]) -> Result<(), zmq::Error> {
        let (client, number) = envelope.frames();
        match self {
            Self::Libzmq(socket) => {
                let frames: [&[u8]; 4] = [&client, &number, b"", body];
                sockets::send(socket, &frames)
            }
            Self::Own(stream) => {
                stream.send(&[&client, &number], body);
                Ok(())
            }
        }
    }

    /// The message that has arrived.
    pub(super) fn receive(&mut self) -> Result<Vec<Vec<u8>>, zmq::Error> {
        match self {
            Self::Libzmq(socket) => sockets::receive(socket),
            Self::Own(stream) => stream.receive().ok_or(zmq::Error::EAGAIN),
        }
    }
}

fn poll(
    socket: &zmq::Socket,
    events: zmq::PollEvents,
    limit: Duration,
) -> Result<bool, zmq::Error> {
    let millis = i64::try_from(limit.as_micros().div_ceil(1000));
    match socket.poll(events, millis.unwrap_or(i64::MAX)) {
        Ok(count) => Ok(count > 0),
        Err(zmq::Error::EINTR) => Ok(false),
        Err(cause) => Err(cause),
    }
}

/// The error that libzmq would have returned.
pub(super) fn as_zmq(error: &io::Error) -> zmq::Error {
    match error.raw_os_error() {
        Some(number) => zmq::Error::from_raw(number),
        None => zmq::Error::EFAULT,
    }
}
