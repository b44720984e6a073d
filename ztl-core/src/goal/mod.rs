//! Goals and results as values: what a client wants as the firmware's own types, and their values as
//! a client of the original reads them. With the feature `serde`, which is on unless turned off.
//!
//! ```
//! use serde::{Deserialize, Serialize};
//! use ztl_core::goal;
//!
//! #[derive(Debug, PartialEq, Deserialize, Serialize)]
//! #[serde(deny_unknown_fields)]
//! struct Pose { x: f32, y: f32, theta: f32 }
//!
//! let pose = Pose { x: 0.0, y: -0.5, theta: 1.57 };
//! for text in ["[0, -0.5, 1.57]", "{'x': 0, 'theta': 1.57, 'y': -.5}", "{x: 0, y: -5e-1, theta: 1.57}"] {
//!     assert_eq!(goal::from_str(text), Ok(Pose { ..pose }));
//! }
//! let error = goal::from_str::<Pose>("{x: 0, y: 0, z: 1.57}").unwrap_err();
//! assert_eq!(error.to_string(), "goal, byte 13: unknown field, expected x or y or theta");
//!
//! let mut buffer = [0; 64];
//! assert_eq!(goal::to_slice(&pose, &mut buffer), Ok("{'x': 0.0, 'y': -0.5, 'theta': 1.57}"));
//! ```
//!
//! # What is read
//!
//! The original's clients send Python's `str` of a value that was YAML (wire specification 6); people
//! type YAML in flow style. Both are read, in one dialect: where a text is read differently by the
//! two, **Python's `repr` wins**, since nearly every goal comes from it, **or it is an error**.
//!
//! The goal itself, when the target is a text, is taken as it stands, whatever it looks like:
//! `hello, world: it's`, `'tis`, `[draft]`, and the empty text. That is how `str` writes a text. For
//! every other target, and for everything within a collection:
//!
//! | text | value |
//! |---|---|
//! | `None` `null` `Null` `NULL` `~` | nothing; an `Option` at the top takes an empty goal so too |
//! | `True` `true` `TRUE` `False` `false` `FALSE` | bool |
//! | `yes` `on` `no` `off`, also as `Yes` `YES`… | bool for a bool, else text |
//! | `7` `+7` `-1_000` `0x1F` `0o17` `0b1` | whole number of 64 bits; beyond is an error, except for a float |
//! | `1.5` `1.` `.5` `-.0` `1e3` `-1.5E-3` `1_0.5` | float; a whole number is one too, when a float is asked for |
//! | `inf` `-inf` `nan` `.inf` `.Inf` `.INF` `.nan` `.NaN` `.NAN` | float |
//! | `010` | text, and an error for a number: 8 to YAML, 10 to a person, nothing to Python |
//! | `[a, b]` `(a, b)` `(a,)` `[a, b,]` | sequence; `(a)` is an error |
//! | `{k: v, 'k': v, k : v}` | mapping; the `:` needs a blank or bracket behind it after a plain key |
//! | `'it\'s'` `'it''s'` | text; see below |
//! | `"it's"` `"\u00e9"` | text; see below |
//! | anything else | text, without the blanks around it |
//!
//! A plain text within a collection may contain blanks and quotes, as `say it's me`. It ends before
//! `,` `]` `}`, before `:` with a blank or a bracket behind it, and before a `)` that it did not open;
//! it contains no `[` `{`, no comma within `( )`, no ` #` and no line break, and does not begin with one
//! of ``# & * ! | > % @ ` ``, with `- `, `? ` or with `b'`. Comments, tags, anchors, `[a: b]`, empty values
//! (`{a: , b}`), Python's other literals (bytes, sets, `datetime.date(2020, 1, 1)`), and a NUL, which neither of
//! the two takes, are errors.
//!
//! **Within `'…'`** a backslash is Python's: `\\ \' \" \n \r \t \a \b \f \v \xNN \uNNNN \UNNNNNNNN`. Any other
//! stays as it stands, which is what Python and YAML agree on, but `\N`, octal `\0` to `\7` and one before a
//! line break are errors. `''` is YAML's for `'`; Python's `repr` never writes it but for the empty text.
//! **Within `"…"`** these are read and YAML's `\0 \e \/ \_ \N \L \P`, `\` before a blank; any other is an error.
//! In both, two `\u` make one character as in JSON, and a line break is folded as in YAML.
//!
//! A text or key in quotes that has any of these needs scratch to be written to:
//! [`from_str_with`]. Others are views of the goal's text.
//!
//! # What the target decides
//!
//! | target | takes |
//! |---|---|
//! | `&str`, a string, `char` | a text in quotes, or a plain one as it is written, also `1e3`, `True`, `None` |
//! | integers, `bool` | as above; no quotes; `1.0` is no integer |
//! | `f32`, `f64` | a number, also in quotes: YAML 1.1 takes `1e3` for a text, so that the original sends `'1e3'` |
//! | a struct | a mapping, or a sequence of all its fields; a key twice is an error, and what an unknown one has is skipped, unless the struct says `#[serde(deny_unknown_fields)]` |
//! | an enum | `variant` or `'variant'`; `{variant: value}` |
//! | a tuple, `Vec`, array | a sequence, of the right length |
//! | `deserialize_any` | what the text looks like, integers as `u64` or `i64`, floats as `f64` |
//!
//! Numbers of up to 19 significant digits are rounded correctly: to the nearest `f32` or `f64`, of two
//! equally near ones to the even. Longer ones are too, unless they were made not to be; digits behind the 45th
//! count only as "a little more". What is greater than the greatest is an error, not infinity.
//!
//! Reading takes time linear in the text's length for any target of bounded size, no heap, and stack for at
//! most [`MAX_DEPTH`] levels.
//!
//! # What is written
//!
//! What Python's `str` makes of the value: a text as it is, or in quotes within a collection; a struct
//! as a dict, a tuple as a list, a unit variant as its name, other variants as `{'variant': value}`,
//! bytes as a list of numbers. (A key that is a list is read here, but not by Python.) Floats as [`Floats`] says: [`Shortest`], as Python, or [`Fixed`].

