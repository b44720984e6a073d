//! What a cable's end connects to: `pty`, `tcp-listen:7000`, or any endpoint of a gateway's device.

use std::path::PathBuf;
use std::str::FromStr;

use ztl_std::gateway::{Endpoint, EndpointError};

use crate::device::endpoint;

/// One end of a [`Cable`](super::Cable).
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum End {
    /// Opened, and reopened when it breaks: `serial:PATH?baud=115200`, `tcp:HOST:PORT`, `sim:gripper`.
    Open(Endpoint),
    /// Accepts one TCP connection at a time: `tcp-listen:PORT`, `tcp-listen:HOST:PORT`.
    Listen {
        /// Host and port; the host defaults to this machine.
        address: String,
    },
    /// A new pty, which others open as a serial port: `pty`, `pty:LINK`.
    Pty {
        /// Path of a link to the pty.
        link: Option<PathBuf>,
    },
}

/// Why a text is not an end of a cable.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum EndError {
    /// The scheme before the first `:` is unknown.
    Scheme {
        /// The scheme found.
        found: String,
    },
    /// `tcp-listen:` without a port.
    Listen,
    /// `tcp:` without a host or a port.
    Tcp,
    /// An invalid endpoint of a gateway's device.
    Endpoint(String),
}

impl std::fmt::Display for EndError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Scheme { found } => write!(
                f,
                "unknown end '{found}': expected pty, pty:LINK, serial:/dev/ttyACM0, tcp:HOST:PORT, tcp-listen:PORT or sim:gripper"
            ),
            Self::Listen => f.write_str("port missing: expected tcp-listen:PORT, such as tcp-listen:7000"),
            Self::Tcp => f.write_str(
                "host or port missing: expected tcp:HOST:PORT to connect, or tcp-listen:PORT to listen",
            ),
            Self::Endpoint(error) => error.fmt(f),
        }
    }
}

impl std::error::Error for EndError {}

impl FromStr for End {
    type Err = EndError;

    fn from_str(text: &str) -> Result<Self, EndError> {
        let (scheme, rest) = text.split_once(':').unwrap_or((text, ""));
        match scheme {
            "pty" => Ok(Self::Pty {
                link: (!rest.is_empty()).then(|| rest.into()),
            }),
            "tcp-listen" => match listen_address(rest) {
                Some(address) => Ok(Self::Listen { address }),
                None => Err(EndError::Listen),
            },
            "tcp" => text
                .parse()
                .map(Self::Open)
                .map_err(|_: EndpointError| EndError::Tcp),
            "serial" | "sim" => endpoint(text).map(Self::Open).map_err(EndError::Endpoint),
            _ => Err(EndError::Scheme {
                found: scheme.to_owned(),
            }),
        }
    }
}

/// Parses `PORT` or `HOST:PORT` as an address to listen on; without a host, this machine only.
fn listen_address(text: &str) -> Option<String> {
    let (host, port) = text.rsplit_once(':').unwrap_or(("127.0.0.1", text));
    let port: u16 = port.parse().ok()?;
    (!host.is_empty()).then(|| format!("{host}:{port}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_parse_and_errors_say_what_is_expected() {
        let listen = |address: &str| End::Listen {
            address: address.to_owned(),
        };
        let pty = |link: Option<&str>| End::Pty {
            link: link.map(PathBuf::from),
        };
        assert_eq!("pty".parse(), Ok(pty(None)));
        assert_eq!("pty:/tmp/a:b".parse(), Ok(pty(Some("/tmp/a:b"))));
        assert_eq!("tcp-listen:7000".parse(), Ok(listen("127.0.0.1:7000")));
        assert_eq!("tcp-listen:0.0.0.0:7".parse(), Ok(listen("0.0.0.0:7")));
        let open = "serial:/dev/ttyACM0?baud=9600";
        assert_eq!(open.parse(), Ok(End::Open(open.parse().unwrap())));
        for (text, part) in [
            ("/dev/ttyACM0", "serial:/dev/ttyACM0"),
            ("tcp-listen", "tcp-listen:7000"),
            ("tcp-listen:http", "tcp-listen:7000"),
            ("tcp-listen::7000", "tcp-listen:7000"),
            ("tcp:7000", "tcp-listen:PORT"),
            ("serial:", "serial:PATH"),
            ("sim:arm", "there are: gripper, head"),
        ] {
            let error = text.parse::<End>().unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
