//! A task specification: `handler:component:goal`, sent as base64 in an INIT's payload.

use crate::base64;
use crate::repr::{put_quoted, put_quoted_small};
use crate::sink::{BufferTooSmall, Sink, SliceSink};
use crate::text::{split_at_mark, valid_start};
use crate::{TaskId, sink};

/// Separates the three parts. A goal may contain it; handler and component may not.
pub(crate) const SEPARATOR: char = ':';

/// A task specification: which handler acts, with which component, towards which goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TaskSpec<'a> {
    /// Who acts: a robot, a device, a program, such as `cob`. Must not contain `:`; writing does not check
    /// this.
    pub handler: &'a str,
    /// The part that acts, such as `head`. Must not contain `:`; writing does not check this.
    pub component: &'a str,
    /// What to reach, such as `left` or `[0, 0, 1.57]`.
    pub goal: &'a str,
}

/// Why a payload is not a task specification.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SpecError {
    /// The payload is not base64.
    Base64(base64::DecodeError),
    /// The decoded bytes are not UTF-8.
    NotUtf8 {
        /// Offset of the first invalid byte in the decoded text.
        at: usize,
    },
    /// The component is missing: there is no `:`.
    NoComponent,
    /// The goal is missing: there is only one `:`.
    NoGoal,
}

impl core::fmt::Display for SpecError {
    /// For a missing part, the original's text: the part's name in quotes (`docs/protocol.md` [5.3]).
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Base64(cause) => cause.fmt(f),
            Self::NotUtf8 { at } => write!(f, "the task is not UTF-8 at byte {at}"),
            Self::NoComponent => f.write_str("'component'"),
            Self::NoGoal => f.write_str("'goal'"),
        }
    }
}

impl core::error::Error for SpecError {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        match self {
            Self::Base64(cause) => Some(cause),
            _ => None,
        }
    }
}

impl<'a> TaskSpec<'a> {
    /// Splits `handler:component:goal` at the first two `:`.
    ///
    /// # Errors
    /// [`SpecError::NoComponent`] or [`SpecError::NoGoal`] if there are fewer.
    #[cfg_attr(target_os = "none", inline(always))]
    pub fn split(text: &'a str) -> Result<Self, SpecError> {
        let (handler, rest) = split_at_mark(text, SEPARATOR).ok_or(SpecError::NoComponent)?;
        let (component, goal) = split_at_mark(rest, SEPARATOR).ok_or(SpecError::NoGoal)?;
        Ok(Self {
            handler,
            component,
            goal,
        })
    }

    /// Decodes an INIT's payload. The parts are views of `buffer`, which needs three quarters of the
    /// payload's length.
    ///
    /// # Errors
    /// [`SpecError`] if the payload is not base64, not UTF-8, or lacks a part.
    pub fn decode(payload: &str, buffer: &'a mut [u8]) -> Result<Self, SpecError> {
        let bytes = base64::decode(payload.as_bytes(), buffer).map_err(SpecError::Base64)?;
        let text = valid_start(bytes);
        if text.len() < bytes.len() {
            return Err(SpecError::NotUtf8 { at: text.len() });
        }
        Self::split(text)
    }

    /// Length of the base64 form in bytes.
    #[must_use]
    pub fn encoded_len(&self) -> usize {
        let plain = self.handler.len() + self.component.len() + self.goal.len() + 2;
        plain.div_ceil(3) * 4
    }

    /// Writes the base64 form into `buffer`.
    ///
    /// # Errors
    /// [`BufferTooSmall`] if the buffer is shorter than [`encoded_len`](Self::encoded_len).
    pub fn encode_into<'b>(&self, buffer: &'b mut [u8]) -> Result<&'b str, BufferTooSmall> {
        let mut sink = SliceSink::new(buffer);
        self.put(&mut sink);
        let text = sink.finish()?;
        // Base64 is ASCII.
        Ok(core::str::from_utf8(text).unwrap_or_default())
    }

    /// Writes the base64 form to a sink.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        let mut encoder = base64::Encoder::new(sink);
        encoder.put(self.handler.as_bytes());
        encoder.put(b":");
        encoder.put(self.component.as_bytes());
        encoder.put(b":");
        encoder.put(self.goal.as_bytes());
        encoder.finish();
    }

    /// Writes the text with which the original's standard controller answers an INIT (`docs/protocol.md`
    /// [5.4]): `Initiated task '7' with request: {'handler': 'cob', 'component': 'head', 'goal': 'left'}`.
    pub fn put_initiated(&self, id: TaskId, sink: &mut (impl Sink + ?Sized)) {
        self.put_initiated_by(put_quoted, id, sink);
    }

    /// Like [`put_initiated`](Self::put_initiated), for firmware: quotes with `put_quoted_small`.
    pub fn put_initiated_small(&self, id: TaskId, sink: &mut (impl Sink + ?Sized)) {
        self.put_initiated_by(put_quoted_small, id, sink);
    }

    fn put_initiated_by<S: Sink + ?Sized>(
        &self,
        quote: impl Fn(&str, &mut S),
        id: TaskId,
        sink: &mut S,
    ) {
        sink.put(b"Initiated task '");
        sink::put_decimal(sink, id.get());
        for (before, part) in [
            ("' with request: {'handler': ", self.handler),
            (", 'component': ", self.component),
            (", 'goal': ", self.goal),
        ] {
            sink.put(before.as_bytes());
            quote(part, sink);
        }
        sink.put(b"}");
    }
}

impl core::fmt::Display for TaskSpec<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}:{}:{}", self.handler, self.component, self.goal)
    }
}
