//! Messages: a header of 28 bytes, little endian, and a payload.
//!
//! ```text
//! magic 42 de ad 42 · id u32 · size u32 · version u16 · kind u8 · flags u8 · service u32 · object u32 · action u32
//! ```

use std::fmt;

/// The length of a header, in bytes.
pub const HEADER_LEN: usize = 28;

const MAGIC: [u8; 4] = [0x42, 0xde, 0xad, 0x42];

/// The flag of a payload that is a dynamic value, instead of what the method's or signal's signature says.
pub const DYNAMIC_PAYLOAD: u8 = 1;

/// A buffer that was larger than this is freed once it is empty.
const KEPT: usize = 256 << 10;

/// What a message is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A call, which is answered with `Reply`, `Error` or `Canceled`.
    Call,
    /// What a call has returned.
    Reply,
    /// Why a call has failed.
    Error,
    /// A call without an answer.
    Post,
    /// A signal.
    Event,
    /// What the sender is capable of.
    Capability,
    /// Asks to cancel a call.
    Cancel,
    /// A call was cancelled.
    Canceled,
}

impl Kind {
    fn parse(byte: u8) -> Option<Self> {
        Some(match byte {
            1 => Self::Call,
            2 => Self::Reply,
            3 => Self::Error,
            4 => Self::Post,
            5 => Self::Event,
            6 => Self::Capability,
            7 => Self::Cancel,
            8 => Self::Canceled,
            _ => return None,
        })
    }

    const fn byte(self) -> u8 {
        match self {
            Self::Call => 1,
            Self::Reply => 2,
            Self::Error => 3,
            Self::Post => 4,
            Self::Event => 5,
            Self::Capability => 6,
            Self::Cancel => 7,
            Self::Canceled => 8,
        }
    }
}

/// The receiver of a call, or the sender of a signal: a method or signal of an object of a service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Address {
    /// The service's number in its directory.
    pub service: u32,
    /// 1 is the service itself; others are objects that its methods have returned.
    pub object: u32,
    /// The number of a method or signal.
    pub action: u32,
}

/// A message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Chosen by the caller; an answer repeats it.
    pub id: u32,
    /// What it is for.
    pub kind: Kind,
    /// [`DYNAMIC_PAYLOAD`] and others.
    pub flags: u8,
    /// Its receiver or sender.
    pub address: Address,
    /// Encoded values.
    pub payload: Vec<u8>,
}

impl Message {
    /// Appends the encoded message. A payload is at most 4 GiB long, which [`Limits`](crate::Limits) ensure.
    pub fn encode_into(&self, out: &mut Vec<u8>) {
        let size = u32::try_from(self.payload.len()).unwrap_or(u32::MAX);
        out.extend(MAGIC);
        out.extend(self.id.to_le_bytes());
        out.extend(size.to_le_bytes());
        out.extend([0, 0, self.kind.byte(), self.flags]);
        for number in [
            self.address.service,
            self.address.object,
            self.address.action,
        ] {
            out.extend(number.to_le_bytes());
        }
        out.extend(&self.payload);
    }
}

/// Why a stream cannot be read any further.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum StreamError {
    /// It does not begin with a message's first bytes.
    NotNaoqi,
    /// A later version of the protocol.
    Version(u16),
    /// A message exceeds the limit.
    TooLong {
        /// The payload's length in bytes.
        length: u32,
        /// The limit.
        most: usize,
    },
}

impl fmt::Display for StreamError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotNaoqi => f.write_str("it does not speak NAOqi's protocol"),
            Self::Version(version) => {
                write!(
                    f,
                    "it speaks version {version} of NAOqi's protocol, expected 0"
                )
            }
            Self::TooLong { length, most } => {
                write!(
                    f,
                    "it sent a message of {length} bytes, expected at most {most}"
                )
            }
        }
    }
}

impl std::error::Error for StreamError {}

/// Finds the messages in a stream.
#[derive(Debug)]
pub struct Frames {
    buffer: Vec<u8>,
    /// How much of the buffer was taken.
    taken: usize,
    most: usize,
}

impl Frames {
    /// `most`: the longest payload, in bytes.
    #[must_use]
    pub const fn new(most: usize) -> Self {
        Self {
            buffer: Vec::new(),
            taken: 0,
            most,
        }
    }

