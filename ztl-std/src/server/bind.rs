//! Binding a socket, and why it can fail.

use std::io;
use std::net::SocketAddr;

use crate::keys::KeyError;
use crate::sockets::check_port;

/// Why a server cannot listen.
#[derive(Debug)]
#[non_exhaustive]
pub enum BindError {
    /// The port is in use.
    InUse {
        /// The endpoint.
        endpoint: String,
    },
    /// No interface of this machine has the address, or it is not a valid one.
    Address {
        /// The endpoint.
        endpoint: String,
        /// ZeroMQ's error.
        cause: zmq::Error,
    },
    /// Keys were given, but this build cannot encrypt.
    NoCurve,
    /// ZeroMQ has no more sockets or memory.
    Socket(zmq::Error),
}

impl std::fmt::Display for BindError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::InUse { endpoint } => write!(
                f,
                "cannot listen at {endpoint}: the port is in use; stop what uses it, or choose another port"
            ),
            Self::Address { endpoint, cause } => {
                write!(f, "cannot listen at {endpoint}: ")?;
                let address = endpoint.rsplit_once(':').map_or("", |(address, _)| address);
                let address = address.trim_start_matches("tcp://");
                match cause {
                    zmq::Error::ENODEV => {
                        write!(f, "'{address}' is not an address of this machine")?;
                    }
                    zmq::Error::EADDRNOTAVAIL => {
                        write!(f, "this machine does not have the address {address}")?;
                    }
                    zmq::Error::EACCES => {
                        return f
                            .write_str("this user may not use the port; choose one above 1023");
                    }
                    cause => f.write_str(cause.message())?,
                }
                f.write_str("; use 127.0.0.1 for this machine only, or * for every interface")
            }
            Self::NoCurve => KeyError::NoCurve.fmt(f),
            Self::Socket(cause) => write!(f, "cannot open a socket: {}", cause.message()),
        }
    }
}

impl std::error::Error for BindError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::InUse { .. } | Self::NoCurve => None,
            Self::Address { cause, .. } | Self::Socket(cause) => Some(cause),
        }
    }
}

impl From<zmq::Error> for BindError {
    fn from(cause: zmq::Error) -> Self {
        Self::Socket(cause)
    }
}

impl BindError {
    /// The same error at another endpoint.
    pub(super) fn at(self, endpoint: &str) -> Self {
        let endpoint = endpoint.to_owned();
        match self {
            Self::InUse { .. } => Self::InUse { endpoint },
            Self::Address { cause, .. } => Self::Address { endpoint, cause },
            other => other,
        }
    }
}

/// Binds a port without listening, so that a server that starts meanwhile still gets it.
pub(super) fn try_port(address: SocketAddr, endpoint: &str) -> Result<(), BindError> {
    bind_only(address).map_err(|error| failed(endpoint, &error))
}

#[cfg(unix)]
fn bind_only(address: SocketAddr) -> io::Result<()> {
    use rustix::net::{AddressFamily, SocketType, bind, socket, sockopt};

    let family = match address {
        SocketAddr::V4(_) => AddressFamily::INET,
        SocketAddr::V6(_) => AddressFamily::INET6,
    };
    let socket = socket(family, SocketType::STREAM, None)?;
    // Like ZeroMQ.
    sockopt::set_socket_reuseaddr(&socket, true)?;
    Ok(bind(&socket, &address)?)
}

#[cfg(not(unix))]
fn bind_only(address: SocketAddr) -> io::Result<()> {
    std::net::TcpListener::bind(address).map(drop)
}

/// The address of `tcp://127.0.0.1:7`, `tcp://*:*` or `tcp://[::1]:0`.
pub(super) fn address(endpoint: &str) -> Result<SocketAddr, BindError> {
    let invalid = || BindError::Address {
        endpoint: endpoint.to_owned(),
        cause: zmq::Error::EINVAL,
    };
    let rest = endpoint.strip_prefix("tcp://").ok_or_else(invalid)?;
    let (host, port) = rest.rsplit_once(':').ok_or_else(invalid)?;
    let port = if port == "*" { "0" } else { port };
    let host = match host {
        "*" => "0.0.0.0",
        "localhost" => "127.0.0.1",
        host => host,
    };
    format!("{host}:{port}")
        .parse()
        .map_err(|_| BindError::Address {
            endpoint: endpoint.to_owned(),
            cause: zmq::Error::ENODEV,
        })
}

/// Why a listener could not be opened.
pub(super) fn failed(endpoint: &str, error: &io::Error) -> BindError {
    let endpoint = endpoint.to_owned();
    match error.kind() {
        io::ErrorKind::AddrInUse => BindError::InUse { endpoint },
        io::ErrorKind::PermissionDenied => BindError::Address {
            endpoint,
            cause: zmq::Error::EACCES,
        },
        _ => BindError::Address {
            endpoint,
            cause: zmq::Error::EADDRNOTAVAIL,
        },
    }
}

/// Binds a socket; returns the endpoint with the chosen port.
pub(super) fn bind(socket: &zmq::Socket, endpoint: &str) -> Result<String, BindError> {
    let bound = check_port(endpoint).and_then(|()| socket.bind(endpoint));
    bound.map_err(|cause| match cause {
        zmq::Error::EADDRINUSE => BindError::InUse {
            endpoint: endpoint.to_owned(),
        },
        cause => BindError::Address {
            endpoint: endpoint.to_owned(),
            cause,
        },
    })?;
    let bound = socket.get_last_endpoint()?;
    Ok(bound.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_port_is_not_truncated() {
        let context = zmq::Context::new();
        let socket = context.socket(zmq::ROUTER).expect("a socket");
        assert!(bind(&socket, "tcp://127.0.0.1:99999").is_err());
    }
}
