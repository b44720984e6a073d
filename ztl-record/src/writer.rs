//! Writes a recording. Flushed messages stay readable even if the process is killed.

use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::path::Path;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use mcap::records::op;

use crate::form::Form;
use crate::mcap_format::{
    Chunk, MAGIC, Summary, put_bytes, put_record, put_sized, put_text, put_u16,
};
use crate::prepare::Message;
use crate::source::Source;

/// Most channels, and most bytes of their topics, because publishers choose topics and each takes memory.
const CHANNELS: usize = 4096;
const TOPICS: usize = 1 << 20;
/// Size of a chunk in bytes, if it is not flushed before and no message is longer.
const CHUNK: usize = 1 << 20;

/// A recording that is being written. The memory that it takes does not grow with its length.
pub struct Recording {
    file: File,
    clock: Clock,
    chunk: Chunk,
    /// Where the last whole chunk ends. After an error, the file ends there.
    whole: u64,
    /// Why it has ended early.
    failure: Option<(ErrorKind, String)>,
    /// The channels of each topic.
    channels: HashMap<String, Vec<Channel>>,
    count: u16,
    topic_bytes: usize,
    schemas: BTreeMap<Form, u16>,
    /// The times of the first and the last message.
    span: Option<(u64, u64)>,
}

/// The messages of one publisher and form at a topic.
struct Channel {
    id: u16,
    publisher: String,
    form: Form,
    /// Whether bytes were published in a pickle.
    pickled: bool,
    messages: u64,
    /// Its record, for the end of the file.
    record: Vec<u8>,
}

/// Whether a message is in the recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Written {
    /// It is.
    Yes,
    /// It is not: the recording has the most topics that it can have.
    TooManyTopics,
}

impl Recording {
    /// Creates the file.
    ///
    /// # Errors
    /// If it cannot be created, or exists already: a recording is never overwritten.
    pub fn create(path: &Path) -> io::Result<Self> {
        // In append mode, because reading the file for its index moves the position.
        let mut options = OpenOptions::new();
        let file = options.read(true).append(true).create_new(true).open(path);
        let mut file = file.map_err(|error| match error.kind() {
            ErrorKind::AlreadyExists => io::Error::new(
                error.kind(),
                "it exists, and a recording is not overwritten; give another name",
            ),
            _ => error,
        })?;
        let mut begin = MAGIC.to_vec();
        put_record(&mut begin, op::HEADER, |out| {
            put_text(out, "ztl");
            put_text(out, concat!("ztl-record ", env!("CARGO_PKG_VERSION")));
        });
        file.write_all(&begin)?;
        file.sync_all()?;
        sync_directory(path);
        Ok(Self {
            file,
            clock: Clock::new(),
            chunk: Chunk::default(),
            whole: begin.len() as u64,
            failure: None,
            channels: HashMap::new(),
            count: 0,
            topic_bytes: 0,
            schemas: BTreeMap::new(),
            span: None,
        })
    }

    /// Writes a message that was received at this time.
    ///
    /// # Errors
    /// If the file cannot be written, as on a full disk. The recording has ended then.
    pub fn write(&mut self, source: &Source, message: Message, at: Instant) -> io::Result<Written> {
        self.check()?;
        let log_time = self.clock.at(at).max(self.span.map_or(0, |(_, last)| last));
        let times = (log_time, message.made.unwrap_or(log_time));
        let data = message.data.into_bytes(log_time)?;
        if self.chunk.len() > 0 && self.chunk.len() + data.len() > CHUNK {
            self.write_chunk()?;
        }
        let key = (message.form, message.pickled);
        let Some((id, sequence)) = self.channel(source, &message.topic, key) else {
            return Ok(Written::TooManyTopics);
        };
        self.chunk.put_message(id, sequence, times, &data);
        let (first, _) = self.span.unwrap_or(times);
        self.span = Some((first, log_time));
        if self.chunk.len() > CHUNK {
            self.write_chunk()?;
        }
        Ok(Written::Yes)
    }

