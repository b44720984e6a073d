//! Reads a recording. If it is cut off or damaged, the reader returns the messages that are whole.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::Arc;

use mcap::records::{ChunkHeader, MessageHeader, Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use serde::Deserialize;
use ztl_pickle::Pickle;

use crate::form::{Form, Image, Sound, ZtlText, from_base64};
use crate::prepare::SoundFormat;
use crate::source::Source;
use crate::task::{TASKS, TaskEvent};

/// Longest record in bytes. A message of 64 MiB, the longest that is published, takes 4/3 of it.
const LONGEST: usize = 128 << 20;
/// Bytes that are read at once.
const BLOCK: usize = 1 << 18;

/// A message of a recording.
#[derive(Debug, Clone)]
pub struct Read {
    /// The topic that it was published at.
    pub topic: String,
    /// The publisher, as it was when it was recorded.
    pub source: Arc<Source>,
    /// When it was received, in nanoseconds since 1970.
    pub log_time: u64,
    /// When it was made, in nanoseconds since 1970; if it does not say, when it was received.
    pub publish_time: u64,
    /// What it contains.
    pub content: Content,
    /// Whether it was published in a pickle.
    pickled: bool,
}

/// What a message contains.
#[derive(Debug, Clone)]
pub enum Content {
    /// What happened in a run: the JSON of the event, as `docs/record.md` describes it. It was not published.
    Run(Vec<u8>),
    /// What happened to a task, and the published event.
    Task(TaskEvent, Pickle),
    /// A value.
    Value(Pickle),
    /// Text that is not a pickle.
    Text(String),
    /// A JPEG.
    Image(Vec<u8>),
    /// Samples.
    Sound(SoundFormat, Vec<u8>),
    /// Other bytes.
    Bytes(Vec<u8>),
}

impl Read {
    /// The message, as it was published.
    #[must_use]
    pub fn body(&self) -> Vec<u8> {
        match &self.content {
            Content::Task(_, value) | Content::Value(value) => value.to_bytes(),
            Content::Text(text) => text.clone().into_bytes(),
            Content::Run(json) => json.clone(),
            Content::Image(bytes) | Content::Sound(_, bytes) | Content::Bytes(bytes) => {
                match Pickle::bytes(bytes) {
                    Ok(pickle) if self.pickled => pickle.to_bytes(),
                    _ => bytes.clone(),
                }
            }
        }
    }
}

/// What is wrong with a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Damage {
    /// Why reading stopped early; `None` if the recording has its end.
    pub end: Option<String>,
    /// Damaged chunks, which are left out.
    pub chunks: u64,
    /// Messages that ZTL has not recorded in this form; they are left out.
    pub foreign: u64,
}

impl Damage {
    /// Whether anything is wrong.
    #[must_use]
    pub fn is_any(&self) -> bool {
        *self != Self::default()
    }
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut between = "";
        if let Some(end) = &self.end {
            f.write_str(end)?;
            between = "; ";
        }
        if self.chunks > 0 {
            write!(f, "{between}{} damaged chunks are left out", self.chunks)?;
            between = "; ";
        }
        if self.foreign > 0 {
            let messages = self.foreign;
            write!(
                f,
                "{between}{messages} messages that ZTL has not recorded are left out"
            )?;
        }
        Ok(())
    }
}

/// Reads the messages of a recording, in the order in which they were written.
pub struct Reader {
    input: Box<dyn io::Read + Send>,
    reader: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Arc<Channel>>,
    waiting: VecDeque<Waiting>,
    damage: Damage,
    done: bool,
    /// How many bytes were read.
    length: usize,
}

/// A whole message that is not decoded yet, which saves memory.
struct Waiting {
    channel: Arc<Channel>,
    header: MessageHeader,
    data: Vec<u8>,
}

struct Channel {
    topic: String,
    source: Arc<Source>,
    /// `None` if ZTL has not recorded it.
    form: Option<Form>,
    pickled: bool,
}

