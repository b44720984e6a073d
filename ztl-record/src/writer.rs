//! Writes a recording. What is flushed stays readable, whatever happens to the process afterwards.

use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Seek, SeekFrom, Write};
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};

use crate::form::Form;
use crate::prepare::Message;

/// Most channels: a publisher may choose its topics, and each takes memory.
const CHANNELS: usize = 4096;
/// Size of a chunk in bytes, if it is not flushed before.
const CHUNK: u64 = 1 << 20;

/// A recording that is being written.
pub struct Recording {
    writer: Writer<Target>,
    /// The same file, to flush it to the disk.
    file: File,
    clock: Clock,
    channels: HashMap<ChannelKey, Channel>,
    schemas: BTreeMap<Form, u16>,
    last: u64,
}

/// Publisher, topic, form, and whether bytes were published in a pickle.
type ChannelKey = (String, String, Form, bool);

struct Channel {
    id: u16,
    sequence: u32,
}

/// Whether a message is in the recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Written {
    /// It is.
    Yes,
    /// It is not: the recording has as many topics as it can.
    TooManyTopics,
}

impl Recording {
    /// Creates the file.
    ///
    /// # Errors
    /// If it cannot be created, or exists already: a recording is never overwritten.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().write(true).create_new(true).open(path);
        let file = file.map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => io::Error::new(
                error.kind(),
                "it exists, and a recording is not overwritten; give another name",
            ),
            _ => error,
        })?;
        let target = Target {
            file: file.try_clone()?,
            waiting: Vec::new(),
            written: 0,
            whole: 0,
            failed: false,
        };
        let options = WriteOptions::new()
            .compression(None)
            .chunk_size(Some(CHUNK))
            // A chunk is written when it is complete, so that a reader never finds half of its header.
            .disable_seeking(true)
            .profile("ztl")
            .library(concat!("ztl-record ", env!("CARGO_PKG_VERSION")));
        let mut recording = Self {
            writer: options.create(target).map_err(to_io)?,
            file,
            clock: Clock::new(),
            channels: HashMap::new(),
            schemas: BTreeMap::new(),
            last: 0,
        };
        recording.flush()?;
        recording.file.sync_all()?;
        sync_directory(path);
        Ok(recording)
    }

    /// Writes a message that was received at this time.
    ///
    /// # Errors
    /// If the file cannot be written, as on a full disk. The recording has ended then.
    pub fn write(&mut self, publisher: &str, message: Message, at: Instant) -> io::Result<Written> {
        let Message {
            topic,
            form,
            pickled,
            data,
            made,
        } = message;
        let key = (publisher.to_owned(), topic, form, pickled);
        if !self.channels.contains_key(&key) && self.channels.len() >= CHANNELS {
            return Ok(Written::TooManyTopics);
        }
        let log_time = self.clock.at(at).max(self.last);
        let data = data.into_bytes(log_time)?;
        let written = self.write_to(key, (log_time, made.unwrap_or(log_time)), &data);
        written.map_err(to_io)?;
        self.last = log_time;
        Ok(Written::Yes)
    }

    fn write_to(
        &mut self,
        key: ChannelKey,
        (log_time, publish_time): (u64, u64),
        data: &[u8],
    ) -> Result<(), McapError> {
        let channel = match self.channels.get_mut(&key) {
            Some(channel) => channel,
            None => {
                let id = self.add_channel(&key)?;
                let channel = Channel { id, sequence: 0 };
                self.channels.entry(key).or_insert(channel)
            }
        };
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.sequence,
            log_time,
            publish_time,
        };
        channel.sequence = channel.sequence.wrapping_add(1);
        self.writer.write_to_known_channel(&header, data)
    }

    fn add_channel(
        &mut self,
        (publisher, topic, form, pickled): &ChannelKey,
    ) -> Result<u16, McapError> {
        let schema = match (self.schemas.get(form), form.schema()) {
            (Some(id), _) => *id,
            (None, None) => 0,
            (None, Some((name, schema))) => {
                let id = self
                    .writer
                    .add_schema(name, "jsonschema", schema.as_bytes())?;
                self.schemas.insert(*form, id);
                id
            }
        };
        let wire = if *pickled { "pickle" } else { "raw" };
        let metadata = BTreeMap::from([
            ("publisher".to_owned(), publisher.clone()),
            ("wire".to_owned(), wire.to_owned()),
        ]);
        self.writer
            .add_channel(schema, topic, form.encoding(), &metadata)
    }

    /// Gives everything to the operating system, so that a crash of this process loses none of it. The file has no
    /// end yet, but what it has is readable.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn flush(&mut self) -> io::Result<()> {
        self.writer.flush().map_err(to_io)
    }

    /// The file, to bring to the disk what was flushed, while others write the recording.
    ///
    /// # Errors
    /// If the process has too many files.
    pub fn file(&self) -> io::Result<File> {
        self.file.try_clone()
    }

    /// How many topics it has.
    #[must_use]
    pub fn topics(&self) -> usize {
        self.channels.len()
    }

    /// Writes the end of the file with its index, and brings it to the disk.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn finish(mut self) -> io::Result<()> {
        self.writer.finish().map_err(to_io)?;
        self.file.sync_all()
    }
}

/// The clock of a recording: the wall clock at its start, and from then on the monotonic clock. So times never go
/// backwards, also when somebody sets the wall clock.
struct Clock {
    wall: u64,
    start: Instant,
}

impl Clock {
    fn new() -> Self {
        let wall = SystemTime::now().duration_since(UNIX_EPOCH);
        let wall = wall.map_or(0, |wall| wall.as_nanos());
        Self {
            wall: u64::try_from(wall).unwrap_or(u64::MAX),
            start: Instant::now(),
        }
    }

    fn at(&self, at: Instant) -> u64 {
        let passed = at.saturating_duration_since(self.start).as_nanos();
        self.wall
            .saturating_add(u64::try_from(passed).unwrap_or(u64::MAX))
    }
}

/// The file. Bytes wait until they are flushed or many. After an error the file ends where the last flush ended.
struct Target {
    file: File,
    waiting: Vec<u8>,
    written: u64,
    whole: u64,
    failed: bool,
}

impl Target {
    fn write_waiting(&mut self) -> io::Result<()> {
        if self.failed {
            return Err(io::Error::other("the recording has ended"));
        }
        let written = self.file.write_all(&self.waiting);
        if let Err(error) = written {
            self.failed = true;
            // Half a chunk helps no reader. If this fails, readers stop there.
            let _ = self.file.set_len(self.whole);
            return Err(error);
        }
        self.written += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }
}

impl Write for Target {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.waiting.extend_from_slice(bytes);
        if self.waiting.len() as u64 > CHUNK {
            self.write_waiting()?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.write_waiting()?;
        self.whole = self.written;
        Ok(())
    }
}

impl Seek for Target {
    /// Only tells the position: the writer does not seek.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.written + self.waiting.len() as u64),
            _ => Err(ErrorKind::Unsupported.into()),
        }
    }
}

/// Makes the name of a new file survive a power cut, where the system can.
fn sync_directory(path: &Path) {
    let directory = match path.parent() {
        Some(directory) if !directory.as_os_str().is_empty() => directory,
        _ => Path::new("."),
    };
    if let Ok(directory) = File::open(directory) {
        let _ = directory.sync_all();
    }
}

fn to_io(error: McapError) -> io::Error {
    match error {
        McapError::Io(error) => error,
        other => io::Error::other(other),
    }
}
