//! A journal's file, its lock, and the earlier files.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use tracing::warn;

use super::entry::{is_journal, last_process};
use super::error::JournalError;
use super::records::Storage;
use crate::files;
use crate::log_targets::GATEWAY;

/// Earlier files that are kept; `.1` is the latest.
const KEPT: u32 = 3;
/// How long to wait for another gateway that ends or only checks the journal.
const PATIENCE: Duration = Duration::from_millis(500);
/// Pause before the lock is tried again.
const RETRY: Duration = Duration::from_millis(10);

/// A file with one writer. The lock belongs to the file, so its other names are locked as well.
#[derive(Debug)]
pub(in crate::gateway) struct JournalFile {
    /// Without symbolic links, so that a new file replaces the old one and not a link.
    path: PathBuf,
    /// Locked.
    file: File,
    /// Earlier files that have names other than `….1`, locked.
    linked: Vec<File>,
    /// Bytes of complete lines.
    len: u64,
    /// Whether an incomplete line follows them.
    torn: bool,
}

/// Checks whether a journal can be opened, without changing anything.
pub(super) fn check(path: &Path) -> Result<(), JournalError> {
    let failed = |cause| JournalError::Place {
        path: path.to_owned(),
        cause,
    };
    match OpenOptions::new().read(true).append(true).open(path) {
        Err(cause) if cause.kind() == io::ErrorKind::NotFound && can_create(path) => {}
        file => {
            let mut file = file.and_then(is_regular).map_err(failed)?;
            lock(&file, path)?;
            let mut written = Vec::new();
            file.read_to_end(&mut written).map_err(failed)?;
            demand_journal(path, &written)?;
        }
    }
    // Opening creates directories, and later new files beside the journal.
    let mut directories = path.ancestors().skip(1);
    let directory = directories.find(|path| {
        // A link without a target also prevents a directory.
        path.as_os_str().is_empty() || path.symlink_metadata().is_ok()
    });
    let name = format!(".ztl-check-{}", std::process::id());
    let trial = directory.unwrap_or(Path::new("")).join(name);
    let created = OpenOptions::new().write(true).create_new(true).open(&trial);
    created
        .and_then(|_| fs::remove_file(&trial))
        .map_err(failed)
}

impl JournalFile {
    /// Opens a file; returns its content as well.
    pub(super) fn open(path: &Path) -> Result<(Self, Vec<u8>), JournalError> {
        let failed = |cause| JournalError::Place {
            path: path.to_owned(),
            cause,
        };
        make_directory(path).map_err(failed)?;
        let (path, mut file) = Self::locked(path, failed)?;
        let mut written = Vec::new();
        file.read_to_end(&mut written).map_err(failed)?;
        demand_journal(&path, &written)?;
        // Left by a gateway that ended before it could rename it.
        let _ = fs::remove_file(beside(&path, "new"));
        sync_directory(&path);
        let paper = Self {
            path,
            file,
            linked: Vec::new(),
            len: written.len() as u64,
            torn: false,
        };
        Ok((paper, written))
    }

    /// Opens and locks the file; returns its real path as well.
    fn locked(
        path: &Path,
        failed: impl Fn(io::Error) -> JournalError,
    ) -> Result<(PathBuf, File), JournalError> {
        loop {
            let file = open(path).and_then(is_regular).map_err(&failed)?;
            let real = fs::canonicalize(path).map_err(&failed)?;
            lock(&file, path)?;
            // Otherwise the gateway that had it has just started a new file.
            if is_at(&file, &real) {
                return Ok((real, file));
            }
        }
    }

    /// Cuts off an incomplete line.
    fn repair(&mut self) -> io::Result<()> {
        if self.torn {
            self.file.set_len(self.len)?;
            self.torn = false;
        }
        Ok(())
    }

    fn write(&mut self, lines: &[u8], sync: bool) -> io::Result<()> {
        self.file.write_all(lines)?;
        if sync {
            self.file.sync_data()?;
        }
        Ok(())
    }

    /// Writes a new file, locked before it replaces this one.
    fn start_new(&self, new: &Path, lines: &[u8]) -> io::Result<File> {
        let _ = fs::remove_file(new);
        let mut options = OpenOptions::new();
        let mut file = options.read(true).append(true).create_new(true).open(new)?;
        file.try_lock()?;
        file.write_all(lines)?;
        // Even without `sync`: the old file must not vanish before this one is on the disk.
        file.sync_all()?;
        // If there is another file now, no other gateway may have it.
        let other = self.path.exists().then(|| open(&self.path)).transpose()?;
        if let Some(other) = &other {
            if !is_at(&self.file, &self.path) {
                other.try_lock()?;
            }
            self.keep()?;
        }
        fs::rename(new, &self.path)?;
        sync_directory(&self.path);
        Ok(file)
    }