impl Reader {
    /// Opens a recording.
    ///
    /// # Errors
    /// If the file cannot be opened.
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self::new(File::open(path)?))
    }

    /// Reads a recording from somewhere else.
    pub fn new(input: impl io::Read + Send + 'static) -> Self {
        let options = LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_record_length_limit(LONGEST);
        Self {
            input: Box::new(input),
            reader: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            waiting: VecDeque::new(),
            damage: Damage::default(),
            done: false,
            length: 0,
        }
    }

    /// The damage found so far.
    #[must_use]
    pub const fn damage(&self) -> &Damage {
        &self.damage
    }

    fn end(&mut self, why: Option<String>) {
        self.done = true;
        self.damage.end = why;
    }

    /// Reads until the next message or the end.
    fn read_on(&mut self) {
        let (opcode, data) = match self.reader.next_event() {
            None => return self.end(None),
            Some(Err(error)) => {
                let why = match self.length < MAGIC.len() {
                    true => told(&McapError::BadMagic),
                    false => told(&error),
                };
                return self.end(Some(why));
            }
            Some(Ok(LinearReadEvent::ReadRequest(needed))) => {
                let block = self.reader.insert(needed.clamp(1, BLOCK));
                match self.input.read(block) {
                    Ok(read) => {
                        self.length = self.length.saturating_add(read);
                        self.reader.notify_read(read);
                    }
                    Err(error) => self.end(Some(format!("cannot be read further: {error}"))),
                }
                return;
            }
            // A copy, since the reader owns the record.
            Some(Ok(LinearReadEvent::Record { opcode, data })) => (opcode, data.to_vec()),
        };
        if opcode == op::FOOTER {
            // A reader from start to end needs nothing of what follows.
            return self.end(None);
        }
        match parse(opcode, &data) {
            Ok(Some(Record::Chunk { header, data })) => {
                if !self.on_chunk(&header, &data) {
                    self.damage.chunks += 1;
                }
            }
            Ok(Some(record)) => self.on_record(record),
            Ok(None) => {}
            Err(Unreadable) => self.end(Some("is damaged: a record is not readable".to_owned())),
        }
    }

    /// Reads a chunk. Returns whether it is whole.
    fn on_chunk(&mut self, header: &ChunkHeader, data: &[u8]) -> bool {
        if !header.compression.is_empty() {
            self.end(Some(format!(
                "is compressed with {:?}; convert it first: mcap compress --compression none",
                header.compression
            )));
            return true;
        }
        let saved = header.uncompressed_crc;
        if saved != 0 && crc32fast::hash(data) != saved {
            return false;
        }
        // All or nothing.
        if !records(data).all(|record| record.is_ok()) {
            return false;
        }
        for record in records(data).flatten().flatten() {
            self.on_record(record);
        }
        true
    }

    fn on_record(&mut self, record: Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let schema = match channel.schema_id {
                    0 => None,
                    id => Some(self.schemas.get(&id).map_or("", String::as_str)),
                };
                let metadata = |key| channel.metadata.get(key).cloned().unwrap_or_default();
                let known = Channel {
                    form: Form::of(schema, &channel.message_encoding),
                    source: Arc::new(Source {
                        name: metadata("publisher"),
                        endpoint: metadata("endpoint"),
                        key: metadata("key"),
                    }),
                    pickled: metadata("wire") == "pickle",
                    topic: channel.topic,
                };
                self.channels.insert(channel.id, Arc::new(known));
            }
            Record::Message { header, data } => match self.channels.get(&header.channel_id) {
                Some(channel) => self.waiting.push_back(Waiting {
                    channel: Arc::clone(channel),
                    header,
                    data: data.into_owned(),
                }),
                None => self.damage.foreign += 1,
            },
            _ => {}
        }
    }
}

impl Iterator for Reader {
    type Item = Read;

    fn next(&mut self) -> Option<Read> {
        loop {
            match self.waiting.pop_front() {
                Some(waiting) => match waiting.read() {
                    Some(read) => return Some(read),
                    None => self.damage.foreign += 1,
                },
                None if self.done => return None,
                None => self.read_on(),
            }
        }
    }
}

/// A record is malformed.
struct Unreadable;

/// The records in a chunk that are used.
fn records(mut data: &[u8]) -> impl Iterator<Item = Result<Option<Record<'_>>, Unreadable>> {
    std::iter::from_fn(move || {
        if data.is_empty() {
            return None;
        }
        let Some((opcode, body, rest)) = split_record(data) else {
            data = &[];
            return Some(Err(Unreadable));
        };
        data = rest;
        Some(parse(opcode, body))
    })
}