    /// The channel of a message, and how many messages it had; `None` if there are too many.
    fn channel(
        &mut self,
        source: &Source,
        topic: &str,
        (form, pickled): (Form, bool),
    ) -> Option<(u16, u32)> {
        let is_it = |channel: &&mut Channel| {
            channel.publisher == source.name && channel.form == form && channel.pickled == pickled
        };
        let known = self.channels.get_mut(topic);
        if let Some(channel) = known.and_then(|known| known.iter_mut().find(is_it)) {
            // MCAP's sequence numbers wrap.
            let sequence = channel.messages as u32;
            channel.messages += 1;
            return Some((channel.id, sequence));
        }
        if usize::from(self.count) >= CHANNELS || self.topic_bytes + topic.len() > TOPICS {
            return None;
        }
        self.count += 1;
        self.topic_bytes += topic.len();
        let schema = self.schema(form);
        let wire = if pickled { "pickle" } else { "raw" };
        let metadata = source.metadata().chain([("wire", wire)]);
        let id = self.count;
        let mut record = Vec::new();
        put_record(&mut record, op::CHANNEL, |out| {
            put_u16(out, id);
            put_u16(out, schema);
            put_text(out, topic);
            put_text(out, form.encoding());
            put_sized(out, |out| {
                for (key, value) in metadata {
                    put_text(out, key);
                    put_text(out, value);
                }
            });
        });
        self.chunk.records().extend_from_slice(&record);
        self.channels
            .entry(topic.to_owned())
            .or_default()
            .push(Channel {
                id,
                publisher: source.name.clone(),
                form,
                pickled,
                messages: 1,
                record,
            });
        Some((id, 0))
    }

    /// The schema of a form; 0 if it has none.
    fn schema(&mut self, form: Form) -> u16 {
        let next = self.schemas.len() as u16 + 1;
        match (self.schemas.get(&form), schema_record(form, next)) {
            (Some(id), _) => *id,
            (None, None) => 0,
            (None, Some(record)) => {
                self.chunk.records().extend_from_slice(&record);
                self.schemas.insert(form, next);
                next
            }
        }
    }

    /// Hands all messages to the operating system, so that a crash of this process loses none of them. The file has no end
    /// yet, but is readable.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn flush(&mut self) -> io::Result<()> {
        self.write_chunk()
    }

    /// The first error, if the recording has ended early: of several threads, another one may be told it first.
    fn check(&self) -> io::Result<()> {
        match &self.failure {
            Some((kind, why)) => Err(io::Error::new(*kind, why.clone())),
            None => Ok(()),
        }
    }

    fn write_chunk(&mut self) -> io::Result<()> {
        self.check()?;
        match self.chunk.write_to(&mut self.file, 2 * CHUNK) {
            Ok(written) => self.whole += written,
            Err(error) => {
                self.failure = Some((error.kind(), error.to_string()));
                self.cut();
                return Err(error);
            }
        }
        Ok(())
    }

    /// Removes half a chunk after an error. If that fails, too, readers stop there.
    fn cut(&mut self) {
        let _ = self.file.set_len(self.whole);
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
        usize::from(self.count)
    }

    /// Writes the end of the file with its index, and brings it to the disk.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn finish(mut self) -> io::Result<()> {
        self.write_chunk()?;
        let mut schemas: Vec<(u16, Form)> =
            self.schemas.iter().map(|(form, id)| (*id, *form)).collect();
        schemas.sort_unstable();
        let schemas: Vec<Vec<u8>> = schemas
            .into_iter()
            .filter_map(|(id, form)| schema_record(form, id))
            .collect();
        let mut channels: Vec<&Channel> = self.channels.values().flatten().collect();
        channels.sort_unstable_by_key(|channel| channel.id);
        let summary = Summary {
            counts: (schemas.len() as u16, u32::from(self.count)),
            schemas: schemas.concat(),
            channels: channels
                .iter()
                .flat_map(|channel| &channel.record)
                .copied()
                .collect(),
            messages: channels
                .iter()
                .map(|channel| (channel.id, channel.messages))
                .collect(),
            span: self.span.unwrap_or_default(),
        };
        let written = summary.write_to(&self.file, self.whole);
        if let Err(error) = written.and_then(|()| self.file.sync_all()) {
            self.cut();
            return Err(error);
        }
        Ok(())
    }
}

fn schema_record(form: Form, id: u16) -> Option<Vec<u8>> {
    let (name, schema) = form.schema()?;
    let mut record = Vec::new();
    put_record(&mut record, op::SCHEMA, |out| {
        put_u16(out, id);
        put_text(out, name);
        put_text(out, "jsonschema");
        put_bytes(out, schema.as_bytes());
    });
    Some(record)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_call_after_a_failure_says_why_it_failed() {
        let name = format!("ztl-record-failure-{}.mcap", std::process::id());
        let path = std::env::temp_dir().join(name);
        let mut recording = Recording::create(&path).unwrap();
        recording.file = File::open(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        recording.schema(Form::Run);
        let [first, second] = [(); 2].map(|()| recording.flush().unwrap_err().to_string());
        assert_eq!(first, second);
    }
}