    /// Keeps the current file as `.1`.
    fn keep(&self) -> io::Result<()> {
        for number in (1..KEPT).rev() {
            let from = beside(&self.path, &number.to_string());
            let to = beside(&self.path, &(number + 1).to_string());
            match fs::rename(from, to) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        let kept = beside(&self.path, "1");
        // Not renamed, since there must be a journal at any moment.
        fs::hard_link(&self.path, &kept).or_else(|_| fs::copy(&self.path, &kept).map(drop))
    }
}

impl Storage for JournalFile {
    fn add(&mut self, lines: &[u8], sync: bool) -> io::Result<()> {
        self.repair()?;
        let written = self.write(lines, sync);
        match &written {
            Ok(()) => self.len += lines.len() as u64,
            Err(_) => {
                self.torn = true;
                // If this fails, it is tried again before the next lines.
                let _ = self.repair();
            }
        }
        written
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.len = len;
        self.torn = true;
        self.repair()
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        let new = beside(&self.path, "new");
        let is_kept = is_at(&self.file, &self.path);
        let file = self.start_new(&new, lines).inspect_err(|_| {
            let _ = fs::remove_file(&new);
        })?;
        let before = std::mem::replace(&mut self.file, file);
        if names(&before) > u64::from(is_kept) {
            // A gateway that opens it by that name would have these tasks as well.
            self.linked.push(before);
        }
        self.len = lines.len() as u64;
        self.torn = false;
        Ok(())
    }

    fn altered(&self) -> Option<String> {
        if !is_at(&self.file, &self.path) {
            let there = self.path.exists();
            return Some(if there { "was replaced" } else { "was removed" }.to_owned());
        }
        let len = self.file.metadata().ok()?.len();
        match len.checked_sub(self.len) {
            None => {
                let missing = self.len - len;
                Some(format!("was cut: {missing} bytes are missing"))
            }
            Some(more) if more > 0 && !self.torn => Some(format!(
                "was changed by another program: {more} bytes were added"
            )),
            Some(_) => None,
        }
    }

    fn place(&self) -> String {
        self.path.display().to_string()
    }
}

/// Rejects a file that is not a journal, before it is changed.
fn demand_journal(path: &Path, written: &[u8]) -> Result<(), JournalError> {
    match is_journal(written) {
        true => Ok(()),
        false => Err(JournalError::Foreign {
            path: path.to_owned(),
        }),
    }
}

fn is_regular(file: File) -> io::Result<File> {
    files::regular(&file.metadata()?)?;
    Ok(file)
}

/// Whether a missing file could be created: a symbolic link needs its target's directory.
fn can_create(path: &Path) -> bool {
    let Ok(target) = fs::read_link(path) else {
        return true;
    };
    let target = path.parent().unwrap_or(Path::new("")).join(target);
    // A bare name is in the link's directory.
    let is_there = |path: &Path| path.as_os_str().is_empty() || path.is_dir();
    target.parent().is_some_and(is_there)
}

/// Locks a journal, if no other gateway has it.
fn lock(mut file: &File, path: &Path) -> Result<(), JournalError> {
    let start = Instant::now();
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(()),
            Err(TryLockError::WouldBlock) if start.elapsed() < PATIENCE => {
                std::thread::sleep(RETRY);
            }
            Err(TryLockError::WouldBlock) => {
                let mut written = Vec::new();
                // If the lock forbids reading, the process stays unknown.
                let _ = file.read_to_end(&mut written);
                return Err(JournalError::InUse {
                    path: path.to_owned(),
                    by: last_process(&written),
                });
            }
            Err(TryLockError::Error(cause)) => {
                return Err(JournalError::Place {
                    path: path.to_owned(),
                    cause,
                });
            }
        }
    }
}

fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true).append(true).create(true).open(path)
}

/// Whether a path leads to this file.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;

    let place = |metadata: fs::Metadata| (metadata.dev(), metadata.ino());
    let ours = file.metadata().map(place).ok();
    ours.is_some() && ours == fs::metadata(path).map(place).ok()
}

/// Unknown on this system.
#[cfg(not(unix))]
fn is_at(_file: &File, path: &Path) -> bool {
    path.exists()
}

/// How many names a file has.
#[cfg(unix)]
fn names(file: &File) -> u64 {
    use std::os::unix::fs::MetadataExt;

    file.metadata().map_or(1, |metadata| metadata.nlink())
}

/// Unknown on this system.
#[cfg(not(unix))]
fn names(_file: &File) -> u64 {
    1
}

/// Creates the directory of a file, so that it survives a power cut.
fn make_directory(path: &Path) -> io::Result<()> {
    let Some(directory) = path.parent() else {
        return Ok(());
    };
    let new = directory.ancestors().take_while(|path| !path.exists());
    let new: Vec<&Path> = new.collect();
    fs::create_dir_all(directory)?;
    new.into_iter().for_each(sync_directory);
    Ok(())
}

/// Syncs the directory entry of a file.
fn sync_directory(path: &Path) {
    let directory = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    let directory = directory.unwrap_or(Path::new("."));
    let synced = File::open(directory).and_then(|directory| directory.sync_all());
    if let Err(error) = synced
        && cfg!(unix)
    {
        let (path, directory) = (path.display(), directory.display());
        warn!(target: GATEWAY, "Journal {path}: it may not survive a power cut, since {directory} cannot be synced: {error}");
    }
}

/// The path with an extension added.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}

#[cfg(test)]
mod tests;
