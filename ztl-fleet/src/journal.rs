//! What an agent must know after a restart: its id, and its last INITs.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use crate::agent::Entry;
use crate::wire::{from_hex, hex};
use ztl_core::envelope::ClientId;

/// A journal that is longer is written anew, in bytes.
const LONGEST: u64 = 4 << 20;

/// An agent's directory.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: File,
    written: u64,
    longest: u64,
    /// Held for as long as the agent runs.
    _lock: File,
}

/// What was found in an agent's directory.
#[derive(Debug)]
pub struct Found {
    /// The agent's id: 32 hexadecimal digits.
    pub agent: String,
    /// The entries, oldest first.
    pub entries: Vec<Entry>,
    /// Whether none can be missing: all were written since the system was started, so that a power failure lost none.
    pub complete: bool,
}

impl Journal {
    /// Opens the directory, which is created if needed. `random` identifies a new agent.
    ///
    /// # Errors
    /// The system's, with the path; also if another agent uses the directory.
    pub fn open(directory: &Path, random: ClientId) -> io::Result<(Self, Found)> {
        let at = |error: io::Error| {
            let message = format!("{}: {error}", directory.display());
            io::Error::new(error.kind(), message)
        };
        Self::open_in(directory, random).map_err(at)
    }

    fn open_in(directory: &Path, random: ClientId) -> io::Result<(Self, Found)> {
        fs::create_dir_all(directory)?;
        let lock = File::create(directory.join("lock"))?;
        lock.try_lock()
            .map_err(|_| io::Error::other("another agent uses this directory"))?;
        let id = directory.join("id");
        let known = fs::read_to_string(&id).unwrap_or_default();
        let agent = match from_hex(known.trim()) {
            Some(known) => hex(&known),
            None => {
                let new = hex(&random);
                write_whole(&id, new.as_bytes())?;
                new
            }
        };
        let path = directory.join("journal");
        let text = fs::read(&path).unwrap_or_default();
        let text = String::from_utf8_lossy(&text);
        let mut lines = text.split_inclusive('\n');
        let system = lines.next().unwrap_or_default().trim_end();
        let complete = !system.is_empty() && system == system_boot();
        // The last line may be incomplete: it was being written when the agent was killed, so it was not acted on.
        let whole = lines.filter(|line| line.ends_with('\n'));
        let entries = whole.filter_map(|line| serde_json::from_str(line).ok());
        let found = Found {
            agent,
            entries: entries.collect(),
            complete,
        };
        let file = OpenOptions::new().create(true).append(true).open(&path)?;
        let journal = Self {
            path,
            file,
            written: 0,
            longest: LONGEST,
            _lock: lock,
        };
        Ok((journal, found))
    }

    /// Replaces all entries.
    ///
    /// # Errors
    /// The system's; the entries before are still there then.
    pub fn rewrite(&mut self, entries: &[Entry]) -> io::Result<()> {
        let mut bytes = format!("{}\n", system_boot()).into_bytes();
        for entry in entries {
            line(entry, &mut bytes)?;
        }
        write_whole(&self.path, &bytes)?;
        self.file = OpenOptions::new().append(true).open(&self.path)?;
        self.written = bytes.len() as u64;
        self.longest = LONGEST.max(2 * self.written);
        Ok(())
    }

    /// Appends an entry. It survives the end of this process; [`Found::complete`] tells whether the system was restarted.
    ///
    /// # Errors
    /// The system's.
    pub fn append(&mut self, entry: &Entry) -> io::Result<()> {
        let mut bytes = Vec::new();
        line(entry, &mut bytes)?;
        if let Err(error) = self.file.write_all(&bytes) {
            // What follows must not be read as a part of this line.
            self.file.set_len(self.written)?;
            return Err(error);
        }
        self.written += bytes.len() as u64;
        Ok(())
    }

    /// Whether it is time to [`rewrite`](Self::rewrite) it.
    #[must_use]
    pub const fn is_long(&self) -> bool {
        self.written > self.longest
    }
}

fn line(entry: &Entry, bytes: &mut Vec<u8>) -> io::Result<()> {
    serde_json::to_writer(&mut *bytes, entry)?;
    bytes.push(b'\n');
    Ok(())
}

/// Replaces a file at once.
fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let new = path.with_extension("new");
    let mut file = File::create(&new)?;
    file.write_all(bytes)?;
    file.sync_all()?;
    fs::rename(new, path)
}

/// Identifies the start of the system; empty where it cannot be told.
fn system_boot() -> String {
    let id = fs::read_to_string("/proc/sys/kernel/random/boot_id");
    id.unwrap_or_default().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::InitId;

    fn given_up(number: u64) -> Entry {
        Entry::GivenUp(InitId {
            client: ClientId([3; 16]),
            number,
        })
    }

    #[test]
    fn entries_and_the_id_survive_and_a_torn_line_is_dropped() {
        let name = format!("ztl-fleet-journal-{}", std::process::id());
        let directory = std::env::temp_dir().join(name);
        let (mut journal, found) = Journal::open(&directory, ClientId([1; 16])).unwrap();
        assert_eq!((found.entries.len(), found.complete), (0, false));
        assert_eq!(found.agent, "01".repeat(16));
        journal.rewrite(&[Entry::Boot(7)]).unwrap();
        journal.append(&given_up(1)).unwrap();
        let second = Journal::open(&directory, ClientId([2; 16]));
        assert!(second.is_err_and(|error| error.to_string().contains("another agent")));
        journal.file.write_all(b"{\"given_up\":[\"03").unwrap();
        drop(journal);
        let (_journal, found) = Journal::open(&directory, ClientId([2; 16])).unwrap();
        assert_eq!(found.agent, "01".repeat(16));
        assert_eq!(found.entries, [Entry::Boot(7), given_up(1)]);
        assert!(found.complete);
        fs::remove_dir_all(directory).unwrap();
    }
}
