//! What can be wrong with a goal, and with a result.

use core::fmt;

use crate::sink::{BufferTooSmall, Sink, put_decimal};

/// Why a text is not the goal that the firmware asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct GoalError {
    /// Where in the text, in bytes from its start: at the value, key or mark that is wrong; for what
    /// lacks something, at its opening bracket or quote.
    pub at: usize,
    /// What is wrong there.
    pub kind: GoalErrorKind,
}

/// What is wrong with a goal.
///
/// What would be right is told where it costs no flash: what was to stand there, and the names of
/// fields and variants. Not told are the range of a number, the length of a sequence, the kind and
/// the values that a target takes: serde hands these on as texts to be formatted by `core::fmt`, which
/// would take a microcontroller more than all the rest. [`GoalError::at`] says where to look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum GoalErrorKind {
    /// Something else was to stand here.
    Expected(Expected),
    /// A quote or bracket that is never closed.
    Unterminated,
    /// A backslash with something behind it that means no character.
    BadEscape,
    /// A text in quotes is not what is written, for it has escapes, and there is no scratch to write
    /// it to: use [`from_str_with`](super::from_str_with).
    NeedsScratch,
    /// The texts with escapes, up to this one, take more than the scratch.
    ScratchTooSmall {
        /// Bytes that they take.
        needed: usize,
        /// Bytes of scratch.
        available: usize,
    },
    /// A bracket within [`MAX_DEPTH`](super::MAX_DEPTH) others.
    TooDeep,
    /// A number that the target's type cannot hold.
    OutOfRange,
    /// A value of a kind that the target does not take.
    WrongType,
    /// A value that the target does not take.
    WrongValue,
    /// Too few or too many items.
    WrongLength,
    /// The key is none of these fields.
    UnknownField(&'static [&'static str]),
    /// The name is none of these variants.
    UnknownVariant(&'static [&'static str]),
    /// This field is not there.
    MissingField(&'static str),
    /// This field is there twice.
    DuplicateField(&'static str),
    /// The target's own code refused the value; what it said would take `core::fmt` to keep.
    Refused,
}

/// What was to stand at a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Expected {
    /// Any value.
    Value,
    /// `True` or `False`.
    Bool,
    /// A number without point and exponent.
    Integer,
    /// A number.
    Number,
    /// A plain text, or one in quotes.
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
    /// `,` since a tuple of one is written `(1,)`.
    Comma,
    /// The text's end.
    End,
}

/// What is wrong at the place where the reader stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Error {
    /// Found by the reader itself, which stands there.
    Own(Fault),
    /// Found by serde or the target's own code, which know no places.
    Serde(GoalErrorKind),
}

/// What the reader itself finds wrong, in one byte.
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
    /// For the caller. `scratch` is what the texts with escapes take, and what there is.
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

// Always inlined, so that nothing refers to the code that would write `expected` and the messages.
impl serde::de::Error for Error {
    #[inline(always)]
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Serde(GoalErrorKind::Refused)
    }

    #[inline(always)]
    fn invalid_type(_: serde::de::Unexpected<'_>, _: &dyn serde::de::Expected) -> Self {
        Self::Serde(GoalErrorKind::WrongType)
    }

    #[inline(always)]
    fn invalid_value(found: serde::de::Unexpected<'_>, _: &dyn serde::de::Expected) -> Self {
        use serde::de::Unexpected::{Float, Signed, Unsigned};
        Self::Serde(match found {
            Unsigned(_) | Signed(_) | Float(_) => GoalErrorKind::OutOfRange,
            _ => GoalErrorKind::WrongValue,
        })
    }

    #[inline(always)]
    fn invalid_length(_: usize, _: &dyn serde::de::Expected) -> Self {
        Self::Serde(GoalErrorKind::WrongLength)
    }

    #[inline(always)]
    fn unknown_variant(_: &str, expected: &'static [&'static str]) -> Self {
        Self::Serde(GoalErrorKind::UnknownVariant(expected))
    }

    #[inline(always)]
    fn unknown_field(_: &str, expected: &'static [&'static str]) -> Self {
        Self::Serde(GoalErrorKind::UnknownField(expected))
    }

    #[inline(always)]
    fn missing_field(field: &'static str) -> Self {
        Self::Serde(GoalErrorKind::MissingField(field))
    }

    #[inline(always)]
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
    /// Writes where it is and what is wrong, as `Display` does, but without `core::fmt`: for the
    /// person who wrote the goal.
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
                put_decimal(sink, u32::from(super::MAX_DEPTH));
                sink.put(b" levels");
            }
            Self::OutOfRange => texts(["number out of range", "", ""]),
            Self::WrongType => texts(["wrong type", "", ""]),
            Self::WrongValue => texts(["wrong value", "", ""]),
            Self::WrongLength => texts(["too few or too many items", "", ""]),
            Self::UnknownField(fields) => put_names("unknown field", fields, sink),
            Self::UnknownVariant(variants) => put_names("unknown variant", variants, sink),
            Self::MissingField(field) => texts(["field ", field, " is missing"]),
            Self::DuplicateField(field) => texts(["field ", field, " is there twice"]),
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

/// A formatter as a sink of texts.
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
    /// A collection within [`MAX_DEPTH`](super::MAX_DEPTH) others.
    TooDeep,
    /// The caller's buffer is too small.
    BufferTooSmall(BufferTooSmall),
    /// The value's own code refused; what it said would take `core::fmt` to keep.
    Refused,
}

impl fmt::Display for WriteError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooDeep => write!(f, "more than {} levels", super::MAX_DEPTH),
            Self::BufferTooSmall(cause) => cause.fmt(f),
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
    #[inline(always)]
    fn custom<T: fmt::Display>(_: T) -> Self {
        Self::Refused
    }
}
