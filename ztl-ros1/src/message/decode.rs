//! Values from bytes. The bytes may be anything: what they make takes bounded memory.

use std::sync::Arc;
use std::{error, fmt};

use super::definition::Primitive;
use super::message_type::{Count, Element, FieldType, MOST_VALUES, MessageType};
use super::value::{Value, path_within};

/// For how many items of a list there is room at first.
const FIRST_ITEMS: usize = 1024;

/// Why bytes are not a message, and in which field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DecodeError {
    /// Its path, as `points.0.positions`; empty for the whole message.
    pub field: String,
    /// What is wrong.
    pub kind: DecodeErrorKind,
}

/// What is wrong with the bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum DecodeErrorKind {
    /// The bytes end within the message.
    Truncated {
        /// How many bytes the rest of the value has at least.
        needed: usize,
        /// How many are left.
        left: usize,
    },
    /// There are bytes after the message.
    TrailingBytes {
        /// How many.
        count: usize,
    },
    /// The message has more values than this program takes.
    TooManyValues,
}

impl fmt::Display for DecodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.field.is_empty() {
            write!(f, "{}: ", self.field)?;
        }
        match self.kind {
            DecodeErrorKind::Truncated { needed, left } => {
                write!(f, "{needed} bytes are needed, and {left} are left")
            }
            DecodeErrorKind::TrailingBytes { count } => {
                write!(f, "{count} bytes are left after the message")
            }
            DecodeErrorKind::TooManyValues => {
                write!(f, "the message has more than {MOST_VALUES} values")
            }
        }
    }
}

impl error::Error for DecodeError {}

impl DecodeError {
    /// The same error, seen from the value that has this field.
    fn within(mut self, part: &str) -> Self {
        self.field = path_within(part, &self.field);
        self
    }
}

impl MessageType {
    /// Reads a message of this type. The value takes at most about 50 MiB, for any bytes.
    ///
    /// # Errors
    /// Why the bytes are not a message of this type.
    pub fn decode(&self, bytes: &[u8]) -> Result<Value, DecodeError> {
        let mut reader = Reader {
            rest: bytes,
            values_left: MOST_VALUES,
        };
        let value = reader.message(self)?;
        match reader.rest.len() {
            0 => Ok(value),
            count => Err(DecodeErrorKind::TrailingBytes { count }.into()),
        }
    }
}

impl From<DecodeErrorKind> for DecodeError {
    fn from(kind: DecodeErrorKind) -> Self {
        Self {
            field: String::new(),
            kind,
        }
    }
}

struct Reader<'b> {
    rest: &'b [u8],
    values_left: usize,
}

impl Reader<'_> {
    fn message(&mut self, message: &MessageType) -> Result<Value, DecodeError> {
        let mut fields = Vec::with_capacity(message.fields().len());
        for field in message.fields() {
            let value = self.field(&field.field_type);
            let value = value.map_err(|error| error.within(&field.name))?;
            fields.push((Arc::clone(&field.name), value));
        }
        Ok(Value::Message(fields))
    }

    fn field(&mut self, field: &FieldType) -> Result<Value, DecodeError> {
        let count = match field.count {
            Count::One => return self.element(&field.element),
            Count::Fixed(length) => length,
            Count::Any => u32::from_le_bytes(self.array()?) as usize,
        };
        if field.is_bytes() {
            self.count_values(1)?;
            return Ok(Value::Bytes(self.take(count)?.to_vec()));
        }
        // Nothing is allocated for a length that the bytes do not have.
        let needed = count.saturating_mul(field.element.least_size());
        self.expect(needed)?;
        self.count_values(1)?;
        if count > self.values_left {
            return Err(DecodeErrorKind::TooManyValues.into());
        }
        // Not all at once: within one another, lists without bytes would take too much.
        let mut items = Vec::with_capacity(count.min(FIRST_ITEMS));
        for index in 0..count {
            let item = self.element(&field.element);
            items.push(item.map_err(|error| error.within(&index.to_string()))?);
        }
        Ok(Value::List(items))
    }

    fn element(&mut self, element: &Element) -> Result<Value, DecodeError> {
        self.count_values(1)?;
        match element {
            Element::Message(message) => self.message(message),
            Element::Primitive(primitive) => Ok(self.primitive(*primitive)?),
        }
    }

    fn primitive(&mut self, primitive: Primitive) -> Result<Value, DecodeErrorKind> {
        Ok(match primitive {
            Primitive::Bool => Value::Bool(self.array::<1>()? != [0]),
            Primitive::Int8 => Value::Signed(i8::from_le_bytes(self.array()?).into()),
            Primitive::Uint8 => Value::Unsigned(u8::from_le_bytes(self.array()?).into()),
            Primitive::Int16 => Value::Signed(i16::from_le_bytes(self.array()?).into()),
            Primitive::Uint16 => Value::Unsigned(u16::from_le_bytes(self.array()?).into()),
            Primitive::Int32 => Value::Signed(i32::from_le_bytes(self.array()?).into()),
            Primitive::Uint32 => Value::Unsigned(u32::from_le_bytes(self.array()?).into()),
            Primitive::Int64 => Value::Signed(i64::from_le_bytes(self.array()?)),
            Primitive::Uint64 => Value::Unsigned(u64::from_le_bytes(self.array()?)),
            Primitive::Float32 => Value::Float(f32::from_le_bytes(self.array()?).into()),
            Primitive::Float64 => Value::Float(f64::from_le_bytes(self.array()?)),
            Primitive::Text => {
                let length = u32::from_le_bytes(self.array()?) as usize;
                Value::Text(String::from_utf8_lossy(self.take(length)?).into_owned())
            }
            Primitive::Time => Value::Time {
                secs: u32::from_le_bytes(self.array()?),
                nsecs: u32::from_le_bytes(self.array()?),
            },
            Primitive::Duration => Value::Duration {
                secs: i32::from_le_bytes(self.array()?),
                nsecs: i32::from_le_bytes(self.array()?),
            },
        })
    }

    fn count_values(&mut self, count: usize) -> Result<(), DecodeErrorKind> {
        let left = self.values_left.checked_sub(count);
        self.values_left = left.ok_or(DecodeErrorKind::TooManyValues)?;
        Ok(())
    }

    /// Whether so many bytes are left.
    const fn expect(&self, needed: usize) -> Result<(), DecodeErrorKind> {
        let left = self.rest.len();
        match needed > left {
            true => Err(DecodeErrorKind::Truncated { needed, left }),
            false => Ok(()),
        }
    }

    fn take(&mut self, count: usize) -> Result<&[u8], DecodeErrorKind> {
        let left = self.rest.len();
        let (taken, rest) =
            self.rest
                .split_at_checked(count)
                .ok_or(DecodeErrorKind::Truncated {
                    needed: count,
                    left,
                })?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeErrorKind> {
        let left = self.rest.len();
        let (taken, rest) = self
            .rest
            .split_first_chunk()
            .ok_or(DecodeErrorKind::Truncated { needed: N, left })?;
        self.rest = rest;
        Ok(*taken)
    }
}
