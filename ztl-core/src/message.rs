//! The text on the wire: `scope;state;id;payload` (wire specification 3).
//!
//! No length prefix, no escaping: the text is cut at the first three `;`, so a payload may contain
//! more of them and the other fields may not.

use crate::integer::{Integer, ParseIntegerError};
use crate::sink::{BufferTooSmall, Sink, SliceSink};
use crate::{split_at_mark, valid_start};

/// A message as a view over its bytes. Numbers stay text until they are asked for, since which
/// answer a bad one gets depends on the scope.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Message<'a> {
    /// Whom it is for; compared byte for byte. Without `;`, which would end it: writing does not look.
    pub scope: &'a str,
    /// In a request the request's code, in a reply the task's state.
    pub state: &'a str,
    /// Which task.
    pub id: &'a str,
    /// Anything, `;` included.
    pub payload: &'a str,
}

/// Why bytes are no message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ParseError<'a> {
    /// Not UTF-8; valid up to this byte.
    NotUtf8 {
        /// Offset of the first bad byte.
        at: usize,
        /// The first field, when that much could be read.
        scope: Option<&'a str>,
    },
    /// Fewer than four fields.
    MissingFields {
        /// How many there are, 1 to 3.
        found: usize,
        /// The first of them.
        scope: &'a str,
    },
}

impl<'a> ParseError<'a> {
    /// The first field, as far as it could be read; else empty. Answers carry it.
    #[must_use]
    #[cfg_attr(target_os = "none", inline(always))]
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
    /// Reads a message.
    ///
    /// # Errors
    /// [`ParseError`] when it is not UTF-8 or has fewer than four fields.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, ParseError<'a>> {
        let text = valid_start(bytes);
        Self::parse_text(text, text.len() == bytes.len())
    }

    /// The same of bytes that are known to be UTF-8 so far; `whole` says whether they are to their end.
    ///
    /// # Errors
    /// As [`parse`](Self::parse).
    pub fn parse_text(text: &'a str, whole: bool) -> Result<Self, ParseError<'a>> {
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

    /// The `state` field as a number.
    ///
    /// # Errors
    /// [`ParseIntegerError`] when it is none.
    pub fn code(&self) -> Result<Integer<'a>, ParseIntegerError> {
        Integer::parse(self.state)
    }

    /// The `id` field as a number.
    ///
    /// # Errors
    /// [`ParseIntegerError`] when it is none.
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
    /// [`BufferTooSmall`] when the buffer is shorter than [`encoded_len`](Self::encoded_len).
    pub fn encode_into<'b>(&self, buffer: &'b mut [u8]) -> Result<&'b [u8], BufferTooSmall> {
        let mut sink = SliceSink::new(buffer);
        self.put(&mut sink);
        sink.finish()
    }

    /// Writes the message.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        for field in [self.scope, self.state, self.id] {
            sink.put(field.as_bytes());
            sink.put(b";");
        }
        sink.put(self.payload.as_bytes());
    }
}
