//! Errors in goals and in results.

use core::fmt;

use crate::sink::{BufferTooSmall, Sink, put_decimal};

/// Maximum nesting of collections, in reading and writing. It bounds the stack.
pub const MAX_DEPTH: u8 = 8;

/// Why a text is not the goal that the firmware expects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct GoalError {
    /// Byte offset in the text of the wrong value, key or mark. If something is missing, the offset of the
    /// opening bracket or quote.
    pub at: usize,
    /// What is wrong there.
    pub kind: GoalErrorKind,
}

/// What is wrong with a goal.
///
/// The error says what would be right where that costs no flash: the expected syntax, and the names of fields
/// and variants. It does not say a number's range, a sequence's length, or the type and values that the
/// target takes. serde passes those as text to be formatted by `core::fmt`, which would take more flash than
/// all the rest. [`GoalError::at`] says where to look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum GoalErrorKind {
    /// Something else was expected here.
    Expected(Expected),
    /// A quote or bracket is never closed.
    Unterminated,
    /// A backslash followed by an unknown escape.
    BadEscape,
    /// A quoted text has escapes, and there is no scratch to decode it into: use
    /// [`from_str_with`](super::from_str_with).
    NeedsScratch,
    /// The scratch is too small for the texts with escapes up to this one.
    ScratchTooSmall {
        /// Bytes needed so far.
        needed: usize,
        /// Size of the scratch in bytes.
        available: usize,
    },
    /// A collection is nested in [`MAX_DEPTH`] others.
    TooDeep,
    /// The number does not fit the target's type.
    OutOfRange,
    /// The value's type is not what the target takes.
    WrongType,
    /// The target does not take this value.
    WrongValue,
    /// The sequence has too few or too many items.
    WrongLength,
    /// The key is none of these fields.
    UnknownField(&'static [&'static str]),
    /// The name is none of these variants.
    UnknownVariant(&'static [&'static str]),
    /// This field is missing.
    MissingField(&'static str),
    /// This field occurs twice.
    DuplicateField(&'static str),
    /// The target's own code rejected the value. Keeping its message would take `core::fmt`.
    Refused,
}

/// What was expected at a position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Expected {
    /// Any value.
    Value,
    /// `True` or `False`.
    Bool,
    /// A number without decimal point and exponent.
    Integer,
    /// A number.
    Number,
    /// A plain or quoted text.
    Text,
    /// `None`
    Nothing,
    /// `[...]` or `(...)`
    Sequence,
    /// `{key: value}`
    Mapping,
    /// `[...]`, `(...)` or `{field: value}`
    Struct,
    /// A variant's name with its value, `{name: value}`.
    VariantWithValue,
    /// The `:` between key and value.
    Colon,
    /// `,` or the bracket that closes the collection.
    CommaOrClose,
    /// The bracket that closes the collection.
    Close,
    /// `,`, because a tuple of one is written `(1,)`.
    Comma,
    /// The end of the text.
    End,
}

/// An error at the reader's position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Error {
    /// Found by the reader itself.
    Own(Fault),
    /// Found by serde or the target's own code, which know no positions.
    Serde(GoalErrorKind),
}

/// An error that the reader itself finds, in one byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Fault {
    Expected(Expected),
    Unterminated,
    BadEscape,
    NeedsScratch,
    ScratchTooSmall,
    TooDeep,
    OutOfRange,
    WrongLength,
}

impl From<Fault> for Error {
    fn from(fault: Fault) -> Self {
        Self::Own(fault)
    }
}

impl Error {
    /// Adds the position. `scratch` is what the texts with escapes need, and what there is.
    pub(super) fn at(self, at: usize, scratch: Option<(usize, usize)>) -> GoalError {
        let (needed, available) = scratch.unwrap_or_default();
        let kind = match self {
            Self::Serde(kind) => kind,
            Self::Own(fault) => match fault {
                Fault::Expected(expected) => GoalErrorKind::Expected(expected),
                Fault::Unterminated => GoalErrorKind::Unterminated,
                Fault::BadEscape => GoalErrorKind::BadEscape,
                Fault::NeedsScratch => GoalErrorKind::NeedsScratch,
                Fault::ScratchTooSmall => GoalErrorKind::ScratchTooSmall { needed, available },
                Fault::TooDeep => GoalErrorKind::TooDeep,
                Fault::OutOfRange => GoalErrorKind::OutOfRange,
                Fault::WrongLength => GoalErrorKind::WrongLength,
            },
        };
        GoalError { at, kind }
    }
}

// Ignores `expected` and the messages, so that the code that would format them is not linked.
impl serde::de::Error for Error {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Serde(GoalErrorKind::Refused)
    }

    fn invalid_type(_: serde::de::Unexpected<'_>, _: &dyn serde::de::Expected) -> Self {
        Self::Serde(GoalErrorKind::WrongType)
    }

    fn invalid_value(found: serde::de::Unexpected<'_>, _: &dyn serde::de::Expected) -> Self {
        use serde::de::Unexpected::{Float, Signed, Unsigned};
        Self::Serde(match found {
            Unsigned(_) | Signed(_) | Float(_) => GoalErrorKind::OutOfRange,
            _ => GoalErrorKind::WrongValue,
        })
    }

    fn invalid_length(_: usize, _: &dyn serde::de::Expected) -> Self {
        Self::Serde(GoalErrorKind::WrongLength)
    }

    fn unknown_variant(_: &str, expected: &'static [&'static str]) -> Self {
        Self::Serde(GoalErrorKind::UnknownVariant(expected))
    }

    fn unknown_field(_: &str, expected: &'static [&'static str]) -> Self {
        Self::Serde(GoalErrorKind::UnknownField(expected))
    }

    fn missing_field(field: &'static str) -> Self {
        Self::Serde(GoalErrorKind::MissingField(field))
    }

    fn duplicate_field(field: &'static str) -> Self {
        Self::Serde(GoalErrorKind::DuplicateField(field))
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.at(0, None).fmt(f)
    }
}

