//! Values as PyYAML reads them, and the text that Python sends for them.

use std::fmt::{self, Display, Write as _};

use ztl_core::goal::{Floats, Shortest};
use ztl_core::repr::put_quoted;

/// A value as PyYAML reads it. [`Display`] writes its plain form [6.1], Python's `str`.
#[derive(Debug, Clone, PartialEq)]
pub enum PythonValue {
    /// `None`.
    Null,
    /// `True`, `False`.
    Bool(bool),
    /// A whole number of any size: its decimal digits, after a `-` if it is negative.
    Int(String),
    /// A float.
    Float(f64),
    /// A text.
    Text(String),
    /// A day.
    Date(Date),
    /// A moment.
    Time(Timestamp),
    /// `!!binary`.
    Bytes(Vec<u8>),
    /// A sequence.
    List(Vec<PythonValue>),
    /// A mapping, without equal keys.
    Map(Vec<(PythonValue, PythonValue)>),
    /// `!!omap` and `!!pairs`: a list of tuples.
    Pairs(Vec<(PythonValue, PythonValue)>),
    /// `!!set`.
    Set(Vec<PythonValue>),
}

/// A day of Python's calendar, which begins with the year 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Date {
    /// From 1 to 9999.
    pub year: u16,
    /// From 1.
    pub month: u8,
    /// From 1.
    pub day: u8,
}

/// A moment of a day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timestamp {
    /// The day.
    pub date: Date,
    /// Hour, minute, second.
    pub clock: (u8, u8, u8),
    /// Microseconds.
    pub micros: u32,
    /// Minutes ahead of UTC, if given.
    pub offset: Option<i32>,
}

impl PythonValue {
    /// Equal for equal keys of a mapping. In Python `1`, `1.0` and `True` are equal keys, and so is each
    /// `.nan`, which PyYAML creates only once.
    pub fn identity(&self) -> String {
        match self {
            Self::Text(text) => format!("'{text}"),
            other => other.number().unwrap_or_else(|| other.quoted().to_string()),
        }
    }

    /// Whether it can be a key.
    #[must_use]
    pub const fn is_hashable(&self) -> bool {
        !matches!(
            self,
            Self::List(_) | Self::Map(_) | Self::Pairs(_) | Self::Set(_)
        )
    }

    /// Its number as a key.
    fn number(&self) -> Option<String> {
        match self {
            Self::Bool(value) => Some(u8::from(*value).to_string()),
            Self::Int(digits) => Some(digits.clone()),
            Self::Float(value) if value.fract() == 0.0 => {
                Some(format!("{:.0}", if *value == 0.0 { 0.0 } else { *value }))
            }
            Self::Float(value) => Some(value.to_string()),
            _ => None,
        }
    }

    /// Its quoted form [6.2], Python's `repr`.
    fn quoted(&self) -> Quoted<'_> {
        Quoted(self)
    }
}

impl Display for PythonValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Null => f.write_str("None"),
            Self::Bool(true) => f.write_str("True"),
            Self::Bool(false) => f.write_str("False"),
            Self::Int(text) | Self::Text(text) => f.write_str(text),
            Self::Float(value) => f.write_str(&float(*value)),
            Self::Date(date) => date.fmt(f),
            Self::Time(time) => time.fmt(f),
            Self::Bytes(bytes) => quoted_bytes(bytes, f),
            Self::List(items) => {
                f.write_char('[')?;
                joined(items, f, |item, f| item.quoted().fmt(f))?;
                f.write_char(']')
            }
            Self::Pairs(pairs) => {
                f.write_char('[')?;
                joined(pairs, f, |(one, other), f| {
                    write!(f, "({}, {})", one.quoted(), other.quoted())
                })?;
                f.write_char(']')
            }
            Self::Map(pairs) => {
                f.write_char('{')?;
                joined(pairs, f, |(key, value), f| {
                    write!(f, "{}: {}", key.quoted(), value.quoted())
                })?;
                f.write_char('}')
            }
            Self::Set(items) if items.is_empty() => f.write_str("set()"),
            Self::Set(items) => {
                f.write_char('{')?;
                joined(items, f, |item, f| item.quoted().fmt(f))?;
                f.write_char('}')
            }
        }
    }
}

