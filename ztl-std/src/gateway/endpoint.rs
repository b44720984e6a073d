//! Endpoints of devices: `serial:/dev/ttyACM0?baud=115200`, `tcp:HOST:PORT`.

use std::any::Any;
use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use ztl_link::bus::TURNAROUND;

/// Default line rate of a serial port.
pub const BAUD: u32 = 115_200;

/// What a line rate is, for messages.
pub(super) const BAUD_WANTED: &str = "a line rate in bits a second, as 115200";

/// Why a line is not open.
pub(super) const NO_PORT: &str = "there is no such port; is it plugged in?";
pub(super) const CLOSED: &str = "the other end has closed it";

/// Timeout of a read, so that a line can be closed.
pub const READ_TIMEOUT: Duration = Duration::from_millis(50);

/// The endpoint of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Endpoint {
    /// A serial port, a USB serial port or a pty.
    Serial {
        /// Path of the port.
        path: String,
        /// Line rate in bits per second.
        baud: u32,
    },
    /// A byte stream over TCP: ser2net, QEMU, `ztl device`.
    Tcp {
        /// Host and port.
        address: String,
    },
    /// A device in this process.
    InProcess(InProcess),
    /// A half-duplex line that several nodes share, such as RS-485.
    Bus {
        /// The serial port or the TCP connection.
        line: Box<Self>,
        /// How long after a question an answer may begin.
        wait: Duration,
    },
}

/// A device in this process, such as a simulated one.
#[derive(Clone)]
pub struct InProcess {
    name: String,
    open: Arc<dyn Fn() -> io::Result<Line> + Send + Sync>,
}

impl InProcess {
    /// A device with a name, by which devices are compared; `open` starts it.
    pub fn new(name: &str, open: impl Fn() -> io::Result<Line> + Send + Sync + 'static) -> Self {
        Self {
            name: name.to_owned(),
            open: Arc::new(open),
        }
    }
}

impl PartialEq for InProcess {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl Eq for InProcess {}

impl std::fmt::Debug for InProcess {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("InProcess").field(&self.name).finish()
    }
}

/// Parses an endpoint: [`Endpoint`]'s `parse`, possibly with more kinds of devices. Returns what is wrong and
/// what is expected.
pub type ParseEndpoint = fn(&str) -> Result<Endpoint, String>;

/// Why a text is not an endpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum EndpointError {
    /// The part before the first `:` is unknown.
    Scheme {
        /// The text.
        found: String,
    },
    /// The path or the address is missing or incomplete.
    Incomplete {
        /// What is expected.
        expected: &'static str,
    },
    /// `?baud=` is not a line rate, or an option is unknown.
    Option {
        /// The text.
        found: String,
        /// Whether it is an option of a shared line.
        of_bus: bool,
    },
}

impl std::fmt::Display for EndpointError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Scheme { found } => write!(
                f,
                "unknown kind of device '{found}'; use serial:/dev/ttyACM0?baud=115200, tcp:HOST:PORT, or rs485:/dev/ttyUSB0?baud=115200 for a shared line"
            ),
            Self::Incomplete { expected } => write!(f, "incomplete; use {expected}"),
            Self::Option { found, of_bus } => {
                let and = if *of_bus {
                    " or ?wait=8, the milliseconds until an answer begins, 8 to 250"
                } else {
                    ""
                };
                write!(
                    f,
                    "'{found}' is not an option of a serial port; use ?baud=115200{and}"
                )
            }
        }
    }
}

impl std::error::Error for EndpointError {}

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let (scheme, rest) = text.split_once(':').unwrap_or((text, ""));
        match scheme {
            "serial" => serial(rest, &mut None),
            "rs485" => bus(rest),
            "tcp" => match rest.rsplit_once(':') {
                Some((host, port)) if !host.is_empty() && port.parse::<u16>().is_ok() => {
                    Ok(Self::Tcp {
                        address: rest.to_owned(),
                    })
                }
                _ => Err(EndpointError::Incomplete {
                    expected: "tcp:HOST:PORT, as tcp:localhost:7000",
                }),
            },
            _ => Err(EndpointError::Scheme {
                found: scheme.to_owned(),
            }),
        }
    }
}

/// The waits for an answer on a shared line, in milliseconds.
const WAITS: std::ops::RangeInclusive<u64> = 8..=250;

