//! Listening sockets and streams: TCP, and sockets in the file system (`ipc://`).

use std::io::{self, Read, Write};
#[cfg(unix)]
use std::net::Ipv4Addr;
use std::net::{IpAddr, SocketAddr};
#[cfg(unix)]
use std::path::Path;
use std::path::PathBuf;

use mio::event::Source;
use mio::net::{TcpListener, TcpStream};
#[cfg(unix)]
use mio::net::{UnixListener, UnixStream};
use mio::{Interest, Registry, Token};

use crate::host;

/// After this silence, the system asks whether the peer is still there; then four times as often.
#[cfg(target_os = "linux")]
const KEEP_ALIVE: std::time::Duration = std::time::Duration::from_secs(60);

/// Connections that wait to be accepted, if the system allows as many.
#[cfg(unix)]
const BACKLOG: i32 = 4096;

/// A ZeroMQ endpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Endpoint {
    /// `tcp://HOST:PORT`; the host may be `*`, for every interface.
    Tcp { host: String, port: u16 },
    /// `ipc://PATH`
    Ipc(PathBuf),
}

impl Endpoint {
    /// Reads an endpoint; the error says what is wrong.
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        if let Some(path) = text.strip_prefix("ipc://").filter(|path| !path.is_empty()) {
            return match cfg!(unix) {
                true => Ok(Self::Ipc(path.into())),
                false => Err("this system has no ipc:// endpoints; use tcp://".to_owned()),
            };
        }
        let place = text.strip_prefix("tcp://");
        let (host, port) = place
            .and_then(|place| place.rsplit_once(':'))
            .ok_or_else(|| format!("'{text}' is not an endpoint; write tcp://HOST:PORT"))?;
        if let Some(mistake) = host::mistake(host) {
            return Err(mistake);
        }
        let number = match port {
            "*" => Some(0),
            port => port.parse().ok(),
        };
        let port = number.ok_or_else(|| format!("invalid port '{port}': expected 0 to 65535"))?;
        let host = match host {
            // RFC 6761: this name is this machine, even if the system has no hosts file.
            "localhost" => "127.0.0.1",
            host => host.trim_start_matches('[').trim_end_matches(']'),
        };
        Ok(Self::Tcp {
            host: host.to_owned(),
            port,
        })
    }

    /// The address to bind.
    pub(crate) fn to_bind(&self) -> Option<SocketAddr> {
        match self {
            Self::Tcp { host, port } => {
                let host = if host == "*" { "0.0.0.0" } else { host };
                Some(SocketAddr::new(host.parse().ok()?, *port))
            }
            Self::Ipc(_) => None,
        }
    }
}

/// A listening socket.
#[derive(Debug)]
pub(super) enum Listener {
    Tcp(TcpListener),
    #[cfg(unix)]
    Ipc(UnixListener, PathBuf),
}

impl Listener {
    /// Listens. A socket file that nobody serves any more is replaced.
    pub(super) fn bind(endpoint: &Endpoint) -> io::Result<Self> {
        match endpoint {
            Endpoint::Tcp { .. } => {
                let address = endpoint.to_bind().ok_or(io::ErrorKind::InvalidInput)?;
                let listener = TcpListener::bind(address)?;
                // The usual 128 are soon too few: a client whose connection does not fit tries again after a second.
                #[cfg(unix)]
                rustix::net::listen(&listener, BACKLOG)?;
                Ok(Self::Tcp(listener))
            }
            #[cfg(unix)]
            Endpoint::Ipc(path) => {
                use std::os::unix::fs::FileTypeExt as _;
                let left = std::fs::symlink_metadata(path)
                    .is_ok_and(|found| found.file_type().is_socket());
                let refused = |error: io::Error| error.kind() == io::ErrorKind::ConnectionRefused;
                let served = std::os::unix::net::UnixStream::connect(path);
                if left && served.is_err_and(refused) {
                    std::fs::remove_file(path)?;
                }
                Ok(Self::Ipc(UnixListener::bind(path)?, path.clone()))
            }
            #[cfg(not(unix))]
            Endpoint::Ipc(_) => Err(io::ErrorKind::Unsupported.into()),
        }
    }

    /// Where it listens, with the port that was chosen.
    pub(super) fn endpoint(&self) -> io::Result<String> {
        match self {
            Self::Tcp(listener) => listener.local_addr().map(|at| format!("tcp://{at}")),
            #[cfg(unix)]
            Self::Ipc(_, path) => Ok(format!("ipc://{}", path.display())),
        }
    }

    /// The next connection, and where it comes from: a socket file is on this machine.
    pub(super) fn accept(&self) -> io::Result<(Stream, IpAddr)> {
        match self {
            Self::Tcp(listener) => {
                let (stream, address) = listener.accept()?;
                stream.set_nodelay(true)?;
                keep_alive(&stream);
                Ok((Stream::Tcp(stream), address.ip().to_canonical()))
            }
            #[cfg(unix)]
            Self::Ipc(listener, _) => {
                let (stream, _) = listener.accept()?;
                Ok((Stream::Ipc(stream), Ipv4Addr::LOCALHOST.into()))
            }
        }
    }

