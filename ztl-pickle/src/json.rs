//! Values as JSON.

use std::fmt::{self, Display, Write};

use ztl_core::base64::Encoder;
use ztl_core::sink::Sink;

use crate::dtype::Element;
use crate::integer::is_printable;
use crate::repr;
use crate::time::{Date, Time, TimeDelta};
use crate::value::{Kind, Value};
use crate::walk::{Limited, Visitor, walk};

/// Why a value has no JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum JsonError {
    /// A collection contains itself.
    Recursive,
    /// The JSON would be longer than this many bytes.
    TooLong {
        /// The limit.
        most: usize,
    },
}

impl Display for JsonError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Recursive => f.write_str("no JSON for a value that contains itself"),
            Self::TooLong { most } => write!(f, "the JSON exceeds {most} bytes"),
        }
    }
}

impl std::error::Error for JsonError {}

impl Value<'_> {
    /// Its JSON, of at most this many bytes.
    ///
    /// | Python | JSON |
    /// |---|---|
    /// | `list`, `tuple`, `set`, `frozenset`, array | array; an array of numpy without dimensions is its element |
    /// | `dict`, `OrderedDict` | object; a key that is not a `str` is written as by `repr`, so that two may look equal |
    /// | `int` | number with all digits; above 4300 digits a hexadecimal string |
    /// | `nan`, infinity | `"NaN"`, `"Infinity"`, `"-Infinity"` |
    /// | `bytes`, `bytearray` | `{"base64": "..."}` |
    /// | `complex` of numpy | `[real, imaginary]` |
    /// | `date`, `time`, `datetime` | string of RFC 3339, without zone if it has none |
    /// | `timedelta`, `timezone` | seconds; of a zone, its offset |
    /// | `dtype` | its name |
    ///
    /// ```
    /// # use ztl_pickle::Pickle;
    /// let pickle = Pickle::dict([("pose", Pickle::list([1.5, f64::NAN])?)])?;
    /// assert_eq!(pickle.value().to_json(100).unwrap(), r#"{"pose": [1.5, "NaN"]}"#);
    /// # Ok::<(), ztl_pickle::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`JsonError`] if it contains itself, or the JSON would be longer.
    pub fn to_json(self, most: usize) -> Result<String, JsonError> {
        to_json(self, most)
    }
}

fn to_json(value: Value<'_>, most: usize) -> Result<String, JsonError> {
    let mut text = String::new();
    let mut out = Limited {
        out: &mut text,
        left: most,
        is_cut: false,
    };
    let result = walk(value, &mut Json(&mut out));
    match result {
        Ok(()) => Ok(text),
        Err(fmt::Error) if out.is_cut => Err(JsonError::TooLong { most }),
        Err(fmt::Error) => Err(JsonError::Recursive),
    }
}

struct Json<'a, W>(&'a mut W);

impl<W: Write> Visitor for Json<'_, W> {
    fn leaf(&mut self, value: Value<'_>) -> fmt::Result {
        let out = &mut *self.0;
        match value.kind() {
            Kind::Bool(value) => write!(out, "{value}"),
            Kind::Int(value) => write!(out, "{value}"),
            Kind::BigInt(value) if is_printable(value.to_le_bytes()) => write!(out, "{value}"),
            Kind::BigInt(value) => write!(out, "\"{value}\""),
            Kind::Float(value) => put_float(value, out),
            Kind::Str(text) => put_text(text.as_bytes(), out),
            Kind::BrokenStr(bytes) => put_text(bytes, out),
            Kind::Bytes(bytes) | Kind::ByteArray(bytes) => put_bytes(bytes, out),
            Kind::Array(array) => repr::put_nested(array, out, put_element),
            Kind::Scalar(scalar) => match scalar.element() {
                Some(element) => put_element(&element, out),
                None => out.write_str("null"),
            },
            Kind::DType(dtype) => write!(out, "\"{dtype}\""),
            Kind::Date(date) => {
                out.write_char('"')?;
                put_date(date, out)?;
                out.write_char('"')
            }
            Kind::Time(time) => {
                out.write_char('"')?;
                put_time(time, out)?;
                out.write_char('"')
            }
            Kind::DateTime(moment) => {
                out.write_char('"')?;
                put_date(moment.date, out)?;
                out.write_char('T')?;
                put_time(moment.time, out)?;
                out.write_char('"')
            }
            Kind::TimeDelta(delta) => put_seconds(delta, out),
            Kind::TimeZone(zone) => put_seconds(zone.offset, out),
            _ => out.write_str("null"),
        }
    }

    fn open(&mut self, value: Value<'_>) -> fmt::Result {
        self.0.write_char(if is_mapping(value) { '{' } else { '[' })
    }

    fn before(&mut self, value: Value<'_>, index: u32) -> fmt::Result {
        self.0.write_str(match index {
            0 => "",
            _ if is_mapping(value) && !index.is_multiple_of(2) => ": ",
            _ => ", ",
        })
    }

    fn close(&mut self, value: Value<'_>) -> fmt::Result {
        self.0.write_char(if is_mapping(value) { '}' } else { ']' })
    }

    fn recursive(&mut self, _: Value<'_>) -> fmt::Result {
        Err(fmt::Error)
    }

    fn key(&mut self, value: Value<'_>) -> Result<bool, fmt::Error> {
        match value.kind() {
            Kind::Str(text) => put_text(text.as_bytes(), self.0)?,
            Kind::BrokenStr(bytes) => put_text(bytes, self.0)?,
            _ => {
                self.0.write_char('"')?;
                repr::put(value, &mut Escaped(self.0))?;
                self.0.write_char('"')?;
            }
        }
        Ok(true)
    }
}

