//! A cable between two real endpoints, with a faulty line in each direction.

mod direction;
mod shared;

use std::io;
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::end::End;
use super::faults::{Counts, FaultyLine};
#[cfg(unix)]
use crate::pty::{Link, Pty};
use direction::Direction;
pub use shared::SharedCable;
use ztl_std::gateway::{Endpoint, Line};

/// Pause before an end is reopened.
const RETRY: Duration = Duration::from_millis(20);

/// Why a cable cannot be set up.
#[derive(Debug)]
#[non_exhaustive]
pub enum CableError {
    /// Listening failed.
    Listen {
        /// The address.
        address: String,
        /// The cause.
        cause: io::Error,
    },
    /// A pty, or a link to it, could not be created.
    Pty(io::Error),
    /// A thread could not be started.
    Thread(io::Error),
}

impl std::fmt::Display for CableError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Listen { address, cause } => write!(f, "cannot listen at {address}: {cause}"),
            Self::Pty(cause) => cause.fmt(f),
            Self::Thread(cause) => write!(f, "cannot start a thread: {cause}"),
        }
    }
}

impl std::error::Error for CableError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::Listen { cause, .. } | Self::Pty(cause) | Self::Thread(cause) => Some(cause),
        }
    }
}

/// Two ends with a line between them, until this is dropped.
///
/// An end that breaks is reopened; the other end does not notice, as with a real cable.
pub struct Cable {
    directions: [Arc<Direction>; 2],
    addresses: [String; 2],
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    links: Links,
}

impl std::fmt::Debug for Cable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Cable")
            .field("addresses", &self.addresses)
            .finish_non_exhaustive()
    }
}

/// Links to ptys, which are removed in the end.
#[cfg(unix)]
type Links = Vec<Link>;
#[cfg(not(unix))]
type Links = ();

/// An end that is ready to be opened.
enum Socket {
    Open(Endpoint),
    Listen(TcpListener),
    #[cfg(unix)]
    Pty(Pty),
}

impl Cable {
    /// Joins two ends. `lines` are the direction from the first end to the second, and back.
    ///
    /// # Errors
    /// [`CableError`] if an end cannot be set up. An end that cannot be opened yet is not an error: the cable
    /// keeps trying.
    pub fn lay(ends: [End; 2], lines: [FaultyLine; 2]) -> Result<Self, CableError> {
        let mut cable = Self {
            directions: lines.map(|line| Arc::new(Direction::new(line))),
            addresses: Default::default(),
            stop: Arc::default(),
            threads: Vec::new(),
            links: Links::default(),
        };
        for (side, end) in ends.into_iter().enumerate() {
            let (socket, address) = prepare(end, &mut cable.links)?;
            if let Some(known) = cable.addresses.get_mut(side) {
                *known = address;
            }
            let [first, second] = cable.directions.each_ref().map(Arc::clone);
            let (from, to) = if side == 0 {
                (first, second)
            } else {
                (second, first)
            };
            let (direction, stop) = (Arc::clone(&to), Arc::clone(&cable.stop));
            cable.spawn("out", move || direction.carry(&stop))?;
            let stop = Arc::clone(&cable.stop);
            cable.spawn("in", move || serve(socket, &from, &to, &stop))?;
        }
        Ok(cable)
    }

    /// How others reach each end, as `ztl gateway --device` takes it; if the cable opens the end itself, what
    /// it opens.
    #[must_use]
    pub fn addresses(&self) -> [&str; 2] {
        self.addresses.each_ref().map(String::as_str)
    }

    /// Statistics of the bytes from the first end to the second, and back.
    #[must_use]
    pub fn counts(&self) -> [Counts; 2] {
        self.directions
            .each_ref()
            .map(|direction| direction.counts())
    }

    fn spawn(&mut self, name: &str, run: impl FnOnce() + Send + 'static) -> Result<(), CableError> {
        let thread = std::thread::Builder::new()
            .name(format!("ztl-cable-{name}"))
            .spawn(run)
            .map_err(CableError::Thread)?;
        self.threads.push(thread);
        Ok(())
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Sets up an end, and says how others reach it.
fn prepare(end: End, links: &mut Links) -> Result<(Socket, String), CableError> {
    match end {
        End::Open(endpoint) => {
            let address = endpoint.to_string();
            Ok((Socket::Open(endpoint), address))
        }
        End::Listen { address } => {
            let listener = TcpListener::bind(&address).and_then(|listener| {
                // Must not block in accept, so that it can be stopped.
                listener.set_nonblocking(true)?;
                let address = listener.local_addr()?;
                Ok((listener, address))
            });
            match listener {
                Ok((listener, address)) => Ok((Socket::Listen(listener), format!("tcp:{address}"))),
                Err(cause) => Err(CableError::Listen { address, cause }),
            }
        }
        #[cfg(unix)]
        End::Pty { link } => {
            let pty = Pty::new().map_err(CableError::Pty)?;
            let mut path = pty.path().to_owned();
            if let Some(link) = link {
                path = link.display().to_string();
                links.push(Link::new(link, pty.path()).map_err(CableError::Pty)?);
            }
            Ok((Socket::Pty(pty), format!("serial:{path}")))
        }
        #[cfg(not(unix))]
        End::Pty { .. } => {
            let () = *links;
            Err(CableError::Pty(io::Error::new(
                io::ErrorKind::Unsupported,
                "this system has no ptys; use tcp-listen:PORT",
            )))
        }
    }
}

/// Keeps an end open: reads from it into `from` and writes the output of `to` to it.
fn serve(mut socket: Socket, from: &Direction, to: &Direction, stop: &AtomicBool) {
    while !stop.load(Ordering::Acquire) {
        if let Some(line) = open(&mut socket) {
            to.set_out(Some(line.writer));
            from.take(line.reader, stop);
            to.set_out(None);
        }
        std::thread::sleep(RETRY);
    }
}

fn open(socket: &mut Socket) -> Option<Line> {
    match socket {
        Socket::Open(endpoint) => endpoint.open().ok(),
        Socket::Listen(listener) => {
            let (stream, _): (TcpStream, _) = listener.accept().ok()?;
            stream.set_nonblocking(false).ok()?;
            Line::tcp(stream).ok()
        }
        #[cfg(unix)]
        Socket::Pty(pty) => pty.line().ok(),
    }
}