mod access;
mod de;
mod decimal;
mod display;
mod error;
mod floats;
mod number;
mod quoted;
mod reader;
mod ser;
#[cfg(test)]
mod tests;

pub use error::{Expected, GoalError, GoalErrorKind, WriteError};
pub use floats::{Fixed, Floats, Shortest};

use core::marker::PhantomData;

use serde::{Deserialize, Serialize};

use crate::sink::{Sink, SliceSink};
use quoted::Scratch;
use reader::Reader;

/// Collections within each other, read or written; more are an error, so that the stack is bounded.
pub const MAX_DEPTH: u8 = 8;

/// Reads a goal.
///
/// # Errors
/// [`GoalError`] when it is not what `T` takes, or has a text with escapes
/// ([`GoalErrorKind::NeedsScratch`]).
pub fn from_str<'de, T: Deserialize<'de>>(text: &'de str) -> Result<T, GoalError> {
    read(Reader::new(text, None))
}

/// Reads a goal, in which texts may have escapes.
///
/// `scratch` takes these texts as they are meant, one behind the other, and `T` may borrow from it. As
/// many bytes as the goal has suffice, unless there is a `\L` or `\P`, which take a byte more.
///
/// ```
/// use ztl_core::goal;
/// let mut scratch = [0; 32];
/// let lines: [&str; 2] = goal::from_str_with(r"['plain', 'it\'s\n']", &mut scratch)?;
/// assert_eq!(lines, ["plain", "it's\n"]);
/// # Ok::<(), goal::GoalError>(())
/// ```
///
/// # Errors
/// [`GoalError`] when it is not what `T` takes, or when the scratch is too small
/// ([`GoalErrorKind::ScratchTooSmall`]).
pub fn from_str_with<'de, T: Deserialize<'de>>(
    text: &'de str,
    scratch: &'de mut [u8],
) -> Result<T, GoalError> {
    read(Reader::new(text, Some(Scratch::new(scratch))))
}

fn read<'de, T: Deserialize<'de>>(mut reader: Reader<'de>) -> Result<T, GoalError> {
    let read = reader.value(PhantomData).and_then(|value| {
        reader.end()?;
        Ok(value)
    });
    read.map_err(|error| error.at(reader.text.at, reader.scratch_too_small()))
}

/// Writes a result, with floats as Python writes them.
///
/// # Errors
/// [`WriteError`] when there are too many levels or the value's own code refuses; a part was
/// written by then.
pub fn to_sink<T, S>(value: &T, sink: &mut S) -> Result<(), WriteError>
where
    T: Serialize + ?Sized,
    S: Sink + ?Sized,
{
    to_sink_with(value, Shortest, sink)
}

/// Writes a result, with floats of one's choice.
///
/// # Errors
/// As [`to_sink`].
pub fn to_sink_with<T, S>(value: &T, floats: impl Floats, sink: &mut S) -> Result<(), WriteError>
where
    T: Serialize + ?Sized,
    S: Sink + ?Sized,
{
    value.serialize(&mut ser::Writer::new(sink, floats))
}

/// Writes a result into `buffer`, with floats as Python writes them.
///
/// # Errors
/// As [`to_sink`], and [`WriteError::BufferTooSmall`].
pub fn to_slice<'b, T>(value: &T, buffer: &'b mut [u8]) -> Result<&'b str, WriteError>
where
    T: Serialize + ?Sized,
{
    to_slice_with(value, Shortest, buffer)
}

/// Writes a result into `buffer`, with floats of one's choice.
///
/// ```
/// use ztl_core::goal;
/// let mut buffer = [0; 32];
/// assert_eq!(goal::to_slice_with(&[1.0f32, 0.125], goal::Fixed(2), &mut buffer), Ok("[1.00, 0.12]"));
/// ```
///
/// # Errors
/// As [`to_sink`], and [`WriteError::BufferTooSmall`].
pub fn to_slice_with<'b, T>(
    value: &T,
    floats: impl Floats,
    buffer: &'b mut [u8],
) -> Result<&'b str, WriteError>
where
    T: Serialize + ?Sized,
{
    let mut sink = SliceSink::new(buffer);
    to_sink_with(value, floats, &mut sink)?;
    let text = sink.finish().map_err(WriteError::BufferTooSmall)?;
    // What was put is text.
    Ok(core::str::from_utf8(text).unwrap_or_default())
}
