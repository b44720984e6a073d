//! What an agent must know after a restart: its id, and its last INITs.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use tracing::warn;
use ztl_core::envelope::ClientId;

use crate::agent::Entry;
use crate::wire::{from_hex, hex};

/// A journal that is longer is written anew, in bytes.
const LONGEST: u64 = 4 << 20;
/// After a failure, that is tried again when it is longer by so many bytes.
const AGAIN: u64 = 64 << 10;
/// Begins the first line of a journal that lacks entries. It takes the place of [`WHOLE`], for which a full disk has room.
const LACKS: char = '!';
/// Begins the first line of every other journal.
const WHOLE: char = '=';

/// An agent's directory.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    file: File,
    written: u64,
    longest: u64,
    /// The last entry may have been written in part.
    torn: bool,
    /// Of this start of the system and this directory.
    place: String,
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
    /// Whether none can be missing: all were written since the system was started, so that a power failure lost none, and in
    /// this directory, not in one of which it is a copy.
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
        lock.try_lock().map_err(|_| {
            io::Error::other(
                "another agent uses this directory; stop it, or name another one as 'state'",
            )
        })?;
        let id = directory.join("id");
        let known = fs::read(&id);
        let is_new = matches!(&known, Err(error) if error.kind() == io::ErrorKind::NotFound);
        let known = String::from_utf8_lossy(&known.unwrap_or_default()).into_owned();
        let agent = match from_hex(known.trim()) {
            Some(known) => hex(&known),
            None => {
                let new = hex(&random);
                write_whole(&id, new.as_bytes())?;
                if !is_new {
                    warn!(target: "fleet", "{} did not hold the agent's id, 32 hexadecimal digits; it has a new one now.", id.display());
                }
                new
            }
        };
        let path = directory.join("journal");
        let text = fs::read(&path).unwrap_or_default();
        let text = String::from_utf8_lossy(&text);
        let mut lines = text.split_inclusive('\n');
        let system = lines.next().unwrap_or_default().trim_end();
        let lacks = system.starts_with(LACKS);
        let system = system.strip_prefix(WHOLE).unwrap_or_default();
        let place = place(&lock);
        let complete = !system.is_empty() && system == place;
        // The last line may be incomplete: it was being written when the agent was killed, so it was not acted on.
        let whole = lines.filter(|line| line.ends_with('\n'));
        let entries = whole.filter_map(|line| serde_json::from_str(line).ok());
        let found = Found {
            agent,
            entries: entries.chain(lacks.then_some(Entry::Lacks)).collect(),
            complete,
        };
        let file = OpenOptions::new().create(true).append(true).open(&path)?;
        let journal = Self {
            path,
            file,
            written: 0,
            longest: LONGEST,
            torn: false,
            place,
            _lock: lock,
        };
        Ok((journal, found))
    }

    /// Replaces all entries, also what it lacked.
    ///
    /// # Errors
    /// The system's, with the path. The journal is as before then.
    pub fn rewrite(&mut self, entries: &[Entry]) -> io::Result<()> {
        let mut bytes = format!("{WHOLE}{}\n", self.place).into_bytes();
        for entry in entries {
            line(entry, &mut bytes)?;
        }
        match write_whole(&self.path, &bytes) {
            Ok(file) => self.file = file,
            Err(error) => {
                self.longest = self.written + AGAIN;
                let message = format!("{}: {error}", self.path.display());
                return Err(io::Error::new(error.kind(), message));
            }
        }
        self.written = bytes.len() as u64;
        self.longest = LONGEST.max(2 * self.written);
        self.torn = false;
        Ok(())
    }

    /// Appends an entry. It survives the end of this process; [`Found::complete`] tells whether the system was restarted.
    ///
    /// # Errors
    /// The system's. The entry may be found later nevertheless.
    pub fn append(&mut self, entry: &Entry) -> io::Result<()> {
        let mut bytes = Vec::new();
        if self.torn {
            bytes.push(b'\n');
        }
        line(entry, &mut bytes)?;
        self.torn = true;
        self.file.write_all(&bytes)?;
        self.torn = false;
        self.written += bytes.len() as u64;
        Ok(())
    }

    /// Writes down that an entry is missing, until the journal is rewritten: [`Entry::Lacks`] is found then.
    ///
    /// # Errors
    /// The system's.
    pub fn mark(&mut self) -> io::Result<()> {
        self.longest = 0;
        let mut file = OpenOptions::new().write(true).open(&self.path)?;
        file.write_all(&[LACKS as u8])
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

/// Replaces a file at once. Returns the new one, to append to it.
fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<File> {
    let new = path.with_extension("new");
    let write = || {
        let mut file = OpenOptions::new().create(true).append(true).open(&new)?;
        file.set_len(0)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(&new, path)?;
        Ok(file)
    };
    write().inspect_err(|_| {
        // A full disk needs the room.
        let _ = fs::remove_file(&new);
    })
}

/// Identifies the start of the system, and the directory by a file that a copy does not share; empty where it cannot be told.
fn place(file: &File) -> String {
    let id = fs::read_to_string("/proc/sys/kernel/random/boot_id");
    match (id.unwrap_or_default().trim(), inode(file)) {
        (boot, Some(inode)) if !boot.is_empty() => format!("{boot} {inode}"),
        _ => String::new(),
    }
}

#[cfg(unix)]
fn inode(file: &File) -> Option<u64> {
    use std::os::unix::fs::MetadataExt as _;

    file.metadata().ok().map(|metadata| metadata.ino())
}

#[cfg(not(unix))]
fn inode(_: &File) -> Option<u64> {
    None
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

    fn directory(name: &str) -> PathBuf {
        let name = format!("ztl-fleet-{name}-{}", std::process::id());
        std::env::temp_dir().join(name)
    }

    #[test]
    fn a_journal_that_cannot_be_written_says_so_until_it_is_rewritten() {
        let directory = directory("lacks");
        let (mut journal, _) = Journal::open(&directory, ClientId([1; 16])).unwrap();
        journal.rewrite(&[Entry::Boot(7)]).unwrap();
        // A file that is open for reading cannot be appended to, as one on a full disk.
        let file = File::open(&journal.path).unwrap();
        let file = std::mem::replace(&mut journal.file, file);
        journal.append(&given_up(1)).unwrap_err();
        journal.mark().unwrap();
        journal.file = file;
        // The rest of an entry that was written in part does not spoil the next one.
        journal.file.write_all(b"{\"given_up\":[\"03").unwrap();
        journal.append(&given_up(2)).unwrap();
        assert!(journal.is_long());
        drop(journal);
        let (mut journal, found) = Journal::open(&directory, ClientId([1; 16])).unwrap();
        let expected = [Entry::Boot(7), given_up(2), Entry::Lacks];
        assert_eq!((&found.entries[..], found.complete), (&expected[..], false));
        // A directory in its place keeps it from being rewritten, and it stays as it is.
        let new = journal.path.with_extension("new");
        fs::create_dir(&new).unwrap();
        journal.rewrite(&[]).unwrap_err();
        fs::remove_dir(&new).unwrap();
        journal.append(&given_up(3)).unwrap();
        assert_eq!(
            fs::read_to_string(&journal.path).unwrap().lines().count(),
            5
        );
        journal.rewrite(&[Entry::Boot(7)]).unwrap();
        journal.append(&given_up(4)).unwrap();
        drop(journal);
        let (_journal, found) = Journal::open(&directory, ClientId([1; 16])).unwrap();
        assert_eq!(found.entries, [Entry::Boot(7), given_up(4)]);
        assert!(found.complete);
        fs::remove_dir_all(directory).unwrap();
    }

    #[test]
    fn a_copy_of_a_directory_does_not_take_its_journal_for_complete() {
        let (first, copy) = (directory("first"), directory("copy"));
        let (mut journal, _) = Journal::open(&first, ClientId([1; 16])).unwrap();
        journal.rewrite(&[Entry::Boot(7)]).unwrap();
        fs::create_dir(&copy).unwrap();
        for file in ["id", "journal", "lock"] {
            fs::copy(first.join(file), copy.join(file)).unwrap();
        }
        drop(journal);
        let complete = [&first, &copy].map(|directory| {
            let (_journal, found) = Journal::open(directory, ClientId([2; 16])).unwrap();
            assert_eq!(found.agent, "01".repeat(16));
            found.complete
        });
        assert_eq!(complete, [true, false]);
        for directory in [first, copy] {
            fs::remove_dir_all(directory).unwrap();
        }
    }

    #[test]
    fn entries_and_the_id_survive_and_a_torn_line_is_dropped() {
        let directory = directory("journal");
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
