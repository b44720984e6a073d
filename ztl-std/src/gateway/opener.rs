//! How a device's line is opened.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use super::endpoint::{CLOSED, Endpoint, Line, NO_PORT};
use super::seat::Seat;

/// Opens a device's line, as often as needed.
#[derive(Clone)]
pub(super) struct Opener {
    /// Its name in the log, without the address on a shared line.
    pub(super) label: String,
    /// Line rate in bits per second, if the line has one.
    pub(super) baud: Option<u32>,
    /// Whether the line may be half open, and can be reopened at no cost.
    pub(super) may_be_half_open: bool,
    /// Its path in the file system, whose target may change.
    pub(super) path: Option<PathBuf>,
    /// Its place, if it is a node of a shared line.
    pub(super) seat: Option<Arc<Seat>>,
    pub(super) open: Arc<dyn Fn() -> io::Result<Line> + Send + Sync>,
}

impl std::fmt::Debug for Opener {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.url())
    }
}

impl Opener {
    /// Its name in the log.
    pub(super) fn url(&self) -> String {
        match &self.seat {
            Some(seat) => format!("{}, address {}", self.label, seat.address()),
            None => self.label.clone(),
        }
    }

    /// Why the line was closed, after this error.
    pub(super) fn why_closed(&self, error: &io::Error) -> String {
        if self.path.as_ref().is_some_and(|path| !path.exists()) {
            return NO_PORT.to_owned();
        }
        match error.kind() {
            // The system reports it in one of several ways, and each would be logged in turn.
            io::ErrorKind::UnexpectedEof
            | io::ErrorKind::BrokenPipe
            | io::ErrorKind::ConnectionReset
            | io::ErrorKind::ConnectionAborted => CLOSED.to_owned(),
            _ => error.to_string(),
        }
    }

    /// The path's current target.
    pub(super) fn target(&self) -> Option<PathBuf> {
        std::fs::canonicalize(self.path.as_ref()?).ok()
    }
}

impl From<Endpoint> for Opener {
    fn from(endpoint: Endpoint) -> Self {
        Self {
            label: endpoint.to_string(),
            baud: endpoint.baud(),
            may_be_half_open: endpoint.may_be_half_open(),
            path: endpoint.path().map(PathBuf::from),
            seat: None,
            open: Arc::new(move || endpoint.open()),
        }
    }
}
