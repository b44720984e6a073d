//! A server's socket, and what wakes its thread.

use std::io;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tracing::debug;
use ztl_core::envelope::Envelope;

use super::authenticator::Authenticator;
use super::{can_encrypt, io_error, sockets};
use crate::log_targets::TASKS;
use crate::server::incoming::{Content, Received, Request, ReturnPath};
use crate::server::{Access, BindError, CurrentAccess, Limits};

/// Where the server's thread receives wake-ups.
const WAKE_UPS: &str = "inproc://wake-ups";

/// The message that wakes the server. Anyone may send it: it carries no request.
const WAKE: &[u8] = b"bell";

/// Wakes the thread that receives.
pub(crate) struct Waking(Mutex<zmq::Socket>);

impl Waking {
    pub(crate) fn wake(&self) {
        let socket = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        // One message per sleep, so the queue is never full. An empty frame would look like the delimiter of a
        // request without a body.
        let _ = sockets::send(&socket, &[WAKE]);
    }
}

/// A ROUTER socket.
pub(crate) struct RouterSocket {
    socket: zmq::Socket,
    authenticator: Authenticator,
}

impl RouterSocket {
    /// Binds a socket; also returns its endpoint, with the chosen port, and what wakes its thread.
    pub(crate) fn bind(
        access: Access,
        limits: Limits,
        endpoint: &str,
    ) -> Result<(Self, String, Waking), BindError> {
        if access.keys().is_some() && !can_encrypt() {
            return Err(BindError::NoCurve);
        }
        let system = |cause| BindError::System(io_error(cause));
        let context = zmq::Context::new();
        let (socket, authenticator, waking) = prepare(access, limits, &context).map_err(system)?;
        let bound = sockets::check_port(endpoint).and_then(|()| socket.bind(endpoint));
        bound.map_err(|cause| BindError::at_endpoint(endpoint, &io_error(cause)))?;
        let bound = socket.get_last_endpoint().map_err(system)?;
        let router = Self {
            socket,
            authenticator,
        };
        Ok((router, bound.unwrap_or_default(), waking))
    }

    pub(crate) const fn access(&self) -> &CurrentAccess {
        self.authenticator.access()
    }

    /// Waits for a message at most for `longest`, or until the thread is woken.
    pub(crate) fn wait(&self, longest: Duration) -> io::Result<Option<Received>> {
        let millis = longest.as_micros().div_ceil(1000);
        let millis = i32::try_from(millis).unwrap_or(i32::MAX).min(3_600_000);
        let millis = if longest == Duration::MAX { -1 } else { millis };
        self.socket.set_rcvtimeo(millis).map_err(io_error)?;
        self.receive(0).map_err(io_error)
    }

    /// The next message, if there is one.
    pub(crate) fn look(&self) -> io::Result<Option<Received>> {
        self.receive(zmq::DONTWAIT).map_err(io_error)
    }

    /// Sends an answer. libzmq drops it if its client is gone, or its queue is full.
    pub(crate) fn answer(&self, mut frames: Vec<zmq::Message>, body: &[u8]) {
        frames.push(body.into());
        if let Err(cause) = sockets::send(&self.socket, &frames) {
            debug!(target: TASKS, "an answer was not taken: {}", cause.message());
        }
    }

    fn receive(&self, flags: i32) -> zmq::Result<Option<Received>> {
        let mut frames = Vec::new();
        let sender = loop {
            let mut frame = match self.socket.recv_msg(flags) {
                Ok(frame) => frame,
                // A signal: the rest of the message has arrived already.
                Err(zmq::Error::EINTR) if !frames.is_empty() => continue,
                Err(zmq::Error::EAGAIN | zmq::Error::EINTR) => return Ok(None),
                Err(cause) => return Err(cause),
            };
            let sender = (!frame.get_more()).then(|| self.authenticator.sender(&mut frame));
            frames.push(frame);
            if let Some(sender) = sender {
                break sender;
            }
        };
        if matches!(frames.as_slice(), [_, body] if **body == *WAKE) {
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
}

fn prepare(
    access: Access,
    limits: Limits,
    context: &zmq::Context,
) -> zmq::Result<(zmq::Socket, Authenticator, Waking)> {
    let socket = context.socket(zmq::ROUTER)?;
    socket.set_linger(0)?;
    apply(limits, &socket)?;
    let authenticator = Authenticator::new(access, limits, context, &socket)?;
    // Wake-ups arrive among the requests.
    socket.bind(WAKE_UPS)?;
    let waking = context.socket(zmq::DEALER)?;
    waking.set_linger(0)?;
    waking.connect(WAKE_UPS)?;
    Ok((socket, authenticator, Waking(Mutex::new(waking))))
}

/// Applies the limits of messages to a socket that is bound afterwards.
fn apply(limits: Limits, socket: &zmq::Socket) -> zmq::Result<()> {
    let message = limits.longest_message();
    socket.set_maxmsgsize(i64::try_from(message).unwrap_or(i64::MAX))?;
    let queue = i32::try_from(limits.queue.max(1)).unwrap_or(i32::MAX);
    socket.set_rcvhwm(queue)?;
    socket.set_sndhwm(queue)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_port_is_not_truncated() {
        let bound = RouterSocket::bind(
            Access::everybody(),
            Limits::default(),
            "tcp://127.0.0.1:99999",
        );
        assert!(bound.is_err());
    }
}