fn is_mapping(value: Value<'_>) -> bool {
    matches!(value.kind(), Kind::Dict(_) | Kind::OrderedDict(_))
}

/// What stands in a string.
struct Escaped<'a, W>(&'a mut W);

impl<W: Write> Write for Escaped<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut rest = text;
        while let Some(at) = rest.find(|c: char| c < ' ' || matches!(c, '"' | '\\' | '\x7f')) {
            let (plain, special) = rest.split_at(at);
            self.0.write_str(plain)?;
            let mut chars = special.chars();
            match chars.next() {
                Some('"') => self.0.write_str("\\\"")?,
                Some('\\') => self.0.write_str("\\\\")?,
                Some('\n') => self.0.write_str("\\n")?,
                Some('\r') => self.0.write_str("\\r")?,
                Some('\t') => self.0.write_str("\\t")?,
                Some(c) => write!(self.0, "\\u{:04x}", u32::from(c))?,
                None => {}
            }
            rest = chars.as_str();
        }
        self.0.write_str(rest)
    }
}

fn put_text(bytes: &[u8], out: &mut impl Write) -> fmt::Result {
    out.write_char('"')?;
    for part in repr::parts(bytes) {
        match part {
            Ok(text) => Escaped(out).write_str(text)?,
            Err(surrogate) => write!(out, "\\u{surrogate:04x}")?,
        }
    }
    out.write_char('"')
}

fn put_float(value: f64, out: &mut impl Write) -> fmt::Result {
    match value {
        f64::INFINITY => out.write_str("\"Infinity\""),
        f64::NEG_INFINITY => out.write_str("\"-Infinity\""),
        _ if value.is_nan() => out.write_str("\"NaN\""),
        _ => repr::put_float(value, 8, out),
    }
}

fn put_bytes(bytes: &[u8], out: &mut impl Write) -> fmt::Result {
    out.write_str("{\"base64\": \"")?;
    let mut result = Ok(());
    let mut sink = |text: &[u8]| {
        if result.is_ok() {
            result = out.write_str(std::str::from_utf8(text).unwrap_or_default());
        }
    };
    let mut encoder = Encoder::new(&mut sink);
    encoder.put(bytes);
    encoder.finish();
    result?;
    out.write_str("\"}")
}

fn put_element<W: Write>(element: &Element<'_>, out: &mut W) -> fmt::Result {
    match element {
        Element::Bool(value) => write!(out, "{value}"),
        Element::Int(value) => write!(out, "{value}"),
        Element::UInt(value) => write!(out, "{value}"),
        Element::Float(value) => put_float(*value, out),
        Element::Complex(real, imaginary) => {
            out.write_char('[')?;
            put_float(*real, out)?;
            out.write_str(", ")?;
            put_float(*imaginary, out)?;
            out.write_char(']')
        }
        Element::Bytes(bytes) => put_bytes(bytes, out),
        Element::Text(text) => put_text(text.as_bytes(), out),
    }
}

/// The seconds with all their digits.
fn put_seconds(delta: TimeDelta, out: &mut impl Write) -> fmt::Result {
    let seconds = i128::from(delta.days) * 86400 + i128::from(delta.seconds);
    let micros = seconds * 1_000_000 + i128::from(delta.micros);
    let sign = if micros < 0 { "-" } else { "" };
    let (seconds, rest) = (
        micros.unsigned_abs() / 1_000_000,
        micros.unsigned_abs() % 1_000_000,
    );
    write!(out, "{sign}{seconds}.{rest:06}")
}

fn put_date(Date { year, month, day }: Date, out: &mut impl Write) -> fmt::Result {
    write!(out, "{year:04}-{month:02}-{day:02}")
}

fn put_time(time: Time<'_>, out: &mut impl Write) -> fmt::Result {
    write!(
        out,
        "{:02}:{:02}:{:02}",
        time.hour, time.minute, time.second
    )?;
    if time.micros != 0 {
        write!(out, ".{:06}", time.micros)?;
    }
    let Some(zone) = time.zone else {
        return Ok(());
    };
    let micros = zone.offset.total_micros();
    let sign = if micros < 0 { '-' } else { '+' };
    let (seconds, micros) = (
        micros.unsigned_abs() / 1_000_000,
        micros.unsigned_abs() % 1_000_000,
    );
    write!(out, "{sign}{:02}:{:02}", seconds / 3600, seconds / 60 % 60)?;
    // As Python, beyond RFC 3339.
    if seconds % 60 != 0 || micros != 0 {
        write!(out, ":{:02}", seconds % 60)?;
    }
    if micros != 0 {
        write!(out, ".{micros:06}")?;
    }
    Ok(())
}