    /// Takes bytes from the stream. Then call [`poll`](Self::poll) until it returns `None`, which bounds what is kept
    /// to one message and these bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        if self.taken > 0 {
            self.buffer.drain(..self.taken);
            self.taken = 0;
        }
        if self.buffer.is_empty() && self.buffer.capacity() > KEPT {
            self.buffer = Vec::new();
        }
        self.buffer.extend(bytes);
    }

    /// The next message that is complete. Messages of unknown kinds are skipped.
    ///
    /// # Errors
    /// [`StreamError`]: nothing more can be read.
    pub fn poll(&mut self) -> Result<Option<Message>, StreamError> {
        loop {
            let rest = self.buffer.get(self.taken..).unwrap_or_default();
            let start = rest.get(..MAGIC.len()).unwrap_or(rest);
            if !MAGIC.starts_with(start) {
                return Err(StreamError::NotNaoqi);
            }
            let Some((header, rest)) = rest.split_first_chunk::<HEADER_LEN>() else {
                return Ok(None);
            };
            let [
                _,
                _,
                _,
                _,
                i0,
                i1,
                i2,
                i3,
                n0,
                n1,
                n2,
                n3,
                v0,
                v1,
                kind,
                flags,
                s0,
                s1,
                s2,
                s3,
                o0,
                o1,
                o2,
                o3,
                a0,
                a1,
                a2,
                a3,
            ] = *header;
            let version = u16::from_le_bytes([v0, v1]);
            if version != 0 {
                return Err(StreamError::Version(version));
            }
            let length = u32::from_le_bytes([n0, n1, n2, n3]);
            let too_long = StreamError::TooLong {
                length,
                most: self.most,
            };
            let size = usize::try_from(length).map_err(|_| too_long)?;
            if size > self.most {
                return Err(too_long);
            }
            let Some(payload) = rest.get(..size) else {
                return Ok(None);
            };
            self.taken += HEADER_LEN + size;
            let Some(kind) = Kind::parse(kind) else {
                continue;
            };
            return Ok(Some(Message {
                id: u32::from_le_bytes([i0, i1, i2, i3]),
                kind,
                flags,
                address: Address {
                    service: u32::from_le_bytes([s0, s1, s2, s3]),
                    object: u32::from_le_bytes([o0, o1, o2, o3]),
                    action: u32::from_le_bytes([a0, a1, a2, a3]),
                },
                payload: payload.to_vec(),
            }));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message() -> Message {
        Message {
            id: 7,
            kind: Kind::Call,
            flags: 0,
            address: Address {
                service: 2,
                object: 1,
                action: 100,
            },
            payload: b"\x05\0\0\0hello".to_vec(),
        }
    }

    #[test]
    fn messages_are_found_however_the_stream_is_cut() {
        let mut bytes = Vec::new();
        message().encode_into(&mut bytes);
        assert_eq!(
            bytes[..16],
            *b"\x42\xde\xad\x42\x07\0\0\0\x09\0\0\0\0\0\x01\0"
        );
        message().encode_into(&mut bytes);
        for cut in 1..bytes.len() {
            let mut frames = Frames::new(64);
            let mut found = 0;
            for part in bytes.chunks(cut) {
                frames.push(part);
                while let Some(next) = frames.poll().unwrap() {
                    assert_eq!(next, message());
                    found += 1;
                }
            }
            assert_eq!(found, 2, "cut {cut}");
        }
    }

    #[test]
    fn other_protocols_and_long_messages_are_errors_at_once() {
        let mut frames = Frames::new(64);
        frames.push(b"SSH-2.0");
        assert_eq!(frames.poll(), Err(StreamError::NotNaoqi));

        let mut bytes = Vec::new();
        message().encode_into(&mut bytes);
        bytes[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
        let mut frames = Frames::new(64);
        frames.push(&bytes);
        let error = frames.poll().unwrap_err();
        let expected = "it sent a message of 4294967295 bytes, expected at most 64";
        assert_eq!(error.to_string(), expected);
    }

    #[test]
    fn a_message_of_an_unknown_kind_is_skipped() {
        let mut bytes = Vec::new();
        message().encode_into(&mut bytes);
        bytes[14] = 99;
        message().encode_into(&mut bytes);
        let mut frames = Frames::new(64);
        frames.push(&bytes);
        assert_eq!(frames.poll(), Ok(Some(message())));
        assert_eq!(frames.poll(), Ok(None));
    }
}
