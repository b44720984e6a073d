//! Connections to robots, plain or encrypted. Nothing on them blocks beyond its time, and another thread can close them.

use std::fmt;
use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rustix::net::sockopt;
use rustls::pki_types::ServerName;
use rustls::{ClientConnection, StreamOwned};
use ureq::Timeout;
use ureq::unversioned::transport::{
    Buffers, ConnectionDetails, Connector, LazyBuffers, NextTimeout, Transport,
};

use super::tls::Trust;

/// When the system asks a silent peer whether it is there, and how often before the connection counts as lost.
const KEEP_ALIVE: (Duration, Duration, u32) = (Duration::from_secs(10), Duration::from_secs(5), 3);

/// A connection was not opened. Nothing was sent on it.
#[derive(Debug)]
pub(super) struct NotOpened(pub(super) String);

impl fmt::Display for NotOpened {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for NotOpened {}

/// Closes connections from another thread: that which is open, and those which would be opened later.
#[derive(Debug, Clone, Default)]
pub(super) struct Closer(Arc<Mutex<(bool, Option<TcpStream>)>>);

impl Closer {
    /// Closes them. What reads from one ends.
    pub(super) fn close(&self) {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        state.0 = true;
        if let Some(stream) = state.1.take() {
            // It may be closed already.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Whether a connection was opened.
    pub(super) fn has_opened(&self) -> bool {
        let state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        state.1.is_some()
    }

    fn add(&self, stream: &TcpStream) -> io::Result<()> {
        let mut state = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if state.0 {
            return Err(io::ErrorKind::Interrupted.into());
        }
        state.1 = Some(stream.try_clone()?);
        Ok(())
    }
}

/// A TCP connection. No call lasts longer than `until`, however few bytes come.
#[derive(Debug)]
pub(super) struct Timed {
    stream: TcpStream,
    until: Option<Instant>,
}

impl Timed {
    /// How long the next call may last.
    fn left(&self) -> io::Result<Option<Duration>> {
        let left = self
            .until
            .map(|until| until.saturating_duration_since(Instant::now()));
        match left {
            Some(Duration::ZERO) => Err(io::ErrorKind::TimedOut.into()),
            left => Ok(left),
        }
    }
}

impl Read for Timed {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(self.left()?)?;
        self.stream.read(buffer).map_err(timed_out)
    }
}

impl Write for Timed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(self.left()?)?;
        self.stream.write(bytes).map_err(timed_out)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The system says `WouldBlock`.
fn timed_out(error: io::Error) -> io::Error {
    match error.kind() {
        io::ErrorKind::WouldBlock => io::ErrorKind::TimedOut.into(),
        _ => error,
    }
}

/// A connection.
#[derive(Debug)]
pub(super) enum Stream {
    Plain(Timed),
    Tls(Box<StreamOwned<ClientConnection, Timed>>),
}

impl Stream {
    /// Connects to the first address that answers until `until`. `host`: the name that a certificate must have.
    ///
    /// # Errors
    /// Why none does, or why it cannot be trusted.
    pub(super) fn open(
        addresses: &[SocketAddr],
        host: &str,
        trust: Option<&Trust>,
        until: Instant,
        closer: &Closer,
    ) -> Result<Self, NotOpened> {
        let mut reason = "no such host".to_owned();
        for address in addresses {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            match TcpStream::connect_timeout(address, left) {
                Ok(stream) => return Self::on(stream, host, trust, until, closer),
                Err(error) if error.kind() == io::ErrorKind::TimedOut => {
                    "cannot connect in time".clone_into(&mut reason);
                }
                Err(error) => reason = error.to_string(),
            }
        }
        Err(NotOpened(reason))
    }