fn joined<T>(
    items: &[T],
    f: &mut fmt::Formatter<'_>,
    mut put: impl FnMut(&T, &mut fmt::Formatter<'_>) -> fmt::Result,
) -> fmt::Result {
    for (index, item) in items.iter().enumerate() {
        if index > 0 {
            f.write_str(", ")?;
        }
        put(item, f)?;
    }
    Ok(())
}

/// A value in its quoted form, as within a collection.
struct Quoted<'v>(&'v PythonValue);

impl Display for Quoted<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            PythonValue::Text(text) => f.write_str(&quoted(text)),
            PythonValue::Date(Date { year, month, day }) => {
                write!(f, "datetime.date({year}, {month}, {day})")
            }
            PythonValue::Time(time) => time.quoted(f),
            other => other.fmt(f),
        }
    }
}

/// A text in quotes, as Python's `repr`.
pub fn quoted(text: &str) -> String {
    let mut out = Vec::with_capacity(text.len() + 2);
    put_quoted(text, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
    String::from_utf8_lossy(&out).into_owned()
}

fn float(value: f64) -> String {
    // Python writes `nan` without a sign.
    let value = if value.is_nan() { f64::NAN } else { value };
    let mut out = Vec::new();
    Shortest.put_f64(value, &mut |bytes: &[u8]| out.extend_from_slice(bytes));
    String::from_utf8_lossy(&out).into_owned()
}

fn quoted_bytes(bytes: &[u8], f: &mut fmt::Formatter<'_>) -> fmt::Result {
    let quote = if bytes.contains(&b'\'') && !bytes.contains(&b'"') {
        '"'
    } else {
        '\''
    };
    write!(f, "b{quote}")?;
    for byte in bytes {
        match byte {
            b'\\' => f.write_str("\\\\")?,
            b'\n' => f.write_str("\\n")?,
            b'\r' => f.write_str("\\r")?,
            b'\t' => f.write_str("\\t")?,
            byte if char::from(*byte) == quote => write!(f, "\\{quote}")?,
            b' '..=b'~' => f.write_char(char::from(*byte))?,
            byte => write!(f, "\\x{byte:02x}")?,
        }
    }
    f.write_char(quote)
}

impl Date {
    /// The day, if it exists.
    pub(crate) fn new(year: u16, month: u8, day: u8) -> Option<Self> {
        let leap =
            year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
        let days = match month {
            1 | 3 | 5 | 7 | 8 | 10 | 12 => 31,
            4 | 6 | 9 | 11 => 30,
            2 if leap => 29,
            2 => 28,
            _ => return None,
        };
        let known = (1..=9999).contains(&year) && (1..=days).contains(&day);
        known.then_some(Self { year, month, day })
    }
}

impl Display for Date {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:04}-{:02}-{:02}", self.year, self.month, self.day)
    }
}

impl Timestamp {
    fn quoted(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Date { year, month, day } = self.date;
        let (hour, minute, second) = self.clock;
        write!(
            f,
            "datetime.datetime({year}, {month}, {day}, {hour}, {minute}"
        )?;
        if second != 0 || self.micros != 0 {
            write!(f, ", {second}")?;
        }
        if self.micros != 0 {
            write!(f, ", {}", self.micros)?;
        }
        match self.offset {
            Some(0) => f.write_str(", tzinfo=datetime.timezone.utc")?,
            Some(minutes) => {
                // Python writes a negative offset as negative days and positive seconds.
                let (days, minutes) = (minutes.div_euclid(24 * 60), minutes.rem_euclid(24 * 60));
                let days = if days < 0 {
                    format!("days={days}")
                } else {
                    String::new()
                };
                let seconds = if minutes > 0 {
                    format!("seconds={}", minutes * 60)
                } else {
                    String::new()
                };
                let comma = if days.is_empty() || seconds.is_empty() {
                    ""
                } else {
                    ", "
                };
                write!(
                    f,
                    ", tzinfo=datetime.timezone(datetime.timedelta({days}{comma}{seconds}))"
                )?;
            }
            None => {}
        }
        f.write_char(')')
    }
}

impl Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (hour, minute, second) = self.clock;
        write!(f, "{} {hour:02}:{minute:02}:{second:02}", self.date)?;
        if self.micros != 0 {
            write!(f, ".{:06}", self.micros)?;
        }
        if let Some(offset) = self.offset {
            let sign = if offset < 0 { '-' } else { '+' };
            let offset = offset.unsigned_abs();
            write!(f, "{sign}{:02}:{:02}", offset / 60, offset % 60)?;
        }
        Ok(())
    }
}
