//! The text on the wire: `scope;state;id;payload` (`docs/protocol.md`, section 2).
//!
//! There is no length prefix and no escaping. The text is split at the first three `;`, so only the payload
//! may contain one.

use crate::integer::{Integer, ParseIntegerError};
use crate::sink::{BufferTooSmall, Sink, SliceSink};
use crate::text::{split_at_mark, valid_start};

/// A message as a view of its bytes. Numbers stay text until needed, because the scope decides how a bad one
/// is answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Message<'a> {
    /// The addressed scope, compared byte for byte. Must not contain `;`; writing does not check this.
    pub scope: &'a str,
    /// A request's code, or a reply's state.
    pub state: &'a str,
    /// The task's id.
    pub id: &'a str,
    /// The payload, which may contain `;`.
    pub payload: &'a str,
}

/// Why bytes are not a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParseError<'a> {
    /// The bytes are not UTF-8.
    NotUtf8 {
        /// Offset of the first invalid byte.
        at: usize,
        /// The first field, if it could be read.
        scope: Option<&'a str>,
    },
    /// There are fewer than four fields.
    MissingFields {
        /// Number of fields found, 1 to 3.
        found: usize,
        /// The first field.
        scope: &'a str,
    },
}

impl<'a> ParseError<'a> {
    /// The first field as far as it could be read, else empty. The reply repeats it.
    #[must_use]
    pub fn scope(&self) -> &'a str {
        match *self {
            Self::NotUtf8 { scope, .. } => scope.unwrap_or_default(),
            Self::MissingFields { scope, .. } => scope,
        }
    }
}

impl core::fmt::Display for ParseError<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NotUtf8 { at, .. } => write!(f, "not UTF-8 at byte {at}"),
            Self::MissingFields { found, .. } => {
                write!(f, "{found} of the 4 fields scope;state;id;payload")
            }
        }
    }
}

impl core::error::Error for ParseError<'_> {}

impl<'a> Message<'a> {
    /// Parses a message.
    ///
    /// # Errors
    /// [`ParseError`] if the bytes are not UTF-8 or have fewer than four fields.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, ParseError<'a>> {
        let text = valid_start(bytes);
        Self::parse_text(text, text.len() == bytes.len())
    }

    /// Like [`parse`](Self::parse), for text already checked as UTF-8. `whole` is `false` if invalid bytes
    /// follow.
    ///
    /// # Errors
    /// See [`parse`](Self::parse).
    pub(crate) fn parse_text(text: &'a str, whole: bool) -> Result<Self, ParseError<'a>> {
        let first = split_at_mark(text, ';');
        if !whole {
            let scope = first.map(|(scope, _)| scope);
            let at = text.len();
            return Err(ParseError::NotUtf8 { at, scope });
        }
        let missing = |found, scope| ParseError::MissingFields { found, scope };
        let (scope, rest) = first.ok_or(missing(1, text))?;
        let (state, rest) = split_at_mark(rest, ';').ok_or(missing(2, scope))?;
        let (id, payload) = split_at_mark(rest, ';').ok_or(missing(3, scope))?;
        Ok(Self {
            scope,
            state,
            id,
            payload,
        })
    }

    /// The `state` field as an integer.
    ///
    /// # Errors
    /// [`ParseIntegerError`] if it is not one.
    pub fn code(&self) -> Result<Integer<'a>, ParseIntegerError> {
        Integer::parse(self.state)
    }

    /// The `id` field as an integer.
    ///
    /// # Errors
    /// [`ParseIntegerError`] if it is not one.
    pub fn number(&self) -> Result<Integer<'a>, ParseIntegerError> {
        Integer::parse(self.id)
    }

    /// Whether a field can be a scope: it has no `;`, where the field would end and the rest be read
    /// as the next one.
    #[must_use]
    pub fn is_scope(text: &str) -> bool {
        !text.contains(';')
    }

    /// Length of the message in bytes.
    #[must_use]
    pub fn encoded_len(&self) -> usize {
        self.scope.len() + self.state.len() + self.id.len() + self.payload.len() + 3
    }

    /// Writes the message into `buffer`.
    ///
    /// # Errors
    /// [`BufferTooSmall`] if the buffer is shorter than [`encoded_len`](Self::encoded_len).
    pub fn encode_into<'b>(&self, buffer: &'b mut [u8]) -> Result<&'b [u8], BufferTooSmall> {
        let mut sink = SliceSink::new(buffer);
        self.put(&mut sink);
        sink.finish()
    }

    /// Writes the message to a sink.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        for field in [self.scope, self.state, self.id] {
            sink.put(field.as_bytes());
            sink.put(b";");
        }
        sink.put(self.payload.as_bytes());
    }
}
