//! ZeroMQ messages without interruption by signals, and checked endpoints.
//!
//! ZeroMQ aborts a call when a signal arrives, which is common with child processes or a terminal. In the
//! middle of a message, the rest would be lost.

use std::ops::Deref;

/// Repeats a ZeroMQ call until no signal interrupts it.
pub(crate) fn unbroken<T>(mut call: impl FnMut() -> zmq::Result<T>) -> zmq::Result<T> {
    loop {
        match call() {
            Err(zmq::Error::EINTR) => {}
            done => return done,
        }
    }
}

/// Sends a message without blocking.
///
/// # Errors
/// ZeroMQ's error for the first frame. A message that was started is sent as a whole.
pub(crate) fn send<F: Deref<Target = [u8]>>(socket: &zmq::Socket, frames: &[F]) -> zmq::Result<()> {
    let more = frames.len().saturating_sub(1);
    for (place, frame) in frames.iter().enumerate() {
        let flags = match place < more {
            true => zmq::DONTWAIT | zmq::SNDMORE,
            false => zmq::DONTWAIT,
        };
        unbroken(|| socket.send(&**frame, flags))?;
    }
    Ok(())
}

/// Receives the next message, if there is one.
///
/// # Errors
/// `EAGAIN` if there is none, or ZeroMQ's error.
pub(crate) fn receive(socket: &zmq::Socket) -> zmq::Result<Vec<Vec<u8>>> {
    let mut frames = Vec::new();
    loop {
        let frame = unbroken(|| socket.recv_msg(zmq::DONTWAIT))?;
        let more = frame.get_more();
        frames.push(frame.to_vec());
        if !more {
            return Ok(frames);
        }
    }
}

/// Rejects an endpoint with an invalid port. ZeroMQ truncates it to 16 bits instead, and would connect to
/// another server, or listen at another port.
pub(crate) fn check_port(endpoint: &str) -> zmq::Result<()> {
    let Some((_, port)) = endpoint
        .strip_prefix("tcp://")
        .and_then(|rest| rest.rsplit_once(':'))
    else {
        return Ok(());
    };
    let number = port.strip_prefix(['-', '+']).unwrap_or(port);
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    // ZeroMQ judges anything else, such as `*`.
    match is_number && port.parse::<u16>().is_err() {
        true => Err(zmq::Error::EINVAL),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_beyond_16_bits_is_rejected() {
        for endpoint in [
            "tcp://localhost:65536",
            "tcp://10.0.0.7:99999",
            "tcp://localhost:-1",
        ] {
            assert_eq!(check_port(endpoint), Err(zmq::Error::EINVAL), "{endpoint}");
        }
        for endpoint in [
            "tcp://127.0.0.1:*",
            "tcp://*:0",
            "tcp://robot:65535",
            "ipc:///a:99999",
        ] {
            assert_eq!(check_port(endpoint), Ok(()), "{endpoint}");
        }
    }

    #[test]
    fn a_call_is_repeated_after_a_signal_but_not_after_an_error() {
        let mut answers = [Err(zmq::Error::EINTR), Err(zmq::Error::EINTR), Ok(7)].into_iter();
        assert_eq!(unbroken(|| answers.next().expect("no more calls")), Ok(7));
        let mut answers = [Err(zmq::Error::EINTR), Err(zmq::Error::EAGAIN)].into_iter();
        let called: zmq::Result<()> = unbroken(|| answers.next().expect("no more calls"));
        assert_eq!(called, Err(zmq::Error::EAGAIN));
    }

    #[test]
    fn messages_round_trip() {
        let context = zmq::Context::new();
        let [to, from] = [zmq::PUSH, zmq::PULL].map(|kind| context.socket(kind).expect("one"));
        from.bind("inproc://frames").expect("a name");
        to.connect("inproc://frames").expect("it");
        assert_eq!(receive(&from), Err(zmq::Error::EAGAIN));
        let frames: [&[u8]; 3] = [b"one", b"", &[0xA5; 100]];
        send(&to, &frames).expect("room");
        send(&to, &[&b"last"[..]]).expect("room");
        assert_eq!(receive(&from).expect("a message"), frames);
        assert_eq!(receive(&from).expect("a message"), [b"last"]);
        let none: [&[u8]; 0] = [];
        send(&to, &none).expect("nothing");
        assert_eq!(receive(&from), Err(zmq::Error::EAGAIN));
    }
}
