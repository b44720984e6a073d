//! Parses the text of a definition, as genmsg does.

use std::fmt;

/// A type that ROS itself defines.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Primitive {
    /// `bool`, one byte.
    Bool,
    /// `int8`, and `byte`.
    Int8,
    /// `uint8`, and `char`.
    Uint8,
    /// `int16`.
    Int16,
    /// `uint16`.
    Uint16,
    /// `int32`.
    Int32,
    /// `uint32`.
    Uint32,
    /// `int64`.
    Int64,
    /// `uint64`.
    Uint64,
    /// `float32`.
    Float32,
    /// `float64`.
    Float64,
    /// `string`.
    Text,
    /// `time`: seconds and nanoseconds since 1970, both unsigned.
    Time,
    /// `duration`: seconds and nanoseconds, both signed.
    Duration,
}

const PRIMITIVES: [(&str, Primitive); 16] = [
    ("bool", Primitive::Bool),
    ("int8", Primitive::Int8),
    ("uint8", Primitive::Uint8),
    ("int16", Primitive::Int16),
    ("uint16", Primitive::Uint16),
    ("int32", Primitive::Int32),
    ("uint32", Primitive::Uint32),
    ("int64", Primitive::Int64),
    ("uint64", Primitive::Uint64),
    ("float32", Primitive::Float32),
    ("float64", Primitive::Float64),
    ("string", Primitive::Text),
    ("time", Primitive::Time),
    ("duration", Primitive::Duration),
    ("byte", Primitive::Int8),
    ("char", Primitive::Uint8),
];

impl Primitive {
    /// The type of this name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let found = PRIMITIVES.iter().find(|(known, _)| *known == name);
        found.map(|(_, primitive)| *primitive)
    }

    /// Its name; `int8` for `byte` and `uint8` for `char`.
    #[must_use]
    pub fn name(self) -> &'static str {
        let found = PRIMITIVES.iter().find(|(_, known)| *known == self);
        found.map_or("", |(name, _)| name)
    }

    /// The smallest and the largest number, if it is an integer.
    #[must_use]
    pub const fn range(self) -> Option<(i128, i128)> {
        Some(match self {
            Self::Int8 => (i8::MIN as i128, i8::MAX as i128),
            Self::Uint8 => (0, u8::MAX as i128),
            Self::Int16 => (i16::MIN as i128, i16::MAX as i128),
            Self::Uint16 => (0, u16::MAX as i128),
            Self::Int32 => (i32::MIN as i128, i32::MAX as i128),
            Self::Uint32 => (0, u32::MAX as i128),
            Self::Int64 => (i64::MIN as i128, i64::MAX as i128),
            Self::Uint64 => (0, u64::MAX as i128),
            _ => return None,
        })
    }

    /// The fewest bytes of a value.
    pub(super) const fn least_size(self) -> usize {
        match self {
            Self::Bool | Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 | Self::Text => 4,
            Self::Int64 | Self::Uint64 | Self::Float64 | Self::Time | Self::Duration => 8,
        }
    }
}

/// A constant of a definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Constant {
    /// Its name.
    pub name: String,
    /// Its type as it was written.
    pub type_name: String,
    /// Its value as it was written.
    pub text: String,
}

/// How many values a field has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DeclaredCount {
    One,
    Fixed(usize),
    Any,
}

/// A field whose type is not resolved.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct DeclaredField {
    pub(super) name: String,
    /// As it was written, as `float64[3]`.
    pub(super) written: String,
    /// Without the brackets: a primitive's name, or `package/Name`.
    pub(super) base: String,
    pub(super) count: DeclaredCount,
}

/// A parsed definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Definition {
    pub(super) fields: Vec<DeclaredField>,
    pub(super) constants: Vec<Constant>,
}

/// What is wrong in a definition, and in which line, from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ParseError {
    pub(super) line: usize,
    pub(super) message: String,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.message)
    }
}

impl Definition {
    /// Parses the text of a definition in this package.
    pub(super) fn parse(package: &str, text: &str) -> Result<Self, ParseError> {
        let mut definition = Self {
            fields: Vec::new(),
            constants: Vec::new(),
        };
        for (number, line) in (1..).zip(text.split('\n')) {
            let wrong = |message| ParseError {
                line: number,
                message,
            };
            let declared = without_comment(line);
            if declared.is_empty() {
                continue;
            }
            if declared.contains('=') {
                definition.constants.push(constant(line).map_err(wrong)?);
                continue;
            }
            let field = field(package, declared).map_err(wrong)?;
            if definition.fields.iter().any(|it| it.name == field.name) {
                return Err(wrong(format!("the field '{}' is there twice", field.name)));
            }
            definition.fields.push(field);
        }
        Ok(definition)
    }
}

fn without_comment(line: &str) -> &str {
    line.split('#').next().unwrap_or_default().trim()
}

fn constant(line: &str) -> Result<Constant, String> {
    let line = line.trim();
    let wrong = || format!("expected TYPE NAME=VALUE, found '{line}'");
    let (type_name, rest) = line.split_once(char::is_whitespace).ok_or_else(wrong)?;
    let primitive = Primitive::named(type_name);
    if primitive.is_none_or(|it| matches!(it, Primitive::Time | Primitive::Duration)) {
        return Err(format!("a constant cannot have the type '{type_name}'"));
    }
    // The text of a string goes to the end of the line: '#' is a part of it.
    let rest = match primitive {
        Some(Primitive::Text) => rest,
        _ => without_comment(rest),
    };
    let (name, text) = rest.split_once('=').ok_or_else(wrong)?;
    let name = name.trim();
    if !is_name(name) {
        return Err(format!("invalid name '{name}' of a constant"));
    }
    Ok(Constant {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        text: text.trim().to_owned(),
    })
}

fn field(package: &str, declared: &str) -> Result<DeclaredField, String> {
    let mut words = declared.split_whitespace();
    let (Some(written), Some(name), None) = (words.next(), words.next(), words.next()) else {
        return Err(format!("expected TYPE NAME, found '{declared}'"));
    };
    if !is_name(name) {
        return Err(format!("invalid name '{name}' of a field"));
    }
    let wrong = || format!("invalid type '{written}'");
    let (base, count) = match written.split_once('[') {
        None => (written, DeclaredCount::One),
        Some((base, rest)) => {
            let length = rest.strip_suffix(']').ok_or_else(wrong)?;
            let is_number = length.bytes().all(|byte| byte.is_ascii_digit());
            let count = match length {
                "" => DeclaredCount::Any,
                length if is_number => DeclaredCount::Fixed(length.parse().map_err(|_| wrong())?),
                _ => return Err(wrong()),
            };
            (base, count)
        }
    };
    let base = match base.split_once('/') {
        Some((package, name)) if is_name(package) && is_name(name) => base.to_owned(),
        None if Primitive::named(base).is_some() => base.to_owned(),
        None if base == "Header" => "std_msgs/Header".to_owned(),
        None if is_name(base) => format!("{package}/{base}"),
        _ => return Err(wrong()),
    };
    Ok(DeclaredField {
        name: name.to_owned(),
        written: written.to_owned(),
        base,
        count,
    })
}

/// Whether it can be the name of a package, a type, a field or a constant.
pub(super) fn is_name(text: &str) -> bool {
    let mut bytes = text.bytes();
    bytes.next().is_some_and(|byte| byte.is_ascii_alphabetic())
        && bytes.all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}
