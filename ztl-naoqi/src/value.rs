//! Values, as calls take and return them.

use std::fmt;
use std::sync::Arc;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, SerializeMap as _, Serializer};

use crate::meta_object::Object;
use crate::signature::Names;

/// A value of any type. As a goal or result it is written as Python writes it.
///
/// ```
/// use ztl_core::goal;
/// use ztl_naoqi::Value;
///
/// let value: Value = goal::from_str("[1, 0.5, hello]")?;
/// assert_eq!(value.to_string(), "[1, 0.5, 'hello']");
/// # Ok::<(), goal::GoalError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// No value.
    Nothing,
    /// True or False.
    Bool(bool),
    /// An integer of any width.
    Integer(i64),
    /// An integer above `i64::MAX`.
    Unsigned(u64),
    /// A number of 32 bits.
    Float(f32),
    /// A number of 64 bits.
    Double(f64),
    /// A text. Bytes that are not UTF-8 were replaced by U+FFFD.
    Text(String),
    /// Bytes.
    Raw(Vec<u8>),
    /// Values in order.
    List(Vec<Value>),
    /// Values by key.
    Map(Vec<(Value, Value)>),
    /// Fields of different types, with their names if they have some.
    Tuple(Names, Box<[Value]>),
    /// An object that a method has returned.
    Object(Arc<Object>),
}

impl Value {
    /// What it is, in words.
    pub(crate) const fn what(&self) -> &'static str {
        match self {
            Self::Nothing => "nothing",
            Self::Bool(_) => "True or False",
            Self::Integer(_) | Self::Unsigned(_) => "an integer",
            Self::Float(_) | Self::Double(_) => "a number",
            Self::Text(_) => "a text",
            Self::Raw(_) => "bytes",
            Self::List(_) | Self::Tuple(..) => "a list",
            Self::Map(_) => "a mapping",
            Self::Object(_) => "an object",
        }
    }

    /// The field of a tuple with this name, or else at this place.
    pub(crate) fn field(&self, name: &str, place: usize) -> Option<&Self> {
        let Self::Tuple(names, fields) = self else {
            return None;
        };
        let named = names.iter().position(|other| &**other == name);
        fields.get(named.unwrap_or(place))
    }

    /// The text.
    pub(crate) fn as_text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The integer, if it is one of 32 bits without a sign.
    pub(crate) fn as_u32(&self) -> Option<u32> {
        match self {
            Self::Integer(number) => u32::try_from(*number).ok(),
            _ => None,
        }
    }

    /// The elements of a list.
    pub(crate) fn as_list(&self) -> Option<&[Self]> {
        match self {
            Self::List(items) => Some(items),
            _ => None,
        }
    }

    /// Calls `each` with every object in it.
    pub(crate) fn for_each_object(&self, each: &mut impl FnMut(&Object)) {
        match self {
            Self::Object(object) => each(object),
            Self::List(items) => items.iter().for_each(|item| item.for_each_object(each)),
            Self::Tuple(_, items) => items.iter().for_each(|item| item.for_each_object(each)),
            Self::Map(entries) => entries.iter().for_each(|(key, value)| {
                key.for_each_object(each);
                value.for_each_object(each);
            }),
            _ => {}
        }
    }
}

/// As Python writes it. Nested too deep for a goal, it is `...`.
impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut text = Vec::new();
        let mut sink = |part: &[u8]| text.extend_from_slice(part);
        if ztl_core::goal::to_sink(self, &mut sink).is_err() {
            return f.write_str("...");
        }
        f.write_str(&String::from_utf8_lossy(&text))
    }
}

impl Serialize for Value {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Nothing => serializer.serialize_unit(),
            Self::Bool(value) => serializer.serialize_bool(*value),
            Self::Integer(value) => serializer.serialize_i64(*value),
            Self::Unsigned(value) => serializer.serialize_u64(*value),
            Self::Float(value) => serializer.serialize_f32(*value),
            Self::Double(value) => serializer.serialize_f64(*value),
            Self::Text(text) => serializer.serialize_str(text),
            Self::Raw(bytes) => serializer.serialize_bytes(bytes),
            Self::List(items) => serializer.collect_seq(items),
            Self::Map(entries) => {
                serializer.collect_map(entries.iter().map(|(key, value)| (key, value)))
            }
            Self::Tuple(names, fields) if names.is_empty() => serializer.collect_seq(fields),
            Self::Tuple(names, fields) => {
                let mut map = serializer.serialize_map(Some(fields.len()))?;
                for (name, field) in names.iter().zip(fields) {
                    map.serialize_entry(name, field)?;
                }
                map.end()
            }
            Self::Object(_) => serializer.serialize_str("<object>"),
        }
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyValue)
    }
}

struct AnyValue;

impl<'de> Visitor<'de> for AnyValue {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_none<E>(self) -> Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(unsigned(value))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Double(value))
    }

    fn visit_str<E>(self, text: &str) -> Result<Value, E> {
        Ok(Value::Text(text.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Value::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut map = Vec::new();
        while let Some(entry) = entries.next_entry()? {
            map.push(entry);
        }
        Ok(Value::Map(map))
    }
}

/// An integer without a sign.
pub(crate) fn unsigned(value: u64) -> Value {
    i64::try_from(value).map_or(Value::Unsigned(value), Value::Integer)
}
