//! TCPROS: frames that begin with their length. The first frame is a header of `name=value` fields.

use std::fmt;

/// The longest header, in bytes. It holds the text of a message's definition.
pub(crate) const LONGEST_HEADER: usize = 256 * 1024;

/// The fields of a header.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Header(Vec<(String, String)>);

/// Why bytes are not a frame or header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FrameError {
    TooLong { found: usize, most: usize },
    MalformedHeader,
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLong { found, most } => {
                write!(f, "a message of {found} bytes, more than {most}")
            }
            Self::MalformedHeader => f.write_str("a malformed TCPROS header"),
        }
    }
}

impl Header {
    pub(crate) fn new<'a>(fields: impl IntoIterator<Item = (&'a str, &'a str)>) -> Self {
        let fields = fields.into_iter();
        Self(
            fields
                .map(|(name, value)| (name.to_owned(), value.to_owned()))
                .collect(),
        )
    }

    /// The value of a field, or an empty text.
    pub(crate) fn get(&self, name: &str) -> &str {
        let field = self.0.iter().find(|(found, _)| found == name);
        field.map(|(_, value)| value.as_str()).unwrap_or_default()
    }

    /// Reads the content of a frame.
    pub(crate) fn parse(mut bytes: &[u8]) -> Result<Self, FrameError> {
        let mut fields = Vec::new();
        while !bytes.is_empty() {
            let field = take_field(&mut bytes).ok_or(FrameError::MalformedHeader)?;
            // Definitions of old messages have comments in Latin-1.
            let field = String::from_utf8_lossy(field);
            let (name, value) = field.split_once('=').ok_or(FrameError::MalformedHeader)?;
            fields.push((name.to_owned(), value.to_owned()));
        }
        Ok(Self(fields))
    }

    /// The header as a frame.
    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut content = Vec::new();
        for (name, value) in &self.0 {
            content.extend(length(name.len() + 1 + value.len()));
            content.extend_from_slice(name.as_bytes());
            content.push(b'=');
            content.extend_from_slice(value.as_bytes());
        }
        frame(&content)
    }
}

fn take_field<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (len, rest) = bytes.split_first_chunk::<4>()?;
    let len = usize::try_from(u32::from_le_bytes(*len)).ok()?;
    let (field, rest) = rest.split_at_checked(len)?;
    *bytes = rest;
    Some(field)
}

/// A frame with this content.
pub(crate) fn frame(content: &[u8]) -> Vec<u8> {
    let mut frame = Vec::with_capacity(4 + content.len());
    frame.extend(length(content.len()));
    frame.extend_from_slice(content);
    frame
}

fn length(len: usize) -> [u8; 4] {
    u32::try_from(len).unwrap_or(u32::MAX).to_le_bytes()
}

/// Splits a connection into frames.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    buffer: Vec<u8>,
    /// The first byte that was not taken yet.
    start: usize,
}

impl Frames {
    /// Takes a piece of the connection. Afterwards, call [`poll_frame`](Self::poll_frame) until it returns nothing.
    pub(crate) fn handle_bytes(&mut self, bytes: &[u8]) {
        if self.start == self.buffer.len() {
            self.buffer.clear();
            // A large message is rare; its room is not kept.
            self.buffer.shrink_to(64 * 1024);
        } else {
            self.buffer.drain(..self.start);
        }
        self.start = 0;
        self.buffer.extend_from_slice(bytes);
    }

    /// The content of the next frame, once it is complete. The memory grows with what has arrived, not with what a
    /// length claims.
    pub(crate) fn poll_frame(&mut self, most: usize) -> Result<Option<&[u8]>, FrameError> {
        let rest = self.buffer.get(self.start..).unwrap_or_default();
        let Some((len, rest)) = rest.split_first_chunk::<4>() else {
            return Ok(None);
        };
        let found = usize::try_from(u32::from_le_bytes(*len)).unwrap_or(usize::MAX);
        if found > most {
            return Err(FrameError::TooLong { found, most });
        }
        let Some(content) = rest.get(..found) else {
            return Ok(None);
        };
        self.start += 4 + found;
        Ok(Some(content))
    }

    /// The next byte that belongs to no frame, such as the status of a service's answer.
    pub(crate) fn poll_byte(&mut self) -> Option<u8> {
        let byte = self.buffer.get(self.start).copied();
        self.start += usize::from(byte.is_some());
        byte
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_read_as_they_are_written() {
        let header = Header::new([("md5sum", "*"), ("message_definition", "a=b\n")]);
        let bytes = header.encode();
        assert_eq!(&bytes[..18], b"\x27\0\0\0\x08\0\0\0md5sum=*\x17\0");
        assert_eq!(Header::parse(&bytes[4..]), Ok(header.clone()));
        assert_eq!(header.get("message_definition"), "a=b\n");
        assert_eq!(header.get("type"), "");
    }

    #[test]
    fn no_damage_panics() {
        let header = Header::new([("md5sum", "*"), ("topic", "/lamp")]).encode();
        crate::damage::damage(&header, |damaged| {
            let mut frames = Frames::default();
            frames.handle_bytes(damaged);
            while let Ok(Some(content)) = frames.poll_frame(100) {
                let _ = Header::parse(content);
            }
            let _ = Header::parse(damaged);
        });
    }

    #[test]
    fn malformed_headers_are_refused() {
        for bytes in [
            &b"\x01"[..],
            b"\x02\0\0\0a",
            b"\x01\0\0\0a",
            b"\xff\xff\xff\xffa=b",
        ] {
            assert_eq!(Header::parse(bytes), Err(FrameError::MalformedHeader));
        }
    }

    #[test]
    fn frames_arrive_in_any_pieces() {
        let contents: [&[u8]; 4] = [b"one", b"", b"three", &[7; 300]];
        let bytes: Vec<u8> = contents.iter().flat_map(|content| frame(content)).collect();
        for size in 1..bytes.len() {
            let mut frames = Frames::default();
            let mut found = Vec::new();
            for piece in bytes.chunks(size) {
                frames.handle_bytes(piece);
                while let Some(content) = frames.poll_frame(300).unwrap() {
                    found.push(content.to_vec());
                }
            }
            assert_eq!(found, contents, "{size}");
        }
    }

    #[test]
    fn a_frame_that_is_too_long_is_refused_before_it_arrives() {
        let mut frames = Frames::default();
        frames.handle_bytes(&301_u32.to_le_bytes());
        let error = FrameError::TooLong {
            found: 301,
            most: 300,
        };
        assert_eq!(frames.poll_frame(300), Err(error));
    }
}
