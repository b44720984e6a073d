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
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use ztl_core::envelope::ClientId;
use ztl_core::{State, TaskId};

use crate::random;
use crate::server::{Claim, RestoredTask};
use file::Paper;
pub use line::Moment;
pub use log::{Log, Storage};
use ztl_link::{Entry, Restored, SessionJournal};

/// How often it is looked whether somebody else altered the journal.
const LOOK: Duration = Duration::from_secs(1);

/// A task whose `Start` was not written within this time after its INIT is refused. So no client is told the
/// id of a task (after 1.5 s, at a slow device) that the journal does not have.
pub(in crate::gateway) const DECIDED: Duration = Duration::from_millis(1200);

/// Why such a task is refused.
pub(in crate::gateway) const UNWRITTEN: &str = "the journal has not been written for 1.2 s, so the task was not started; is its disk too slow?";

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
    /// The file holds something else.
    Foreign {
        /// The file.
        path: PathBuf,
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
            Self::Foreign { path } => write!(
                f,
                "{} is not a journal, and was left as it is; name another file",
                path.display()
            ),
            Self::Place { path, cause } => {
                write!(f, "the journal cannot lie at {}: {cause}", path.display())
            }
        }
    }
}

impl std::error::Error for JournalError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::InUse { .. } | Self::Foreign { .. } => None,
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
        let (paper, written) = Paper::open(&path)?;
        let log = Log::open(paper, &written, Moment::now(), random::number()).with_sync(sync);
        let log = Arc::new(Mutex::new(log));
        look_at(Arc::downgrade(&log));
        Ok(Self { log, path })
    }

    /// Tries whether a journal can be opened there, and leaves everything as it is.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn check(path: &Path) -> Result<(), JournalError> {
        file::check(path)
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

/// Looks now and then whether somebody else altered the journal, as long as it is open.
fn look_at(log: Weak<Mutex<Log<Paper>>>) {
    let look = move || {
        while let Some(log) = log.upgrade() {
            // It says what is wrong, and is tried again.
            let _ = lock(&log).look(Moment::now());
            drop(log);
            std::thread::sleep(LOOK);
        }
    };
    // Without a thread it is looked at each write.
    let _ = std::thread::Builder::new()
        .name("ztl-journal".to_owned())
        .spawn(look);
}

/// A device's hand in a journal: the book of its session.
#[derive(Debug)]
pub struct DeviceBook<S> {
    log: Shared<S>,
    device: String,
    now: fn() -> Moment,
    /// Tasks that are not started yet.
    asked: HashMap<TaskId, Asked>,
}

/// A task that is not started yet.
#[derive(Debug)]
struct Asked {
    /// Who asked for it, where it is known.
    client: Option<ClientId>,
    claim: Claim,
}

impl<S: Storage> DeviceBook<S> {
    /// Writes what becomes of the tasks of this device.
    pub fn new(log: Arc<Mutex<Log<S>>>, device: &str, now: fn() -> Moment) -> Self {
        Self {
            log,
            device: device.to_owned(),
            now,
            asked: HashMap::new(),
        }
    }

    /// A task is about to be started, if it is claimed before its client is told that it is refused.
    pub(super) fn asked(&mut self, id: TaskId, client: Option<ClientId>, claim: Claim) {
        self.asked.insert(id, Asked { client, claim });
    }

    /// The task was not started.
    pub(super) fn forget(&mut self, id: TaskId) {
        self.asked.remove(&id);
    }

    fn client(&self, id: TaskId) -> Option<String> {
        let ClientId(bytes) = self.asked.get(&id)?.client?;
        Some(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

impl<S: Storage> SessionJournal for DeviceBook<S> {
    fn starting(&mut self, task: &Entry<'_>) -> Result<(), String> {
        let client = self.client(task.id);
        lock(&self.log).starting((self.now)(), &self.device, client, task)?;
        // The journal knows the client from now on.
        let asked = self.asked.remove(&task.id);
        if asked.is_none_or(|asked| asked.claim.take()) {
            return Ok(());
        }
        // Nobody was told its id, so it does not matter whether this is written.
        let refused = (State::Rejected, UNWRITTEN);
        let _ = lock(&self.log).ended_as((self.now)(), &self.device, task, refused);
        Err(UNWRITTEN.to_owned())
    }

    fn accepted(&mut self, task: &Entry<'_>) {
        // Restored from its `Start`, it would end in the same ways.
        let _ = lock(&self.log).accepted((self.now)(), &self.device, task);
    }

    fn ended(&mut self, task: &Entry<'_>, state: State, text: &str) -> Result<(), String> {
        lock(&self.log).ended_as((self.now)(), &self.device, task, (state, text))
    }
}
