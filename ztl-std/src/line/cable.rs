//! Two real ends, joined by a line with faults in each direction.

mod way;

use std::io;
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use super::{Counts, End, FaultyLine};
use crate::gateway::{Endpoint, Line};
#[cfg(unix)]
use crate::pty::{Link, Pty};
use way::Way;

/// Pause before an end is opened again.
const RETRY: Duration = Duration::from_millis(20);

/// Why a cable cannot be laid.
#[derive(Debug)]
#[non_exhaustive]
pub enum CableError {
    /// Nothing can listen there.
    Listen {
        /// Where.
        address: String,
        /// What the system says.
        cause: io::Error,
    },
    /// There is no pty, or no link to it can be made.
    Pty(io::Error),
    /// The system gives no more threads.
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
/// An end that breaks is opened again; the other hears nothing of it, as with a real cable.
pub struct Cable {
    ways: [Arc<Way>; 2],
    places: [String; 2],
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    #[cfg(unix)]
    _links: Vec<Link>,
}

impl std::fmt::Debug for Cable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Cable")
            .field("places", &self.places)
            .finish_non_exhaustive()
    }
}

/// An end that is ready to be opened.
enum Socket {
    Open(Endpoint),
    Listen(TcpListener),
    #[cfg(unix)]
    Pty(Pty),
}

impl Cable {
    /// Joins two ends; `lines` are the direction from the first to the second, and back.
    ///
    /// # Errors
    /// As [`CableError`] says. An end that cannot be opened yet is none: it is tried again.
    pub fn lay(ends: [End; 2], lines: [FaultyLine; 2]) -> Result<Self, CableError> {
        let mut cable = Self {
            ways: lines.map(|line| Arc::new(Way::new(line))),
            places: Default::default(),
            stop: Arc::default(),
            threads: Vec::new(),
            #[cfg(unix)]
            _links: Vec::new(),
        };
        for (side, end) in ends.into_iter().enumerate() {
            let (socket, place) = cable.prepare(end)?;
            if let Some(known) = cable.places.get_mut(side) {
                *known = place;
            }
            let [first, second] = cable.ways.each_ref().map(Arc::clone);
            let (from, to) = if side == 0 {
                (first, second)
            } else {
                (second, first)
            };
            let (way, stop) = (Arc::clone(&to), Arc::clone(&cable.stop));
            cable.spawn("out", move || way.carry(&stop))?;
            let stop = Arc::clone(&cable.stop);
            cable.spawn("in", move || attend(socket, &from, &to, &stop))?;
        }
        Ok(cable)
    }

    /// How others reach each end, as `ztl gateway --device` takes it; or, where the cable itself
    /// opens it, what it opens.
    #[must_use]
    pub fn places(&self) -> [&str; 2] {
        self.places.each_ref().map(String::as_str)
    }

    /// What has become of the bytes from the first end to the second, and of those back.
    #[must_use]
    pub fn counts(&self) -> [Counts; 2] {
        self.ways.each_ref().map(|way| way.counts())
    }

    fn prepare(&mut self, end: End) -> Result<(Socket, String), CableError> {
        match end {
            End::Open(endpoint) => {
                let place = endpoint.to_string();
                Ok((Socket::Open(endpoint), place))
            }
            End::Listen { address } => {
                let listener = TcpListener::bind(&address).and_then(|listener| {
                    // To be stopped, it must not wait in accept.
                    listener.set_nonblocking(true)?;
                    let address = listener.local_addr()?;
                    Ok((listener, address))
                });
                match listener {
                    Ok((listener, address)) => {
                        Ok((Socket::Listen(listener), format!("tcp:{address}")))
                    }
                    Err(cause) => Err(CableError::Listen { address, cause }),
                }
            }
            #[cfg(unix)]
            End::Pty { link } => {
                let pty = Pty::new().map_err(CableError::Pty)?;
                let mut path = pty.path().to_owned();
                if let Some(link) = link {
                    path = link.display().to_string();
                    let link = Link::new(link, pty.path()).map_err(CableError::Pty)?;
                    self._links.push(link);
                }
                Ok((Socket::Pty(pty), format!("serial:{path}")))
            }
            #[cfg(not(unix))]
            End::Pty { .. } => Err(CableError::Pty(io::Error::new(
                io::ErrorKind::Unsupported,
                "this system has no ptys; use tcp-listen:PORT",
            ))),
        }
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

/// Keeps an end open: what it says goes into `from`, what comes out of `to` goes to it.
fn attend(mut socket: Socket, from: &Way, to: &Way, stop: &AtomicBool) {
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