    /// The source of events.
    pub(super) fn source(&mut self) -> &mut dyn Source {
        match self {
            Self::Tcp(listener) => listener,
            #[cfg(unix)]
            Self::Ipc(listener, _) => listener,
        }
    }
}

#[cfg(unix)]
impl Drop for Listener {
    fn drop(&mut self) {
        if let Self::Ipc(_, path) = self {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Lets the system close the connection of a peer that vanished without a word. It works without, so errors are ignored.
#[cfg(unix)]
fn keep_alive(stream: &TcpStream) {
    use rustix::net::sockopt;

    let _ = sockopt::set_socket_keepalive(stream, true);
    #[cfg(target_os = "linux")]
    {
        let _ = sockopt::set_tcp_keepidle(stream, KEEP_ALIVE);
        let _ = sockopt::set_tcp_keepintvl(stream, KEEP_ALIVE / 4);
    }
}

#[cfg(not(unix))]
fn keep_alive(_: &TcpStream) {}

/// A connection.
#[derive(Debug)]
pub(super) enum Stream {
    Tcp(TcpStream),
    #[cfg(unix)]
    Ipc(UnixStream),
}

impl Stream {
    /// Begins to connect.
    pub(super) fn connect_tcp(address: SocketAddr) -> io::Result<Self> {
        let stream = TcpStream::connect(address)?;
        let _ = stream.set_nodelay(true);
        // A subscriber sends nothing that would tell it that its publisher vanished.
        keep_alive(&stream);
        Ok(Self::Tcp(stream))
    }

    #[cfg(unix)]
    pub(super) fn connect_ipc(path: &Path) -> io::Result<Self> {
        UnixStream::connect(path).map(Self::Ipc)
    }

    /// Whether closing it discards what the system has not delivered yet, instead of trying for minutes. It works
    /// without, so errors are ignored.
    pub(super) fn discard_unsent(&self, on: bool) {
        #[cfg(unix)]
        if let Self::Tcp(stream) = self {
            let linger = on.then_some(std::time::Duration::ZERO);
            let _ = rustix::net::sockopt::set_socket_linger(stream, linger);
        }
        #[cfg(not(unix))]
        let _ = on;
    }

    /// Reports when it can be read or written.
    pub(super) fn register(&mut self, registry: &Registry, token: Token) -> io::Result<()> {
        registry.register(
            self.source(),
            token,
            Interest::READABLE | Interest::WRITABLE,
        )
    }

    pub(super) fn deregister(&mut self, registry: &Registry) {
        let _ = registry.deregister(self.source());
    }

    fn source(&mut self) -> &mut dyn Source {
        match self {
            Self::Tcp(stream) => stream,
            #[cfg(unix)]
            Self::Ipc(stream) => stream,
        }
    }
}

impl Read for Stream {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.read(bytes),
            #[cfg(unix)]
            Self::Ipc(stream) => stream.read(bytes),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.write(bytes),
            #[cfg(unix)]
            Self::Ipc(stream) => stream.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn each_end_asks_whether_the_other_is_still_there() {
        use rustix::net::sockopt::{socket_keepalive, tcp_keepidle};

        let endpoint = Endpoint::parse("tcp://127.0.0.1:*").unwrap();
        let listener = Listener::bind(&endpoint).unwrap();
        let Listener::Tcp(bound) = &listener else {
            panic!("TCP");
        };
        let there = Stream::connect_tcp(bound.local_addr().unwrap()).unwrap();
        let here = loop {
            match listener.accept() {
                Ok((stream, _)) => break stream,
                Err(error) => assert_eq!(error.kind(), io::ErrorKind::WouldBlock),
            }
        };
        for stream in [here, there] {
            let Stream::Tcp(stream) = stream else {
                panic!("TCP");
            };
            assert!(socket_keepalive(&stream).unwrap());
            assert_eq!(tcp_keepidle(&stream).unwrap(), KEEP_ALIVE);
        }
    }

    #[test]
    fn endpoints_are_read_strictly() {
        let tcp = |host: &str, port| {
            Ok(Endpoint::Tcp {
                host: host.to_owned(),
                port,
            })
        };
        assert_eq!(Endpoint::parse("tcp://*:*"), tcp("*", 0));
        assert_eq!(Endpoint::parse("tcp://localhost:7"), tcp("127.0.0.1", 7));
        assert_eq!(Endpoint::parse("tcp://[::1]:65535"), tcp("::1", 65535));
        for text in [
            "",
            "tcp://",
            "tcp://:7",
            "tcp://lamp",
            "tcp://lamp:65536",
            "tcp://lamp:-1",
            "udp://lamp:7",
            "tcp://ipc:///x:7",
            "tcp://tcp://lamp:7",
            "tcp://a lamp:7",
            "ipc://",
        ] {
            assert!(Endpoint::parse(text).is_err(), "{text}");
        }
    }
}