    fn on(
        stream: TcpStream,
        host: &str,
        trust: Option<&Trust>,
        until: Instant,
        closer: &Closer,
    ) -> Result<Self, NotOpened> {
        let wrong = |error: io::Error| NotOpened(error.to_string());
        stream.set_nodelay(true).map_err(wrong)?;
        // Without these, it only takes longer until a lost peer is noticed.
        let (idle, interval, count) = KEEP_ALIVE;
        let _ = sockopt::set_socket_keepalive(&stream, true);
        let _ = sockopt::set_tcp_keepidle(&stream, idle);
        let _ = sockopt::set_tcp_keepintvl(&stream, interval);
        let _ = sockopt::set_tcp_keepcnt(&stream, count);
        closer.add(&stream).map_err(wrong)?;
        let mut timed = Timed {
            stream,
            until: Some(until),
        };
        let Some(trust) = trust else {
            return Ok(Self::Plain(timed));
        };
        let config = trust.config().map_err(NotOpened)?;
        let name = ServerName::try_from(host.to_owned());
        let name = name.map_err(|_| NotOpened(format!("no certificate is for '{host}'")))?;
        let mut tls = ClientConnection::new(config, name)
            .map_err(|error| NotOpened(trust.mistake(host, &error)))?;
        while tls.is_handshaking() {
            tls.complete_io(&mut timed).map_err(|error| {
                let cause = error.get_ref().and_then(|it| it.downcast_ref());
                NotOpened(match cause {
                    Some(cause) => trust.mistake(host, cause),
                    None if error.kind() == io::ErrorKind::TimedOut => {
                        format!("no encrypted connection to {host} in time")
                    }
                    None => format!("no encrypted connection to {host}: {error}"),
                })
            })?;
        }
        Ok(Self::Tls(Box::new(StreamOwned::new(tls, timed))))
    }

    /// From now on, calls last until this time, or as long as they need.
    pub(super) fn set_until(&mut self, until: Option<Instant>) {
        match self {
            Self::Plain(timed) => timed.until = until,
            Self::Tls(tls) => tls.sock.until = until,
        }
    }
}

impl Read for Stream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(timed) => timed.read(buffer),
            Self::Tls(tls) => tls.read(buffer),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(timed) => timed.write(bytes),
            Self::Tls(tls) => tls.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(timed) => timed.flush(),
            Self::Tls(tls) => tls.flush(),
        }
    }
}

/// Opens connections for `ureq`.
#[derive(Debug)]
pub(super) struct Dial {
    pub(super) trust: Option<Trust>,
    pub(super) closer: Closer,
    /// How long nothing may come of an answer that has begun.
    pub(super) silence: Option<Duration>,
}

impl Connector for Dial {
    type Out = Line;

    fn connect(
        &self,
        details: &ConnectionDetails<'_>,
        _: Option<()>,
    ) -> Result<Option<Line>, ureq::Error> {
        let host = details.uri.host().unwrap_or_default();
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let until = until(details.timeout).unwrap_or_else(Instant::now);
        let stream = Stream::open(
            &details.addrs,
            host,
            self.trust.as_ref(),
            until,
            &self.closer,
        )
        .map_err(|error| ureq::Error::Other(Box::new(error)))?;
        let config = details.config;
        let buffers = LazyBuffers::new(config.input_buffer_size(), config.output_buffer_size());
        Ok(Some(Line {
            stream,
            buffers,
            silence: self.silence,
        }))
    }
}

fn until(timeout: NextTimeout) -> Option<Instant> {
    Instant::now().checked_add(*timeout.after)
}

/// A connection for `ureq`.
pub(super) struct Line {
    stream: Stream,
    buffers: LazyBuffers,
    silence: Option<Duration>,
}

impl fmt::Debug for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Line")
    }
}

impl Transport for Line {
    fn buffers(&mut self) -> &mut dyn Buffers {
        &mut self.buffers
    }

    fn transmit_output(&mut self, amount: usize, timeout: NextTimeout) -> Result<(), ureq::Error> {
        self.stream.set_until(until(timeout));
        let output = self.buffers.output().get(..amount).unwrap_or_default();
        let sent = self
            .stream
            .write_all(output)
            .and_then(|()| self.stream.flush());
        sent.map_err(|error| broken(error, timeout.reason))
    }

    fn await_input(&mut self, timeout: NextTimeout) -> Result<bool, ureq::Error> {
        let silence = self
            .silence
            .and_then(|silence| Instant::now().checked_add(silence));
        let until = until(timeout).into_iter().chain(silence).min();
        self.stream.set_until(until);
        let input = self.buffers.input_append_buf();
        let count = self.stream.read(input);
        let count = count.map_err(|error| broken(error, timeout.reason))?;
        self.buffers.input_appended(count);
        Ok(count > 0)
    }

    fn is_open(&mut self) -> bool {
        // No connection is used again.
        false
    }

    fn is_tls(&self) -> bool {
        matches!(self.stream, Stream::Tls(_))
    }
}

fn broken(error: io::Error, reason: Timeout) -> ureq::Error {
    match error.kind() {
        io::ErrorKind::TimedOut => ureq::Error::Timeout(reason),
        _ => ureq::Error::Io(error),
    }
}