impl core::error::Error for Error {}

impl GoalError {
    /// Writes position and cause like `Display`, but without `core::fmt`: for the person who wrote the goal.
    pub fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        sink.put(b"goal, byte ");
        put_decimal(sink, u32::try_from(self.at).unwrap_or(u32::MAX));
        sink.put(b": ");
        self.kind.put(sink);
    }
}

impl GoalErrorKind {
    fn put(&self, sink: &mut (impl Sink + ?Sized)) {
        let mut texts = |texts: [&str; 3]| texts.iter().for_each(|text| sink.put(text.as_bytes()));
        match *self {
            Self::Expected(expected) => texts(["expected ", expected.name(), ""]),
            Self::Unterminated => texts(["never closed", "", ""]),
            Self::BadEscape => texts(["no such escape", "", ""]),
            Self::NeedsScratch => texts(["a text with escapes needs scratch", "", ""]),
            Self::ScratchTooSmall { needed, available } => {
                sink.put(b"scratch too small: ");
                put_decimal(sink, u32::try_from(needed).unwrap_or(u32::MAX));
                sink.put(b" bytes needed so far, ");
                put_decimal(sink, u32::try_from(available).unwrap_or(u32::MAX));
                sink.put(b" available");
            }
            Self::TooDeep => {
                sink.put(b"more than ");
                put_decimal(sink, u32::from(MAX_DEPTH));
                sink.put(b" levels");
            }
            Self::OutOfRange => texts(["number out of range", "", ""]),
            Self::WrongType => texts(["wrong type", "", ""]),
            Self::WrongValue => texts(["wrong value", "", ""]),
            Self::WrongLength => texts(["too few or too many items", "", ""]),
            Self::UnknownField(fields) => put_names("unknown field", fields, sink),
            Self::UnknownVariant(variants) => put_names("unknown variant", variants, sink),
            Self::MissingField(field) => texts(["field ", field, " is missing"]),
            Self::DuplicateField(field) => texts(["field ", field, " occurs twice"]),
            Self::Refused => texts(["refused by the target's type", "", ""]),
        }
    }
}

fn put_names(what: &str, names: &[&str], sink: &mut (impl Sink + ?Sized)) {
    sink.put(what.as_bytes());
    for (place, name) in names.iter().enumerate() {
        sink.put(if place == 0 { b", expected " } else { b" or " });
        sink.put(name.as_bytes());
    }
}

impl Expected {
    const fn name(self) -> &'static str {
        match self {
            Self::Value => "a value",
            Self::Bool => "True or False",
            Self::Integer => "an integer",
            Self::Number => "a number",
            Self::Text => "a text",
            Self::Nothing => "None",
            Self::Sequence => "[...]",
            Self::Mapping => "{key: value}",
            Self::Struct => "[...] or {field: value}",
            Self::VariantWithValue => "{variant: value}",
            Self::Colon => "':' and a blank",
            Self::CommaOrClose => "',' or a closing bracket",
            Self::Close => "a closing bracket",
            Self::Comma => "','",
            Self::End => "the end",
        }
    }
}

/// Lets a formatter act as a sink of text.
fn display(f: &mut fmt::Formatter<'_>, put: impl FnOnce(&mut dyn Sink)) -> fmt::Result {
    let mut result = Ok(());
    put(&mut |bytes: &[u8]| {
        let text = core::str::from_utf8(bytes).unwrap_or_default();
        result = result.and_then(|()| f.write_str(text));
    });
    result
}

impl fmt::Display for GoalError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |sink| self.put(sink))
    }
}

impl fmt::Display for GoalErrorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |sink| self.put(sink))
    }
}

impl fmt::Display for Expected {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl core::error::Error for GoalError {}

/// Why a value could not be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum WriteError {
    /// A collection is nested in [`MAX_DEPTH`] others.
    TooDeep,
    /// The caller's buffer is too small.
    BufferTooSmall(BufferTooSmall),
    /// A number is infinite or not a number, where the reader needs a finite one.
    NotFinite,
    /// The value's own code returned an error. Keeping its message would take `core::fmt`.
    Refused,
}

impl fmt::Display for WriteError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooDeep => write!(f, "more than {} levels", MAX_DEPTH),
            Self::BufferTooSmall(cause) => cause.fmt(f),
            Self::NotFinite => f.write_str("a number is infinite or not a number"),
            Self::Refused => f.write_str("refused by the value's type"),
        }
    }
}

impl core::error::Error for WriteError {
    fn source(&self) -> Option<&(dyn core::error::Error + 'static)> {
        match self {
            Self::BufferTooSmall(cause) => Some(cause),
            _ => None,
        }
    }
}

impl serde::ser::Error for WriteError {
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Refused
    }
}
