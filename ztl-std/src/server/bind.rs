//! Binding a socket, and why it can fail.

use std::io;
use std::net::{IpAddr, SocketAddr};

use crate::keys::KeyError;

/// Why a server cannot listen.
#[derive(Debug)]
#[non_exhaustive]
pub enum BindError {
    /// The port, or the path of a socket in the file system, is in use.
    InUse {
        /// The endpoint.
        endpoint: String,
    },
    /// The endpoint cannot be used.
    Endpoint {
        /// The endpoint.
        endpoint: String,
        /// What is wrong with it.
        why: String,
    },
    /// Keys were given, but this build cannot encrypt.
    NoCurve,
    /// The system has no more files, threads or memory.
    System(io::Error),
}

impl std::fmt::Display for BindError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::InUse { endpoint } => {
                let what = match endpoint.starts_with("ipc://") {
                    true => "path",
                    false => "port",
                };
                write!(
                    f,
                    "cannot listen at {endpoint}: the {what} is in use; stop what uses it, or choose another {what}"
                )
            }
            Self::Endpoint { endpoint, why } => write!(f, "cannot listen at {endpoint}: {why}"),
            Self::NoCurve => KeyError::NoCurve.fmt(f),
            Self::System(cause) => write!(f, "cannot open a socket: {cause}"),
        }
    }
}

impl std::error::Error for BindError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::System(cause) => Some(cause),
            _ => None,
        }
    }
}

impl BindError {
    /// Why this endpoint could not be bound.
    pub(crate) fn at_endpoint(endpoint: &str, error: &io::Error) -> Self {
        use io::ErrorKind;

        let address = endpoint.rsplit_once(':').map_or("", |(address, _)| address);
        let address = address.trim_start_matches("tcp://");
        let why = match error.kind() {
            ErrorKind::AddrInUse => {
                return Self::InUse {
                    endpoint: endpoint.to_owned(),
                };
            }
            ErrorKind::PermissionDenied if endpoint.starts_with("tcp://") => {
                "this user may not use the port; choose one above 1023".to_owned()
            }
            ErrorKind::AddrNotAvailable => {
                format!("this machine does not have the address {address}; {USE}")
            }
            // libzmq: no interface has this name.
            _ if error.raw_os_error() == Some(NO_DEVICE) => not_here(address),
            _ => error.to_string(),
        };
        Self::Endpoint {
            endpoint: endpoint.to_owned(),
            why,
        }
    }

    /// The same error at another endpoint.
    pub(super) fn at(self, endpoint: &str) -> Self {
        let endpoint = endpoint.to_owned();
        match self {
            Self::InUse { .. } => Self::InUse { endpoint },
            Self::Endpoint { why, .. } => Self::Endpoint { endpoint, why },
            other => other,
        }
    }
}

/// `ENODEV`
const NO_DEVICE: i32 = 19;

const USE: &str = "use 127.0.0.1 for this machine only, or * for every interface";

/// What is wrong with a host that is not an address.
pub(super) fn not_here(host: &str) -> String {
    format!("'{host}' is not an address of this machine; {USE}")
}

/// What is wrong with the address of a group.
pub(super) fn group(address: &IpAddr, kind: &str) -> String {
    format!("{address} is a {kind} address, where no client can connect; {USE}")
}

/// Binds a port without listening, so that a server that starts meanwhile still gets it.
pub(super) fn try_port(address: SocketAddr, endpoint: &str) -> Result<(), BindError> {
    bind_only(address).map_err(|error| BindError::at_endpoint(endpoint, &error))
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
