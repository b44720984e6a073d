//! Values of messages.

use std::sync::Arc;

use serde::ser::{Serialize, SerializeStruct, Serializer};

use super::definition::Primitive;
use super::message_type::{Count, Element, FieldType, MessageType};

/// A value of any type.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `bool`
    Bool(bool),
    /// `int8` to `int64`
    Signed(i64),
    /// `uint8` to `uint64`
    Unsigned(u64),
    /// `float32`, `float64`
    Float(f64),
    /// `string`. Bytes that are not UTF-8 are `U+FFFD`.
    Text(String),
    /// An array of `uint8` or `char`.
    Bytes(Vec<u8>),
    /// `time`
    Time {
        /// Seconds since 1970.
        secs: u32,
        /// Nanoseconds.
        nsecs: u32,
    },
    /// `duration`
    Duration {
        /// Seconds.
        secs: i32,
        /// Nanoseconds.
        nsecs: i32,
    },
    /// Any other array.
    List(Vec<Value>),
    /// A message: its fields in order.
    Message(Vec<(Arc<str>, Value)>),
}

impl Value {
    /// The field of a message.
    #[must_use]
    pub fn field(&self, name: &str) -> Option<&Self> {
        let Self::Message(fields) = self else {
            return None;
        };
        let found = fields.iter().find(|(known, _)| **known == *name);
        found.map(|(_, value)| value)
    }

    /// The same, to change it.
    pub fn field_mut(&mut self, name: &str) -> Option<&mut Self> {
        let Self::Message(fields) = self else {
            return None;
        };
        let found = fields.iter_mut().find(|(known, _)| **known == *name);
        found.map(|(_, value)| value)
    }

    /// The value at a path of fields and indices, as `points.0.positions`.
    #[must_use]
    pub fn at(&self, path: &str) -> Option<&Self> {
        path.split('.').try_fold(self, |value, part| match value {
            Self::List(items) => items.get(part.parse::<usize>().ok()?),
            value => value.field(part),
        })
    }

    /// The text, if it is one.
    #[must_use]
    pub fn as_text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The number as a float, if it is one.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "the nearest float is asked for")]
    pub fn as_float(&self) -> Option<f64> {
        match self {
            Self::Signed(number) => Some(*number as f64),
            Self::Unsigned(number) => Some(*number as f64),
            Self::Float(number) => Some(*number),
            _ => None,
        }
    }

    /// The items of an array without bytes.
    #[must_use]
    pub fn items(&self) -> &[Self] {
        match self {
            Self::List(items) => items,
            _ => &[],
        }
    }
}

/// The path of `part`, or of a value within it.
pub(super) fn path_within(part: &str, inner: &str) -> String {
    match inner {
        "" => part.to_owned(),
        inner => format!("{part}.{inner}"),
    }
}

impl MessageType {
    /// A message in which each number is zero, and each text and each array of variable length is empty.
    #[must_use]
    pub fn zero(&self) -> Value {
        let fields = self.fields().iter();
        let fields = fields.map(|field| (Arc::clone(&field.name), field.field_type.zero()));
        Value::Message(fields.collect())
    }
}

impl FieldType {
    /// The value of a field that is not given.
    #[must_use]
    pub fn zero(&self) -> Value {
        match self.count {
            Count::One => self.element.zero(),
            Count::Fixed(length) if self.is_bytes() => Value::Bytes(vec![0; length]),
            Count::Fixed(length) => Value::List(vec![self.element.zero(); length]),
            Count::Any if self.is_bytes() => Value::Bytes(Vec::new()),
            Count::Any => Value::List(Vec::new()),
        }
    }
}

impl Element {
    fn zero(&self) -> Value {
        match self {
            Self::Message(message) => message.zero(),
            Self::Primitive(primitive) => match primitive {
                Primitive::Bool => Value::Bool(false),
                Primitive::Int8 | Primitive::Int16 | Primitive::Int32 | Primitive::Int64 => {
                    Value::Signed(0)
                }
                Primitive::Uint8 | Primitive::Uint16 | Primitive::Uint32 | Primitive::Uint64 => {
                    Value::Unsigned(0)
                }
                Primitive::Float32 | Primitive::Float64 => Value::Float(0.0),
                Primitive::Text => Value::Text(String::new()),
                Primitive::Time => Value::Time { secs: 0, nsecs: 0 },
                Primitive::Duration => Value::Duration { secs: 0, nsecs: 0 },
            },
        }
    }
}

impl Serialize for Value {
    /// Times are mappings of `secs` and `nsecs`, as `rostopic echo` shows them; bytes are numbers.
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Bool(value) => to.serialize_bool(*value),
            Self::Signed(value) => to.serialize_i64(*value),
            Self::Unsigned(value) => to.serialize_u64(*value),
            Self::Float(value) => to.serialize_f64(*value),
            Self::Text(value) => to.serialize_str(value),
            Self::Bytes(bytes) => to.serialize_bytes(bytes),
            Self::Time { secs, nsecs } => {
                let mut time = to.serialize_struct("Time", 2)?;
                time.serialize_field("secs", secs)?;
                time.serialize_field("nsecs", nsecs)?;
                time.end()
            }
            Self::Duration { secs, nsecs } => {
                let mut time = to.serialize_struct("Duration", 2)?;
                time.serialize_field("secs", secs)?;
                time.serialize_field("nsecs", nsecs)?;
                time.end()
            }
            Self::List(items) => to.collect_seq(items),
            Self::Message(fields) => {
                to.collect_map(fields.iter().map(|(name, value)| (&**name, value)))
            }
        }
    }
}
