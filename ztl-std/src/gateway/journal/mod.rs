//! The gateway's journal: what it promised, so that it keeps it after a restart.
//!
//! A task's id is written before its `Start` is sent, its end before the device has an `Ack` and
//! before anybody is told. `docs/journal.md` says what is in a file, and where it lies.

mod file;
mod line;
mod log;

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ztl_core::envelope::ClientId;
use ztl_core::{State, TaskId};

use super::session::{Book, Entry, Restored};
use crate::random;
use crate::server::RestoredTask;
use file::Paper;
pub use line::Moment;
pub use log::{Log, Storage};

/// Why a journal cannot be used.
#[derive(Debug)]
#[non_exhaustive]
pub enum JournalError {
    /// Another gateway writes it.
    InUse {
        /// The journal.
        path: PathBuf,
        /// The process that has it, where it said so.
        by: Option<u32>,
    },
    /// It, or its directory, cannot be read and written.
    Place {
        /// What cannot.
        path: PathBuf,
        /// What the operating system says.
        cause: io::Error,
    },
}

impl std::fmt::Display for JournalError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::InUse { path, by } => {
                write!(f, "the journal {} is another gateway's", path.display())?;
                if let Some(by) = by {
                    write!(f, " (process {by})")?;
                }
                f.write_str("; stop that one, or give this one another file")
            }
            Self::Place { path, cause } => {
                write!(f, "the journal cannot lie at {}: {cause}", path.display())
            }
        }
    }
}

impl std::error::Error for JournalError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::InUse { .. } => None,
            Self::Place { cause, .. } => Some(cause),
        }
    }
}

/// A device's hand in a journal that is a file.
pub(super) type FileBook = DeviceBook<Paper>;

type Shared<S> = Arc<Mutex<Log<S>>>;

fn lock<S>(log: &Shared<S>) -> MutexGuard<'_, Log<S>> {
    log.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A journal in a file.
#[derive(Debug, Clone)]
pub struct Journal {
    log: Shared<Paper>,
    path: PathBuf,
}

impl Journal {
    /// Opens a journal, makes it if there is none, and mends what a crash left. With `sync` each
    /// line is on the disk before anything follows from it, and so outlives a power cut of this
    /// machine; without, it outlives the end of the process.
    ///
    /// # Errors
    /// As [`JournalError`] says. A disk that is full is none: tasks are then refused with that
    /// reason, until there is room again.
    pub fn open(path: impl AsRef<Path>, sync: bool) -> Result<Self, JournalError> {
        let path = path.as_ref().to_owned();
        let (paper, written) = Paper::open(&path, sync)?;
        let log = Log::open(paper, &written, Moment::now(), random::number());
        let log = Arc::new(Mutex::new(log));
        Ok(Self { log, path })
    }

    /// Where it lies.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn gateway(&self) -> u64 {
        lock(&self.log).gateway()
    }

    pub(super) fn last_id(&self) -> Option<TaskId> {
        lock(&self.log).last_id()
    }

    /// The tasks that have no end, each with its device's name.
    pub(super) fn unended(&self) -> Vec<(String, Restored)> {
        lock(&self.log).unended()
    }

    /// The tasks that have ended, as their clients were told.
    pub(super) fn ended(
        &self,
        told: impl Fn([&str; 3], RestoredTask) -> RestoredTask,
    ) -> Vec<RestoredTask> {
        let log = lock(&self.log);
        let ended = log.ended(Moment::now()).into_iter();
        ended.map(|(spec, task)| told(spec, task)).collect()
    }

    pub(super) fn book(&self, device: &str) -> FileBook {
        DeviceBook::new(Arc::clone(&self.log), device, Moment::now)
    }
}

/// A device's hand in a journal: the book of its session.
#[derive(Debug)]
pub struct DeviceBook<S> {
    log: Shared<S>,
    device: String,
    now: fn() -> Moment,
    /// Who asked for the tasks that are not started yet, where it is known.
    clients: HashMap<TaskId, ClientId>,
}

impl<S: Storage> DeviceBook<S> {
    /// Writes what becomes of the tasks of this device.
    pub fn new(log: Arc<Mutex<Log<S>>>, device: &str, now: fn() -> Moment) -> Self {
        Self {
            log,
            device: device.to_owned(),
            now,
            clients: HashMap::new(),
        }
    }

    /// Who asks for the task that is about to be started.
    pub(super) fn asked_by(&mut self, id: TaskId, client: ClientId) {
        self.clients.insert(id, client);
    }

    /// The task was not started.
    pub(super) fn forget(&mut self, id: TaskId) {
        self.clients.remove(&id);
    }

    fn client(&self, id: TaskId) -> Option<String> {
        let ClientId(bytes) = self.clients.get(&id)?;
        Some(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

impl<S: Storage> Book for DeviceBook<S> {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        let client = self.client(task.id);
        lock(&self.log).starting((self.now)(), &self.device, client, task)?;
        // Known from the line before, from now on.
        self.forget(task.id);
        Ok(())
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        // Restored from its `Start`, it would end in the same ways.
        let _ = lock(&self.log).accepted((self.now)(), &self.device, task);
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String> {
        lock(&self.log).ended_as((self.now)(), &self.device, task, (state, text))
    }
}