fn bus(rest: &str) -> Result<Endpoint, EndpointError> {
    let mut wait = Some(TURNAROUND);
    let line = match rest.strip_prefix("tcp:") {
        Some(_) => {
            let (address, options) = rest.split_once('?').unwrap_or((rest, ""));
            // Its options are those of any shared line.
            serial(&format!("x?{options}"), &mut wait)?;
            address.parse()?
        }
        None => serial(rest, &mut wait).map_err(|error| match error {
            EndpointError::Incomplete { .. } => EndpointError::Incomplete {
                expected: "rs485:PATH, as rs485:/dev/ttyUSB0?baud=115200, or rs485:tcp:HOST:PORT",
            },
            error => error,
        })?,
    };
    Ok(Endpoint::Bus {
        line: Box::new(line),
        wait: wait.unwrap_or(TURNAROUND),
    })
}

/// A serial port. `wait` is that of a shared line.
fn serial(rest: &str, wait: &mut Option<Duration>) -> Result<Endpoint, EndpointError> {
    let (path, options) = rest.split_once('?').unwrap_or((rest, ""));
    if path.is_empty() {
        return Err(EndpointError::Incomplete {
            expected: "serial:PATH, as serial:/dev/ttyACM0?baud=115200",
        });
    }
    let mut baud = BAUD;
    for option in options.split('&').filter(|option| !option.is_empty()) {
        let of_bus = wait.is_some();
        let wrong = || EndpointError::Option {
            found: option.to_owned(),
            of_bus,
        };
        match (option.split_once('=').ok_or_else(wrong)?, wait.as_mut()) {
            (("baud", rate), _) => {
                let rate = rate.parse().ok().filter(|rate| *rate > 0);
                baud = rate.ok_or_else(wrong)?;
            }
            (("wait", time), Some(wait)) => {
                let time = time.parse().ok().filter(|time| WAITS.contains(time));
                *wait = Duration::from_millis(time.ok_or_else(wrong)?);
            }
            _ => return Err(wrong()),
        }
    }
    Ok(Endpoint::Serial {
        path: path.to_owned(),
        baud,
    })
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial { path, .. } => write!(f, "serial:{path}"),
            Self::Tcp { address } => write!(f, "tcp:{address}"),
            Self::InProcess(device) => f.write_str(&device.name),
            Self::Bus { line, .. } => match &**line {
                Self::Serial { path, .. } => write!(f, "rs485:{path}"),
                line => write!(f, "rs485:{line}"),
            },
        }
    }
}

/// An open byte stream whose reads time out with [`io::ErrorKind::TimedOut`].
pub struct Line {
    /// Received bytes.
    pub reader: Box<dyn Read + Send>,
    /// Bytes to send, written at once. Never flushed, since a serial port then waits until the last bit is sent, in
    /// steps of the system's clock.
    pub writer: Box<dyn Write + Send>,
    /// The device at the other end, if it is in this process; lives as long as the line.
    pub device: Option<Box<dyn Any + Send>>,
}

impl std::fmt::Debug for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Line")
    }
}

impl Line {
    /// A line from any reader and writer.
    pub fn new(reader: impl Read + Send + 'static, writer: impl Write + Send + 'static) -> Self {
        Self {
            reader: Box::new(reader),
            writer: Box::new(writer),
            device: None,
        }
    }

    /// A line over a connected TCP stream.
    ///
    /// # Errors
    /// The system's error.
    pub fn tcp(stream: TcpStream) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(READ_TIMEOUT))?;
        stream.set_write_timeout(Some(Duration::from_secs(1)))?;
        Ok(Self::new(stream.try_clone()?, stream))
    }

    /// A line over an open serial port.
    ///
    /// # Errors
    /// The system's error.
    pub fn serial(port: Box<dyn serialport::SerialPort>) -> io::Result<Self> {
        let reader = port.try_clone()?;
        Ok(Self::new(reader, port))
    }
}

impl Endpoint {
    /// Opens the line, or starts a device in this process.
    ///
    /// # Errors
    /// The system's error.
    pub fn open(&self) -> io::Result<Line> {
        match self {
            Self::Serial { path, baud } => {
                let port = serialport::new(path, *baud).timeout(READ_TIMEOUT).open();
                Line::serial(port.map_err(|error| for_people(path, error))?)
            }
            Self::Tcp { address } => {
                let wait = Duration::from_secs(1);
                let mut last = io::Error::new(io::ErrorKind::NotFound, "no such host");
                for address in address.to_socket_addrs()? {
                    match TcpStream::connect_timeout(&address, wait) {
                        Ok(stream) => return Line::tcp(stream),
                        Err(error) => last = error,
                    }
                }
                Err(last)
            }
            Self::InProcess(device) => (device.open)(),
            Self::Bus { line, .. } => line.open(),
        }
    }

