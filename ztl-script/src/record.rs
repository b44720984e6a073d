//! The record of a run: one [`StampedEvent`] per line, as JSON. `docs/record.md` is the schema.

use std::fmt;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, ErrorKind, Write};
use std::path::Path;

use crate::event::{FORMAT, RunEvent, RunStarted, StampedEvent};

/// Longest line to read. Only the outline of a huge script comes near it.
const LONGEST: usize = 64 << 20;

/// Where a record is written.
trait Target: Write {
    /// Flushes to the disk, to survive a power failure.
    fn settle(&mut self) {}

    /// Whether nobody can read any more what is written.
    fn is_deleted(&self) -> bool {
        false
    }
}

impl Target for File {
    fn settle(&mut self) {
        // Fails on pipes and terminals; errors that matter appear when writing.
        let _ = self.sync_data();
    }

    #[cfg(unix)]
    fn is_deleted(&self) -> bool {
        use std::os::unix::fs::MetadataExt as _;
        self.metadata().is_ok_and(|of| of.nlink() == 0)
    }
}

/// Most damaged lines that are reported one by one.
const MOST: usize = 100;

/// Writes the record of a run. It counts events that cannot be written, and the run continues.
pub struct Recorder {
    target: Box<dyn Target + Send>,
    name: String,
    /// Events lost since the last one written.
    lost: u64,
    /// Whether writing the last event failed, which was reported to the operator.
    told: bool,
    /// Whether the last line is incomplete.
    cut: bool,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// When it cannot be created, or exists already: a record is never overwritten.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().write(true).create_new(true).open(path);
        let file = file.map_err(|error| {
            let path = path.display();
            let text = match error.kind() {
                ErrorKind::AlreadyExists => {
                    format!("{path} exists, and a record is not overwritten; give another name")
                }
                _ => format!("cannot make the record {path}: {error}"),
            };
            io::Error::new(error.kind(), text)
        })?;
        Ok(Self::new(file, path.display().to_string()))
    }

    fn new(target: impl Target + Send + 'static, name: String) -> Self {
        Self {
            target: Box::new(target),
            name,
            lost: 0,
            told: false,
            cut: false,
        }
    }

    /// Writes an event. The operating system has each line when this returns, so a crash of this process
    /// loses none; at the end of a scene and of the run the record is also flushed to the disk.
    ///
    /// # Errors
    /// When this event could not be written, but the one before was: one message for the operator. The
    /// next event is tried again, after a note about how many were lost.
    pub fn write(&mut self, event: &StampedEvent) -> Result<(), Unrecorded> {
        let written = self.try_write(event);
        let told = std::mem::replace(&mut self.told, written.is_err());
        let Err(cause) = written else { return Ok(()) };
        self.lost += 1;
        if told {
            return Ok(());
        }
        Err(Unrecorded {
            file: self.name.clone(),
            cause,
        })
    }

    fn try_write(&mut self, event: &StampedEvent) -> io::Result<()> {
        if self.lost > 0 {
            let note = StampedEvent {
                event: RunEvent::Note {
                    text: format!("{} events are lacking in the record here", self.lost),
                },
                ..*event
            };
            self.line(&note)?;
            self.lost = 0;
        }
        self.line(event)?;
        if matches!(
            event.event,
            RunEvent::RunStarted(_) | RunEvent::SceneEnded { .. } | RunEvent::RunEnded { .. }
        ) {
            self.target.settle();
        }
        Ok(())
    }

    fn line(&mut self, event: &StampedEvent) -> io::Result<()> {
        if self.target.is_deleted() {
            return Err(io::Error::new(ErrorKind::NotFound, "it was deleted"));
        }
        // Leave an incomplete line as it is, and start a new one.
        let mut line = if self.cut { vec![b'\n'] } else { Vec::new() };
        serde_json::to_writer(&mut line, event)?;
        line.push(b'\n');
        let mut left = line.as_slice();
        while !left.is_empty() {
            match self.target.write(left) {
                Ok(0) => return Err(ErrorKind::WriteZero.into()),
                Ok(count) => left = left.get(count..).unwrap_or_default(),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => {
                    self.cut |= left.len() < line.len();
                    return Err(error);
                }
            }
        }
        self.cut = false;
        self.target.flush()
    }
}

impl fmt::Debug for Recorder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Recorder")
            .field("name", &self.name)
            .field("lost", &self.lost)
            .finish_non_exhaustive()
    }
}

/// Events are missing in a record from here on.
#[derive(Debug)]
pub struct Unrecorded {
    /// The record file.
    pub file: String,
    /// The system's error.
    pub cause: io::Error,
}

impl fmt::Display for Unrecorded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { file, cause } = self;
        write!(
            f,
            "the record {file} cannot be written: {cause}; the show goes on, and the record will \
             say what it lacks"
        )
    }
}

