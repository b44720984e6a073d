//! The records of an MCAP file as bytes (<https://mcap.dev/spec>), and its index.
//!
//! The writer of the crate `mcap` keeps the index of each chunk in memory until the end: some hundred bytes for a chunk,
//! up to 80 KB with many topics. A recording that runs for days must not grow, so its index is made at the end, from the
//! file itself.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};

use mcap::records::op;

/// Begins and ends each file.
pub(crate) const MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Bytes before the messages in a chunk without compression.
const CHUNK_HEADER: usize = 40;
/// Bytes of an opcode and a length.
const HEADER: usize = 9;
/// Bytes of the index that are written at once.
const PIECE: usize = 64 * 1024;
/// Bytes of the file that are read at once to make the index: a chunk's header or some message indexes.
const READ: usize = 8 * 1024;

/// Adds a record.
pub(crate) fn put_record(out: &mut Vec<u8>, opcode: u8, body: impl FnOnce(&mut Vec<u8>)) {
    out.push(opcode);
    let begin = out.len();
    put_u64(out, 0);
    body(out);
    let length = out.len() - begin - size_of::<u64>();
    for (to, from) in out
        .iter_mut()
        .skip(begin)
        .zip((length as u64).to_le_bytes())
    {
        *to = from;
    }
}

pub(crate) fn put_u16(out: &mut Vec<u8>, number: u16) {
    out.extend_from_slice(&number.to_le_bytes());
}

pub(crate) fn put_u32(out: &mut Vec<u8>, number: u32) {
    out.extend_from_slice(&number.to_le_bytes());
}

pub(crate) fn put_u64(out: &mut Vec<u8>, number: u64) {
    out.extend_from_slice(&number.to_le_bytes());
}

/// Bytes behind their length.
pub(crate) fn put_bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    put_u32(out, u32::try_from(bytes.len()).unwrap_or(u32::MAX));
    out.extend_from_slice(bytes);
}

pub(crate) fn put_text(out: &mut Vec<u8>, text: &str) {
    put_bytes(out, text.as_bytes());
}

/// What is put, behind its length.
pub(crate) fn put_sized(out: &mut Vec<u8>, put: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = Vec::new();
    put(&mut bytes);
    put_bytes(out, &bytes);
}

