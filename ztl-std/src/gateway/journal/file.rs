//! A journal's file, its lock, and the files before it.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use super::JournalError;
use super::log::Storage;

/// Files before the present one that are kept: `.1` is the youngest.
const KEPT: u32 = 3;

/// A file of which there is one writer.
#[derive(Debug)]
pub(in crate::gateway) struct Paper {
    path: PathBuf,
    file: File,
    /// Bytes of whole lines.
    len: u64,
    /// Something stands behind them.
    torn: bool,
    /// Each line that is needed is to survive a power cut, too.
    sync: bool,
    /// Of a file of its own, since the journal's is replaced.
    _lock: File,
}

impl Paper {
    /// Opens a file, and reads what it holds.
    pub(super) fn open(path: &Path, sync: bool) -> Result<(Self, Vec<u8>), JournalError> {
        let failed = |cause| JournalError::Place {
            path: path.to_owned(),
            cause,
        };
        if let Some(directory) = path.parent() {
            fs::create_dir_all(directory).map_err(failed)?;
        }
        let lock = lock(path)?;
        // From a gateway that ended before it could take the place of the other.
        let _ = fs::remove_file(beside(path, "new"));
        let mut file = open(path).map_err(failed)?;
        if sync {
            sync_directory(path);
        }
        if !file.metadata().map_err(failed)?.is_file() {
            let kind = io::ErrorKind::InvalidInput;
            return Err(failed(io::Error::new(kind, "it is not a regular file")));
        }
        let mut written = Vec::new();
        file.read_to_end(&mut written).map_err(failed)?;
        let paper = Self {
            path: path.to_owned(),
            file,
            len: written.len() as u64,
            torn: false,
            sync,
            _lock: lock,
        };
        Ok((paper, written))
    }

    fn mend(&mut self) -> io::Result<()> {
        if self.torn {
            self.file.set_len(self.len)?;
            self.torn = false;
        }
        Ok(())
    }

    fn write(&mut self, lines: &[u8], needed: bool) -> io::Result<()> {
        self.file.write_all(lines)?;
        if self.sync && needed {
            self.file.sync_data()?;
        }
        Ok(())
    }

    /// Makes room for another `.1`, and keeps the present file under that name.
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
        // Not renamed: there must be a journal at any moment.
        fs::hard_link(&self.path, &kept).or_else(|_| fs::copy(&self.path, &kept).map(drop))
    }
}

impl Storage for Paper {
    fn add(&mut self, lines: &[u8], needed: bool) -> io::Result<()> {
        self.mend()?;
        let written = self.write(lines, needed);
        match &written {
            Ok(()) => self.len += lines.len() as u64,
            Err(_) => {
                self.torn = true;
                // Else before the next lines.
                let _ = self.mend();
            }
        }
        written
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.len = len;
        self.torn = true;
        self.mend()
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        let new = beside(&self.path, "new");
        let write = || {
            let mut file = File::create(&new)?;
            file.write_all(lines)?;
            // Before it takes the place of the other, whatever is cut: it happens seldom.
            file.sync_all()?;
            if self.path.exists() {
                self.keep()?;
            }
            fs::rename(&new, &self.path)?;
            if self.sync {
                sync_directory(&self.path);
            }
            open(&self.path)
        };
        let file = write().inspect_err(|_| {
            let _ = fs::remove_file(&new);
        })?;
        self.file = file;
        self.len = lines.len() as u64;
        self.torn = false;
        Ok(())
    }

    #[cfg(unix)]
    fn is_gone(&self) -> bool {
        use std::os::unix::fs::MetadataExt;

        let place = |metadata: fs::Metadata| (metadata.dev(), metadata.ino());
        let ours = self.file.metadata().map(place).ok();
        ours != fs::metadata(&self.path).map(place).ok()
    }

    fn place(&self) -> String {
        self.path.display().to_string()
    }
}

fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true).append(true).create(true).open(path)
}

/// Puts the file's name on the disk, where the system can do that.
fn sync_directory(path: &Path) {
    let directory = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    let directory = File::open(directory.unwrap_or(Path::new(".")));
    let _ = directory.and_then(|directory| directory.sync_all());
}

/// The path with another ending behind its own.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}

/// Keeps every other gateway out; the system takes the lock back when this process ends.
fn lock(path: &Path) -> Result<File, JournalError> {
    let at = beside(path, "lock");
    let failed = |cause| JournalError::Place {
        path: at.clone(),
        cause,
    };
    let mut options = OpenOptions::new();
    let options = options.read(true).write(true).create(true).truncate(false);
    let mut file = options.open(&at).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let mut by = String::new();
            let _ = file.read_to_string(&mut by);
            return Err(JournalError::InUse {
                path: path.to_owned(),
                by: by.trim().parse().ok(),
            });
        }
        Err(TryLockError::Error(cause)) => return Err(failed(cause)),
    }
    // Who has it, for the one who comes in vain.
    let _ = file.set_len(0);
    let _ = writeln!(file, "{}", std::process::id());
    Ok(file)
}

#[cfg(test)]
mod tests;