impl std::error::Error for Unrecorded {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.cause)
    }
}

/// The record of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// The file; for the second run in a file `FILE#2`.
    pub name: String,
    /// The first event.
    pub started: RunStarted,
    /// All events, in order.
    pub events: Vec<StampedEvent>,
}

/// Damage in a record, whose other lines are still read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// The file.
    pub file: String,
    /// The line, from 1; `None`: about all of it.
    pub line: Option<u64>,
    /// What is wrong there.
    pub text: String,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        write!(f, ": {}", self.text)
    }
}

/// Reads the runs of a record: usually one, several in joined files. It skips and reports lines that it
/// cannot read. A run without an end was cut off.
///
/// # Errors
/// When the source cannot be read.
pub fn read(name: &str, from: impl BufRead) -> io::Result<(Vec<Record>, Vec<Damage>)> {
    read_all(name, from, false)
}

/// Reads the record of a run that still goes on. A missing end and an incomplete last line are not damage then.
///
/// # Errors
/// When the source cannot be read.
pub fn read_so_far(name: &str, from: impl BufRead) -> io::Result<(Vec<Record>, Vec<Damage>)> {
    read_all(name, from, true)
}

fn read_all(
    name: &str,
    mut from: impl BufRead,
    goes_on: bool,
) -> io::Result<(Vec<Record>, Vec<Damage>)> {
    let mut runs: Vec<Record> = Vec::new();
    let mut damage = Vec::new();
    let mut more = 0_u64;
    let mut line = Vec::new();
    let mut number = 0;
    loop {
        line.clear();
        let mut limited = io::Read::take(&mut from, LONGEST as u64);
        if limited.read_until(b'\n', &mut line)? == 0 {
            break;
        }
        number += 1;
        let mut complain = |text: String| {
            if damage.len() == MOST {
                more += 1;
                return;
            }
            damage.push(Damage {
                file: name.to_owned(),
                line: Some(number),
                text,
            });
        };
        let whole = line.ends_with(b"\n");
        if line.trim_ascii().is_empty() {
            continue;
        }
        let event = match parse(&line) {
            Ok(event) => event,
            Err(_) if !whole && goes_on => continue,
            Err(_) if !whole => {
                complain("the line is cut off; it is passed over".to_owned());
                continue;
            }
            Err(error) => {
                complain(format!("no event: {error}; the line is passed over"));
                continue;
            }
        };
        if let RunEvent::RunStarted(started) = &event.event {
            if started.format != FORMAT {
                complain(format!(
                    "format {}, and this version reads {FORMAT}: it may be misread",
                    started.format
                ));
            }
            let name = match runs.len() {
                0 => name.to_owned(),
                runs => format!("{name}#{}", runs + 1),
            };
            runs.push(Record {
                name,
                started: (**started).clone(),
                events: vec![event],
            });
            continue;
        }
        let Some(run) = runs.last_mut() else {
            complain("an event before the start of a run; it is passed over".to_owned());
            continue;
        };
        if let RunEvent::Unknown = event.event {
            complain("an event that only a newer version knows; it is passed over".to_owned());
        } else if run.events.last().is_some_and(|last| last.at > event.at) {
            complain("an event from before the one above it; it is passed over".to_owned());
        } else {
            run.events.push(event);
        }
    }
    let is_undamaged = damage.is_empty();
    let mut about_file = |line, text: String| {
        damage.push(Damage {
            file: name.to_owned(),
            line: Some(line),
            text,
        });
    };
    if more > 0 {
        about_file(number, format!("{more} more lines could not be used"));
    }
    if number == 0 {
        about_file(1, "the file is empty".to_owned());
    } else if runs.is_empty() && is_undamaged {
        about_file(1, "no run starts here".to_owned());
    }
    // Only the last one of them may go on.
    let whole = runs.len().saturating_sub(usize::from(goes_on));
    for run in runs.iter().take(whole) {
        let ended = |event: &StampedEvent| matches!(event.event, RunEvent::RunEnded { .. });
        if !run.events.last().is_some_and(ended) {
            let text = format!(
                "the end of {} is lacking: it is read as far as it goes",
                run.name
            );
            about_file(number, text);
        }
    }
    Ok((runs, damage))
}

fn parse(line: &[u8]) -> Result<StampedEvent, String> {
    let text = std::str::from_utf8(line).map_err(|_| "not UTF-8".to_owned())?;
    serde_json::from_str(text.trim_end()).map_err(|error| {
        // The line number within one line says nothing.
        let text = error.to_string();
        match text.rsplit_once(" at line 1 column ") {
            Some((what, column)) => format!("{what} at column {column}"),
            None => text,
        }
    })
}

#[cfg(test)]
mod tests;