/// Messages that are written together, with what readers need to know of them first.
#[derive(Default)]
pub(crate) struct Chunk {
    records: Vec<u8>,
    /// The first and the last time of a message.
    span: Option<(u64, u64)>,
    /// Time and byte offset of each message, by channel.
    offsets: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl Chunk {
    /// Bytes of its records.
    pub(crate) fn len(&self) -> usize {
        self.records.len()
    }

    /// Where further schemas and channels go.
    pub(crate) fn records(&mut self) -> &mut Vec<u8> {
        &mut self.records
    }

    /// Adds a message: its channel, its number in it, when it was received and made.
    pub(crate) fn put_message(
        &mut self,
        channel: u16,
        sequence: u32,
        (log_time, publish_time): (u64, u64),
        data: &[u8],
    ) {
        let offset = self.records.len() as u64;
        self.offsets
            .entry(channel)
            .or_default()
            .push((log_time, offset));
        let (first, last) = self.span.unwrap_or((log_time, log_time));
        self.span = Some((first.min(log_time), last.max(log_time)));
        put_record(&mut self.records, op::MESSAGE, |out| {
            put_u16(out, channel);
            put_u32(out, sequence);
            put_u64(out, log_time);
            put_u64(out, publish_time);
            out.extend_from_slice(data);
        });
    }

    /// Writes it, and begins the next one. Returns how many bytes were written.
    pub(crate) fn write_to(&mut self, file: &mut impl Write, room: usize) -> io::Result<u64> {
        if self.records.is_empty() {
            return Ok(0);
        }
        let length = self.records.len() as u64;
        let (first, last) = self.span.take().unwrap_or_default();
        let mut header = vec![op::CHUNK];
        put_u64(&mut header, CHUNK_HEADER as u64 + length);
        put_u64(&mut header, first);
        put_u64(&mut header, last);
        put_u64(&mut header, length);
        put_u32(&mut header, crc32fast::hash(&self.records));
        put_text(&mut header, "");
        put_u64(&mut header, length);
        let mut indexes = Vec::new();
        for (channel, offsets) in std::mem::take(&mut self.offsets) {
            put_record(&mut indexes, op::MESSAGE_INDEX, |out| {
                put_u16(out, channel);
                put_sized(out, |out| {
                    for (time, offset) in offsets {
                        put_u64(out, time);
                        put_u64(out, offset);
                    }
                });
            });
        }
        file.write_all(&header)?;
        file.write_all(&self.records)?;
        file.write_all(&indexes)?;
        self.records.clear();
        self.records.shrink_to(room);
        Ok(header.len() as u64 + length + indexes.len() as u64)
    }
}

/// What a file tells at its end.
pub(crate) struct Summary {
    /// The records of its schemas and channels, and their numbers.
    pub(crate) schemas: Vec<u8>,
    pub(crate) channels: Vec<u8>,
    pub(crate) counts: (u16, u32),
    /// The messages of each channel, and the times of the first and the last.
    pub(crate) messages: BTreeMap<u16, u64>,
    pub(crate) span: (u64, u64),
}

impl Summary {
    /// Writes the end of a file whose chunks end at `at`. `file` is read from its start, and written at its end.
    pub(crate) fn write_to(self, file: &File, at: u64) -> io::Result<()> {
        let mut end = End::new(file, at);
        // Without a checksum of all chunks: each has its own.
        put_record(&mut end.bytes, op::DATA_END, |out| put_u32(out, 0));
        end.flush()?;
        let start = end.at;
        end.crc = crc32fast::Hasher::new();
        let mut groups = Vec::new();
        for (opcode, records) in [(op::SCHEMA, self.schemas), (op::CHANNEL, self.channels)] {
            let group = end.at();
            end.bytes.extend_from_slice(&records);
            groups.push((opcode, group, end.at() - group));
        }
        let group = end.at();
        let mut chunks = Chunks::new(file, at)?;
        let mut count = 0;
        while let Some(chunk) = chunks.next()? {
            count += 1;
            chunk.put(&mut end.bytes);
            end.flush_if_long()?;
        }
        groups.push((op::CHUNK_INDEX, group, end.at() - group));
        let group = end.at();
        put_record(&mut end.bytes, op::STATISTICS, |out| {
            put_u64(out, self.messages.values().sum());
            put_u16(out, self.counts.0);
            put_u32(out, self.counts.1);
            // No attachments and no metadata.
            put_u64(out, 0);
            put_u32(out, count);
            put_u64(out, self.span.0);
            put_u64(out, self.span.1);
            put_sized(out, |out| {
                for (channel, messages) in &self.messages {
                    put_u16(out, *channel);
                    put_u64(out, *messages);
                }
            });
        });
        groups.push((op::STATISTICS, group, end.at() - group));
        let offsets = end.at();
        for (opcode, start, length) in groups.into_iter().filter(|(.., length)| *length > 0) {
            put_record(&mut end.bytes, op::SUMMARY_OFFSET, |out| {
                out.push(opcode);
                put_u64(out, start);
                put_u64(out, length);
            });
        }
        end.bytes.push(op::FOOTER);
        put_u64(&mut end.bytes, 20);
        put_u64(&mut end.bytes, start);
        put_u64(&mut end.bytes, offsets);
        end.flush()?;
        let crc = end.crc.clone().finalize();
        put_u32(&mut end.bytes, crc);
        end.bytes.extend_from_slice(MAGIC);
        end.flush()
    }
}

/// Writes at the end of a file, in pieces.
struct End<'a> {
    file: &'a File,
    at: u64,
    bytes: Vec<u8>,
    crc: crc32fast::Hasher,
}

