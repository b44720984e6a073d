//! A disk for journals.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ztl_std::gateway::Storage;

/// A disk in memory. Its clones are the same disk, so that it outlives the gateways that write to it.
#[derive(Debug, Clone, Default)]
pub struct Disk(Arc<Mutex<Content>>);

#[derive(Debug, Default)]
struct Content {
    written: Vec<u8>,
    full: bool,
}

impl Disk {
    /// While the disk is full, it takes nothing.
    pub fn set_full(&self, full: bool) {
        self.content().full = full;
    }

    /// All that was written.
    #[must_use]
    pub fn written(&self) -> Vec<u8> {
        self.content().written.clone()
    }

    /// Writes as if the process was killed meanwhile: past the limits, and possibly not a whole line.
    pub fn tear(&self, bytes: &[u8]) {
        self.content().written.extend_from_slice(bytes);
    }

    fn content(&self) -> MutexGuard<'_, Content> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Storage for Disk {
    fn add(&mut self, lines: &[u8], _needed: bool) -> io::Result<()> {
        let mut content = self.content();
        if content.full {
            return Err(io::ErrorKind::StorageFull.into());
        }
        content.written.extend_from_slice(lines);
        Ok(())
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        self.content().written.truncate(len);
        Ok(())
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        self.cut(0)?;
        self.add(lines, true)
    }

    fn place(&self) -> String {
        "on a simulated disk".to_owned()
    }
}
