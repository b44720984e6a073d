//! Bytes from values.

use std::{error, fmt};

use super::definition::Primitive;
use super::message_type::{Count, Element, FieldType, MessageType};
use super::value::{Value, path_within};

/// Why a value is not one of a type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodeError {
    /// The path of its field, as `points.0.positions`; empty for the whole message.
    pub field: String,
    /// What it should be.
    pub expected: String,
}

impl fmt::Display for EncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.field.as_str() {
            "" => write!(f, "expected {}", self.expected),
            field => write!(f, "{field}: expected {}", self.expected),
        }
    }
}

impl error::Error for EncodeError {}

impl EncodeError {
    fn new(expected: impl fmt::Display) -> Self {
        Self {
            field: String::new(),
            expected: expected.to_string(),
        }
    }

    fn within(mut self, part: &str) -> Self {
        self.field = path_within(part, &self.field);
        self
    }
}

impl MessageType {
    /// The bytes of a message. All fields must be there, in order.
    ///
    /// # Errors
    /// Which value is not one of its type.
    pub fn encode(&self, value: &Value) -> Result<Vec<u8>, EncodeError> {
        let mut bytes = Vec::with_capacity(self.least_size());
        self.put(value, &mut bytes)?;
        Ok(bytes)
    }

    fn put(&self, value: &Value, bytes: &mut Vec<u8>) -> Result<(), EncodeError> {
        let wrong = || EncodeError::new(format!("a message of {}", self.name()));
        let Value::Message(given) = value else {
            return Err(wrong());
        };
        if given.len() != self.fields().len() {
            return Err(wrong());
        }
        for (field, (name, value)) in self.fields().iter().zip(given) {
            if *name != field.name {
                return Err(wrong());
            }
            let put = field.field_type.put(value, bytes);
            put.map_err(|error| error.within(name))?;
        }
        Ok(())
    }
}

impl FieldType {
    fn put(&self, value: &Value, bytes: &mut Vec<u8>) -> Result<(), EncodeError> {
        let wrong = || EncodeError::new(self);
        let length = match value {
            value if self.count == Count::One => return self.element.put(value, bytes),
            Value::Bytes(given) if self.is_bytes() => given.len(),
            Value::List(items) if !self.is_bytes() => items.len(),
            _ => return Err(wrong()),
        };
        match self.count {
            Count::Fixed(expected) if expected != length => return Err(wrong()),
            Count::Any => {
                let length = u32::try_from(length).map_err(|_| wrong())?;
                bytes.extend_from_slice(&length.to_le_bytes());
            }
            Count::Fixed(_) | Count::One => {}
        }
        if let Value::Bytes(given) = value {
            bytes.extend_from_slice(given);
        }
        for (index, item) in value.items().iter().enumerate() {
            let put = self.element.put(item, bytes);
            put.map_err(|error| error.within(&index.to_string()))?;
        }
        Ok(())
    }
}

impl Element {
    fn put(&self, value: &Value, bytes: &mut Vec<u8>) -> Result<(), EncodeError> {
        let primitive = match self {
            Self::Message(message) => return message.put(value, bytes),
            Self::Primitive(primitive) => *primitive,
        };
        primitive
            .put(value, bytes)
            .ok_or_else(|| EncodeError::new(primitive.name()))
    }
}

impl Primitive {
    /// `None` if it is no value of this type.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a float32 is the nearest one"
    )]
    fn put(self, value: &Value, bytes: &mut Vec<u8>) -> Option<()> {
        match (self, value) {
            (Self::Bool, Value::Bool(value)) => bytes.push(u8::from(*value)),
            (Self::Int8, Value::Signed(value)) => {
                put(i8::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Int16, Value::Signed(value)) => {
                put(i16::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Int32, Value::Signed(value)) => {
                put(i32::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Int64, Value::Signed(value)) => put(value.to_le_bytes(), bytes),
            (Self::Uint8, Value::Unsigned(value)) => {
                put(u8::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Uint16, Value::Unsigned(value)) => {
                put(u16::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Uint32, Value::Unsigned(value)) => {
                put(u32::try_from(*value).ok()?.to_le_bytes(), bytes)
            }
            (Self::Uint64, Value::Unsigned(value)) => put(value.to_le_bytes(), bytes),
            (Self::Float32, Value::Float(value)) => put((*value as f32).to_le_bytes(), bytes),
            (Self::Float64, Value::Float(value)) => put(value.to_le_bytes(), bytes),
            (Self::Text, Value::Text(text)) => {
                put(u32::try_from(text.len()).ok()?.to_le_bytes(), bytes);
                bytes.extend_from_slice(text.as_bytes());
            }
            (Self::Time, Value::Time { secs, nsecs }) => {
                put(secs.to_le_bytes(), bytes);
                put(nsecs.to_le_bytes(), bytes);
            }
            (Self::Duration, Value::Duration { secs, nsecs }) => {
                put(secs.to_le_bytes(), bytes);
                put(nsecs.to_le_bytes(), bytes);
            }
            _ => return None,
        }
        Some(())
    }
}

fn put<const N: usize>(from: [u8; N], bytes: &mut Vec<u8>) {
    bytes.extend_from_slice(&from);
}
