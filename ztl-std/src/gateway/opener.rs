//! How a device's line is opened.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use super::endpoint::{Endpoint, Line};
use super::seat::Seat;

/// Opens a device's line, as often as needed.
#[derive(Clone)]
pub(super) struct Opener {
    /// Its name in the log.
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

impl Opener {
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
            path: match &endpoint {
                Endpoint::Serial { path, .. } => Some(PathBuf::from(path)),
                _ => None,
            },
            seat: None,
            open: Arc::new(move || endpoint.open()),
        }
    }
}