impl<'a> End<'a> {
    fn new(file: &'a File, at: u64) -> Self {
        Self {
            file,
            at,
            bytes: Vec::new(),
            crc: crc32fast::Hasher::new(),
        }
    }

    /// The offset of the next byte.
    fn at(&self) -> u64 {
        self.at + self.bytes.len() as u64
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.write_all(&self.bytes)?;
        self.crc.update(&self.bytes);
        self.at += self.bytes.len() as u64;
        self.bytes.clear();
        Ok(())
    }

    fn flush_if_long(&mut self) -> io::Result<()> {
        match self.bytes.len() > PIECE {
            true => self.flush(),
            false => Ok(()),
        }
    }
}

/// Finds the chunks of a file.
struct Chunks<'a> {
    file: BufReader<&'a File>,
    at: u64,
    end: u64,
}

/// A chunk in the index.
struct Indexed {
    offset: u64,
    /// Of the whole record, of the message indexes behind it, and of the messages in it.
    length: u64,
    indexes_length: u64,
    messages_length: u64,
    span: (u64, u64),
    /// The offsets of its message indexes.
    indexes: Vec<(u16, u64)>,
}

impl<'a> Chunks<'a> {
    fn new(file: &'a File, end: u64) -> io::Result<Self> {
        let mut file = BufReader::with_capacity(READ, file);
        let at = file.seek(SeekFrom::Start(MAGIC.len() as u64))?;
        Ok(Self { file, at, end })
    }

    fn next(&mut self) -> io::Result<Option<Indexed>> {
        while self.at < self.end {
            let offset = self.at;
            // The file is written between two calls.
            self.file.seek(SeekFrom::Start(offset))?;
            let (opcode, length) = self.header()?;
            if opcode != op::CHUNK {
                self.skip(length)?;
                continue;
            }
            let span = (self.u64()?, self.u64()?);
            let messages_length = self.u64()?;
            self.skip(length.saturating_sub(24))?;
            let mut chunk = Indexed {
                offset,
                length: length + HEADER as u64,
                indexes_length: 0,
                messages_length,
                span,
                indexes: Vec::new(),
            };
            let indexes = self.at;
            while self.at < self.end {
                let offset = self.at;
                let (opcode, length) = self.header()?;
                if opcode != op::MESSAGE_INDEX {
                    self.at = offset;
                    break;
                }
                chunk.indexes.push((self.u16()?, offset));
                self.skip(length.saturating_sub(2))?;
            }
            chunk.indexes_length = self.at - indexes;
            return Ok(Some(chunk));
        }
        Ok(None)
    }

    fn header(&mut self) -> io::Result<(u8, u64)> {
        let [opcode] = self.bytes()?;
        Ok((opcode, self.u64()?))
    }

    fn u16(&mut self) -> io::Result<u16> {
        Ok(u16::from_le_bytes(self.bytes()?))
    }

    fn u64(&mut self) -> io::Result<u64> {
        Ok(u64::from_le_bytes(self.bytes()?))
    }

    fn bytes<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn skip(&mut self, length: u64) -> io::Result<()> {
        self.at += length;
        let length = i64::try_from(length).map_err(io::Error::other)?;
        self.file.seek_relative(length)
    }
}

impl Indexed {
    fn put(&self, out: &mut Vec<u8>) {
        put_record(out, op::CHUNK_INDEX, |out| {
            put_u64(out, self.span.0);
            put_u64(out, self.span.1);
            put_u64(out, self.offset);
            put_u64(out, self.length);
            put_sized(out, |out| {
                for (channel, offset) in &self.indexes {
                    put_u16(out, *channel);
                    put_u64(out, *offset);
                }
            });
            put_u64(out, self.indexes_length);
            put_text(out, "");
            put_u64(out, self.messages_length);
            put_u64(out, self.messages_length);
        });
    }
}
