//! Goals and results as values: a goal is parsed into the firmware's own types, and results are written so
//! that clients of the original can read them. Requires the feature `serde`, which is on by default.
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
//! The original's clients send Python's `str` of a value that was YAML; people type YAML in flow style. This
//! module reads both in one dialect. Where the two disagree about a text, **Python's `repr` wins**, because
//! nearly every goal comes from it, **or the text is an error**.
//!
//! If the target is a text, the goal is always taken unchanged: `hello, world: it's`,
//! `'tis`, `[draft]`, and the empty text. That is how `str` writes a text. For every other target, and for
//! everything within a collection:
//!
//! | text | value |
//! |---|---|
//! | `None` `null` `Null` `NULL` `~` | nothing; at the top, an `Option` also takes an empty goal |
//! | `True` `true` `TRUE` `False` `false` `FALSE` | bool |
//! | `yes` `on` `no` `off`, also as `Yes` `YES`… | bool if the target is a bool, else text |
//! | `7` `+7` `-1_000` `0x1F` `0o17` `0b1` | integer of 64 bits; a larger one is an error, except for a float |
//! | `1.5` `1.` `.5` `-.0` `1e3` `-1.5E-3` `1_0.5` | float; a float target also takes an integer |
//! | `inf` `-inf` `nan` `.inf` `.Inf` `.INF` `.nan` `.NaN` `.NAN` | float |
//! | `010` | text, and an error for a number: YAML reads 8, a person 10, Python nothing |
//! | `[a, b]` `(a, b)` `(a,)` `[a, b,]` | sequence; `(a)` is an error |
//! | `{k: v, 'k': v, k : v}` | mapping; after a plain key, a space or bracket must follow the `:` |
//! | `'it\'s'` `'it''s'` | text; see below |
//! | `"it's"` `"\u00e9"` | text; see below |
//! | anything else | text, without surrounding whitespace |
//!
//! A plain text within a collection may contain spaces and quotes, such as `say it's me`. It ends before `,`
//! `]` `}`, before a `:` followed by a space or bracket, and before a `)` that it did not open. It contains
//! no `[` `{`, no comma within `( )`, no ` #` and no line break. It does not begin with one of ``# & * ! | >
//! % @ ` ``, with `- `, `? ` or with `b'`. These are errors: comments, tags, anchors, `[a: b]`, empty values
//! (`{a: , b}`), Python's other literals (bytes, sets, `datetime.date(2020, 1, 1)`), and NUL, which neither
//! language takes.
//!
//! **Within `'…'`** backslashes are Python's: `\\ \' \" \n \r \t \a \b \f \v \xNN \uNNNN \UNNNNNNNN`. Any other backslash stays as it is, on which Python and YAML
//! agree. But `\N`, octal `\0` to `\7`, and a backslash before a line break are errors. `''` is YAML's form
//! of `'`; Python's `repr` writes it only for the empty text.
//! **Within `"…"`** the same escapes and YAML's `\0 \e \/ \_ \N \L \P` and `\` before a space are read; any
//! other is an error. In both, a pair of `\u` makes one character as in JSON, and line breaks fold as in
//! YAML.
//!
//! A quoted text or key with any of these must be decoded into scratch: use [`from_str_with`]. All others are
//! views of the goal's text.
//!
//! # Targets
//!
//! | target | takes |
//! |---|---|
//! | `&str`, a string, `char` | a text in quotes, or a plain one unchanged, even `1e3`, `True`, `None` |
//! | integers, `bool` | as above, without quotes; `1.0` is not an integer |
//! | `f32`, `f64` | a number, with or without quotes: YAML 1.1 reads `1e3` as text, so the original sends
//! `'1e3'` |
//! | a struct | a mapping, or a sequence of all its fields; a repeated key is an error; an unknown key and its value are skipped, unless the struct has `#[serde(deny_unknown_fields)]` |
//! | an enum | `variant` or `'variant'`; `{variant: value}` |
//! | a tuple, `Vec`, array | a sequence, of the right length |
//! | `deserialize_any` | whatever the text looks like; integers as `u64` or `i64`, floats as `f64` |
//!
//! Numbers with up to 19 significant digits are rounded correctly to the nearest `f32` or `f64`, a tie to the
//! even one. So are longer ones, unless they are constructed to defeat it: digits after the 45th count only
//! as "slightly more". A number beyond the largest float is an error, not infinity.
//!
//! For a target of bounded size, reading takes time linear in the text's length, no heap, and stack for at
//! most [`MAX_DEPTH`] levels.
//!
//! # What is written
//!
//! The value as Python's `str` writes it. A text is unquoted at the top and quoted within a collection; a
//! struct becomes a dict, a tuple a list, a unit variant its name, any other variant `{'variant': value}`,
//! bytes a list of numbers. (This module also reads a list as a key; Python does not.) Floats are written by
//! [`Floats`]: [`Shortest`], like Python, or [`Fixed`].

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

pub use error::{Expected, GoalError, GoalErrorKind, MAX_DEPTH, WriteError};
pub use floats::{Fixed, Floats, Shortest};

use core::marker::PhantomData;

use serde::{Deserialize, Serialize};

use crate::sink::{Sink, SliceSink};
use quoted::Scratch;
use reader::Reader;

/// Parses a goal.
///
/// # Errors
/// [`GoalError`] if the text is not what `T` takes, or contains a text with escapes
/// ([`GoalErrorKind::NeedsScratch`]).
pub fn from_str<'de, T: Deserialize<'de>>(text: &'de str) -> Result<T, GoalError> {
    read(Reader::new(text, None))
}

/// Parses a goal that may contain texts with escapes.
///
/// The decoded texts are stored in `scratch`, from which `T` may borrow. As many bytes as the goal has are
/// enough, except that each `\L` or `\P` takes one more.
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
/// [`GoalError`] if the text is not what `T` takes, or `scratch` is too small
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
/// [`WriteError`] if there are too many levels, or the value's own code returns an error. Part of the output
/// is written by then.
pub fn to_sink<T, S>(value: &T, sink: &mut S) -> Result<(), WriteError>
where
    T: Serialize + ?Sized,
    S: Sink + ?Sized,
{
    to_sink_with(value, Shortest, sink)
}

/// Writes a result with the given float format.
///
/// # Errors
/// See [`to_sink`].
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
/// See [`to_sink`]; also [`WriteError::BufferTooSmall`].
pub fn to_slice<'b, T>(value: &T, buffer: &'b mut [u8]) -> Result<&'b str, WriteError>
where
    T: Serialize + ?Sized,
{
    to_slice_with(value, Shortest, buffer)
}

/// Writes a result into `buffer` with the given float format.
///
/// ```
/// use ztl_core::goal;
/// let mut buffer = [0; 32];
/// assert_eq!(goal::to_slice_with(&[1.0f32, 0.125], goal::Fixed(2), &mut buffer), Ok("[1.00, 0.12]"));
/// ```
///
/// # Errors
/// See [`to_sink`]; also [`WriteError::BufferTooSmall`].
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
    // The writer only produces UTF-8.
    Ok(core::str::from_utf8(text).unwrap_or_default())
}