    /// Whether both are the same line, judging by their names.
    pub(super) fn is_same_line(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Serial { path, .. }, Self::Serial { path: its, .. }) => path == its,
            (Self::Tcp { address }, Self::Tcp { address: its }) => address == its,
            (Self::Bus { line, .. }, other) => line.is_same_line(other),
            (line, Self::Bus { line: its, .. }) => line.is_same_line(its),
            _ => false,
        }
    }

    /// Whether the line may be half open: its other end is gone, and the system has not noticed.
    pub(super) fn may_be_half_open(&self) -> bool {
        match self {
            Self::Tcp { .. } => true,
            Self::Bus { line, .. } => line.may_be_half_open(),
            _ => false,
        }
    }

    /// The path of its serial port.
    pub(super) fn path(&self) -> Option<&str> {
        match self {
            Self::Serial { path, .. } => Some(path),
            Self::Bus { line, .. } => line.path(),
            _ => None,
        }
    }

    /// The line rate, if the line has one.
    pub(super) fn baud(&self) -> Option<u32> {
        match self {
            Self::Serial { baud, .. } => Some(*baud),
            Self::Bus { line, .. } => line.baud(),
            _ => None,
        }
    }

    /// Sets the line rate. Returns whether the line has one.
    pub(super) fn set_baud(&mut self, rate: u32) -> bool {
        match self {
            Self::Serial { baud, .. } => *baud = rate,
            Self::Bus { line, .. } => return line.set_baud(rate),
            _ => return false,
        }
        true
    }
}

/// Why a port cannot be opened, with a hint.
fn for_people(path: &str, error: serialport::Error) -> io::Error {
    use io::ErrorKind;
    let what = std::fs::metadata(path).map(|about| about.file_type());
    let no_port = |what: &str| format!("it is {what}, not a serial port");
    let (kind, text) = match (error.kind(), what) {
        (_, Ok(what)) if what.is_dir() => (ErrorKind::IsADirectory, no_port("a directory")),
        (_, Ok(what)) if what.is_file() => (ErrorKind::InvalidInput, no_port("a file")),
        (serialport::ErrorKind::NoDevice, _) => (
            ErrorKind::ResourceBusy,
            "another program uses it".to_owned(),
        ),
        (serialport::ErrorKind::Io(ErrorKind::NotFound), _) => {
            (ErrorKind::NotFound, NO_PORT.to_owned())
        }
        (serialport::ErrorKind::Io(ErrorKind::PermissionDenied), _) => (
            ErrorKind::PermissionDenied,
            "this user may not open it; ports often belong to the group dialout".to_owned(),
        ),
        // ENOTTY: the file is not a terminal.
        (_, _)
            if ["typewriter", "ioctl"]
                .iter()
                .any(|part| error.description.contains(part)) =>
        {
            (ErrorKind::InvalidInput, no_port("something else"))
        }
        _ => return error.into(),
    };
    io::Error::new(kind, text)
}

/// Whether a read only timed out.
#[must_use]
pub fn is_pause(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::TimedOut | io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_parsed_and_mistakes_say_what_is_expected() {
        let serial = |path: &str, baud| Endpoint::Serial {
            path: path.to_owned(),
            baud,
        };
        assert_eq!(
            "serial:/dev/ttyACM0".parse(),
            Ok(serial("/dev/ttyACM0", BAUD))
        );
        assert_eq!(
            "serial:/dev/pts/3?baud=9600".parse(),
            Ok(serial("/dev/pts/3", 9600))
        );
        assert_eq!(
            "tcp:localhost:7000".parse(),
            Ok(Endpoint::Tcp {
                address: "localhost:7000".to_owned()
            })
        );
        let bus = |line, wait| Endpoint::Bus {
            line: Box::new(line),
            wait: Duration::from_millis(wait),
        };
        assert_eq!(
            "rs485:/dev/ttyUSB0?baud=9600&wait=20".parse(),
            Ok(bus(serial("/dev/ttyUSB0", 9600), 20))
        );
        let address = "localhost:7000".to_owned();
        assert_eq!(
            "rs485:tcp:localhost:7000".parse(),
            Ok(bus(Endpoint::Tcp { address }, 8))
        );
        for (text, part) in [
            ("rs485:", "rs485:/dev/ttyUSB0"),
            ("rs485:tcp:7000", "tcp:HOST:PORT"),
            ("rs485:/dev/x?wait=7", "?wait=8"),
            ("rs485:tcp:localhost:7000?wait=251", "?wait=8"),
            ("serial:/dev/x?wait=20", "'wait=20' is not"),
            ("usb:1", "serial:/dev/ttyACM0"),
            ("/dev/ttyACM0", "serial:/dev/ttyACM0"),
            ("serial:", "serial:PATH"),
            ("serial:/dev/x?baud=fast", "?baud=115200"),
            ("serial:/dev/x?speed=9600", "?baud=115200"),
            ("tcp:7000", "tcp:HOST:PORT"),
            ("tcp:localhost:http", "tcp:HOST:PORT"),
        ] {
            let error = text.parse::<Endpoint>().unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