/// The first record, and what follows it.
fn split_record(data: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (opcode, data) = data.split_first()?;
    let (length, data) = data.split_first_chunk()?;
    let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
    let (body, rest) = data.split_at_checked(length)?;
    Some((*opcode, body, rest))
}

/// Reads a record if it is of a kind that is used.
fn parse(opcode: u8, body: &[u8]) -> Result<Option<Record<'_>>, Unreadable> {
    // `mcap` allocates the length that a text claims before it checks that length.
    let fits = match opcode {
        op::SCHEMA => body.get(2..).and_then(|body| skip_texts(body, 3)).is_some(),
        op::CHANNEL => is_channel(body).is_some(),
        op::CHUNK => body
            .get(28..)
            .and_then(|body| skip_texts(body, 1))
            .is_some(),
        op::MESSAGE => true,
        _ => return Ok(None),
    };
    match fits {
        true => mcap::parse_record(opcode, body)
            .map(Some)
            .map_err(|_| Unreadable),
        false => Err(Unreadable),
    }
}

/// Whether the texts of a channel are within it.
fn is_channel(body: &[u8]) -> Option<()> {
    let metadata = skip_texts(body.get(4..)?, 2)?;
    let (length, metadata) = metadata.split_first_chunk()?;
    let mut metadata = metadata.get(..usize::try_from(u32::from_le_bytes(*length)).ok()?)?;
    while !metadata.is_empty() {
        metadata = skip_texts(metadata, 1)?;
    }
    Some(())
}

/// What follows so many texts, each behind its length.
fn skip_texts(mut bytes: &[u8], number: usize) -> Option<&[u8]> {
    for _ in 0..number {
        let (length, rest) = bytes.split_first_chunk()?;
        bytes = rest.get(usize::try_from(u32::from_le_bytes(*length)).ok()?..)?;
    }
    Some(bytes)
}

impl Waiting {
    /// The message, if ZTL has recorded it.
    fn read(self) -> Option<Read> {
        let Self {
            channel,
            header,
            data,
        } = self;
        let mut topic = channel.topic.clone();
        let content = match channel.form? {
            Form::Run => Content::Run(data),
            Form::Task => {
                let scope = topic.strip_suffix(TASKS.trim_end_matches('/'))?;
                let event = TaskEvent::read(scope, &serde_json::from_slice(&data).ok()?)?;
                topic = format!("{scope}{TASKS}{}", event.id);
                let value = serde_json::from_slice(&data).ok()?;
                Content::Task(event, value)
            }
            Form::Value => {
                let stored: StoredValue = serde_json::from_slice(&data).ok()?;
                Content::Value(match (stored.pickle, stored.value) {
                    (Some(pickle), _) => Pickle::read(&from_base64(&pickle)?).ok()?,
                    (None, value) => value.unwrap_or_else(Pickle::none),
                })
            }
            Form::Text => Content::Text(serde_json::from_slice::<ZtlText>(&data).ok()?.text),
            Form::Image => {
                let image: Image = serde_json::from_slice(&data).ok()?;
                Content::Image(from_base64(&image.data)?)
            }
            Form::Sound => {
                let sound: Sound = serde_json::from_slice(&data).ok()?;
                let format = SoundFormat {
                    rate: sound.sample_rate,
                    channels: sound.number_of_channels,
                };
                Content::Sound(format, from_base64(&sound.data)?)
            }
            Form::Bytes => Content::Bytes(data),
        };
        Some(Read {
            topic,
            source: Arc::clone(&channel.source),
            log_time: header.log_time,
            publish_time: header.publish_time,
            content,
            pickled: channel.pickled,
        })
    }
}

/// `ztl.Value`. A value of `null` is `None`, as an absent one.
#[derive(Deserialize)]
struct StoredValue {
    value: Option<Pickle>,
    pickle: Option<String>,
}

/// Why reading ended.
fn told(error: &McapError) -> String {
    match error {
        McapError::UnexpectedEof => {
            "has no end, as if the recorder was killed or its disk was full; what was written before is read"
                .to_owned()
        }
        McapError::BadMagic => "is not an MCAP file".to_owned(),
        other => format!("is damaged: {other}"),
    }
}
