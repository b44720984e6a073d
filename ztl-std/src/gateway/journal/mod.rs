//! The gateway's journal: what it promised, so that it keeps its promises after a restart.
//!
//! A task's id is written before its `Start` is sent, and its end before the device gets an `Ack` and before
//! any client learns it. `docs/journal.md` describes the file and its location.

mod device;
mod entry;
mod error;
mod file;
mod records;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::Duration;

use ztl_link::Restored;

pub use device::DeviceJournal;
pub(super) use device::{DECIDED, UNWRITTEN};
use device::{SharedRecords, lock};
pub use entry::Moment;
pub use error::JournalError;
pub(super) use file::JournalFile;
pub(super) use records::UnendedUpdate;
pub use records::{JournalRecords, Storage};

use crate::random;
use crate::server::{ReservedIds, RestoredTask};

/// How often the journal is checked for changes by others, and written again if it could not be.
const CHECK: Duration = Duration::from_secs(1);

/// A journal in a file.
#[derive(Debug, Clone)]
pub struct Journal {
    records: SharedRecords<JournalFile>,
    path: PathBuf,
}

impl Journal {
    /// Opens or creates a journal, and repairs what a crash left. With `sync`, each entry is on the disk before it
    /// has any effect, so it survives a power cut of this machine; without, it survives the end of the process.
    ///
    /// # Errors
    /// [`JournalError`]. A full disk is not an error here: tasks are rejected with that reason until there is
    /// room.
    pub fn open(path: impl AsRef<Path>, sync: bool) -> Result<Self, JournalError> {
        let path = path.as_ref().to_owned();
        let (file, written) = JournalFile::open(&path)?;
        let records = JournalRecords::open(file, &written, Moment::now(), random::number());
        let records = Arc::new(Mutex::new(records.with_sync(sync)));
        watch(Arc::downgrade(&records));
        Ok(Self { records, path })
    }

    /// Checks whether a journal can be opened, without changing anything.
    ///
    /// # Errors
    /// Those of [`open`](Self::open).
    pub fn check(path: &Path) -> Result<(), JournalError> {
        file::check(path)
    }

    /// The journal's path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn gateway(&self) -> u64 {
        lock(&self.records).gateway()
    }

    /// The task ids that it reserves.
    pub(super) fn reserved_ids(&self) -> Arc<ReservedIds> {
        Arc::clone(lock(&self.records).reserved_ids())
    }

    /// The tasks without an end, each with its device's name.
    pub(super) fn unended(&self) -> Vec<(String, Restored)> {
        lock(&self.records).unended()
    }

    /// The updates without an end with which this gateway goes on.
    pub(super) fn unended_updates(&self) -> Vec<UnendedUpdate> {
        lock(&self.records).unended_updates()
    }

    /// The ended tasks, as `told` completes them.
    pub(super) fn ended(
        &self,
        told: impl Fn([&str; 3], RestoredTask) -> RestoredTask,
    ) -> Vec<RestoredTask> {
        let records = lock(&self.records);
        let ended = records.ended(Moment::now()).into_iter();
        ended.map(|(spec, task)| told(spec, task)).collect()
    }

    /// The journal of one device.
    pub(super) fn of_device(&self, device: &str) -> DeviceJournal<JournalFile> {
        DeviceJournal::new(Arc::clone(&self.records), device, Moment::now)
    }
}

/// Checks regularly whether something else altered the journal, while it is open, and reserves task ids in time.
fn watch(records: Weak<Mutex<JournalRecords<JournalFile>>>) {
    let check = move || {
        if let Some(records) = records.upgrade() {
            lock(&records).reserved_ids().set_thread(thread::current());
        }
        while let Some(records) = records.upgrade() {
            // A failure is logged there, and the check is repeated.
            let _ = lock(&records).check(Moment::now());
            drop(records);
            thread::park_timeout(CHECK);
        }
    };
    // Without a thread, each write still does this.
    let _ = thread::Builder::new()
        .name("ztl-journal".to_owned())
        .spawn(check);
}
