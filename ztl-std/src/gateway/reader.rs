//! A line's thread: opens it and passes on what arrives.

use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use super::device::Input;
use super::endpoint::{Endpoint, Line, is_pause};

/// Pieces of at most 1 KiB that a line may be ahead of its device's thread.
const AHEAD: usize = 64;

/// How a device's line is opened, again and again.
#[derive(Clone)]
pub(super) struct Opener {
    /// What it is called in the log.
    pub(super) label: String,
    /// Its rate in bits a second, where it has one.
    pub(super) baud: Option<u32>,
    /// Whether it may look open when it is not, and nothing is lost by opening it anew.
    pub(super) may_be_half_open: bool,
    /// The name under which the system has it, which may come to lead elsewhere.
    pub(super) path: Option<PathBuf>,
    pub(super) open: Arc<dyn Fn() -> io::Result<Line> + Send + Sync>,
}

impl Opener {
    /// Where its name leads to now.
    pub(super) fn leads_to(&self) -> Option<PathBuf> {
        std::fs::canonicalize(self.path.as_ref()?).ok()
    }
}

impl From<Endpoint> for Opener {
    fn from(endpoint: Endpoint) -> Self {
        Self {
            label: endpoint.to_string(),
            baud: endpoint.baud(),
            may_be_half_open: matches!(endpoint, Endpoint::Tcp { .. }),
            path: match &endpoint {
                Endpoint::Serial { path, .. } => Some(PathBuf::from(path)),
                _ => None,
            },
            open: Arc::new(move || endpoint.open()),
        }
    }
}

/// One of the pieces that a line may be ahead; counted down when dropped.
pub(super) struct Permit(Arc<Ahead>);

/// How far a line is ahead of its device's thread.
#[derive(Default)]
struct Ahead {
    pieces: Mutex<usize>,
    fewer: Condvar,
}

impl Ahead {
    /// Waits until the line may go on; `None` when it does not within a moment.
    fn permit(self: &Arc<Self>) -> Option<Permit> {
        let pieces = self.pieces.lock().unwrap_or_else(PoisonError::into_inner);
        let full = |pieces: &mut usize| *pieces >= AHEAD;
        let waited = self
            .fewer
            .wait_timeout_while(pieces, Duration::from_millis(50), full);
        let (mut pieces, timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        if timeout.timed_out() {
            return None;
        }
        *pieces += 1;
        Some(Permit(Arc::clone(self)))
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut pieces = self.0.pieces.lock().unwrap_or_else(PoisonError::into_inner);
        *pieces = pieces.saturating_sub(1);
        self.0.fewer.notify_one();
    }
}

/// Opens the line and passes on what arrives, until it breaks or is no longer wanted.
pub(super) fn read_line(
    number: u64,
    opener: &Opener,
    inputs: &Sender<Input>,
    stop: &AtomicBool,
) -> io::Error {
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, "the other end has closed it");
    let mut line = match (opener.open)() {
        Ok(line) => line,
        Err(error) => return error,
    };
    let writer = std::mem::replace(&mut line.writer, Box::new(io::sink()));
    if inputs.send(Input::Opened(number, writer)).is_err() {
        return ended();
    }
    let mut buffer = [0; 1024];
    let ahead = Arc::default();
    let mut next = None;
    while !stop.load(Ordering::Acquire) {
        let Some(permit) = next.take().or_else(|| Ahead::permit(&ahead)) else {
            continue;
        };
        match line.reader.read(&mut buffer) {
            Ok(0) => return ended(),
            Ok(count) => {
                let bytes = buffer.get(..count).unwrap_or_default().to_vec();
                if inputs.send(Input::Bytes(number, bytes, permit)).is_err() {
                    break;
                }
            }
            Err(error) if is_pause(&error) => next = Some(permit),
            Err(error) => return error,
        }
    }
    ended()
}
