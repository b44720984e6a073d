//! A value of any type, as serde finds it.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, Serializer};
use serde_json::{Value as Json, json};

/// The values that Python and YAML share. A tuple is a list.
#[derive(Debug, Clone)]
pub enum Value {
    None,
    Bool(bool),
    Integer(i128),
    /// Of more than 64 bits; never read.
    Huge(String),
    Float(f64),
    Text(String),
    List(Vec<Value>),
    /// In order.
    Dict(Vec<(Value, Value)>),
    /// Values that only Python has; never read.
    Other(String),
}

impl Value {
    /// The value from `generate.py`'s output.
    pub fn from_told(told: &Json) -> Self {
        let list = |items: &Json| {
            let items = items.as_array().expect("a list").iter();
            items.map(Self::from_told).collect::<Vec<_>>()
        };
        match told {
            Json::Null => Self::None,
            Json::Bool(value) => Self::Bool(*value),
            Json::String(text) => Self::Text(text.clone()),
            Json::Array(_) => Self::List(list(told)),
            Json::Object(typed) => {
                let (name, content) = typed.iter().next().expect("a type");
                let text = || content.as_str().expect("a text").to_owned();
                match name.as_str() {
                    "int" => match text().parse() {
                        Ok(value) if in_range(value) => Self::Integer(value),
                        _ => Self::Huge(text()),
                    },
                    "float" => Self::Float(text().parse().expect("a float")),
                    "tuple" => Self::List(list(content)),
                    "dict" => {
                        let mut pairs = Vec::new();
                        for pair in list(content) {
                            let Self::List(pair) = pair else {
                                panic!("no pair: {pair:?}");
                            };
                            let [key, value] = pair.try_into().expect("a pair");
                            pairs.push((key, value));
                        }
                        Self::Dict(pairs)
                    }
                    _ => Self::Other(told.to_string()),
                }
            }
            Json::Number(_) => panic!("a number without a type: {told}"),
        }
    }

    /// As `generate.py` prints it.
    pub fn to_told(&self) -> Json {
        match self {
            Self::None => Json::Null,
            Self::Bool(value) => json!(value),
            Self::Integer(value) => json!({"int": value.to_string()}),
            Self::Huge(text) => json!({"int": text}),
            Self::Float(value) => {
                let mut text = [0xA5; 32];
                let text = ztl_core::goal::to_slice(value, &mut text).expect("room");
                json!({"float": text})
            }
            Self::Text(text) => json!(text),
            Self::List(items) => items.iter().map(Self::to_told).collect(),
            Self::Dict(pairs) => {
                let pair = |(key, value): &(Self, Self)| json!([key.to_told(), value.to_told()]);
                json!({"dict": pairs.iter().map(pair).collect::<Vec<_>>()})
            }
            Self::Other(told) => serde_json::from_str(told).expect("JSON"),
        }
    }

    /// Whether it is so of the value, or of any in it.
    pub fn any(&self, so: &dyn Fn(&Self) -> bool) -> bool {
        so(self)
            || match self {
                Self::List(items) => items.iter().any(|item| item.any(so)),
                Self::Dict(pairs) => pairs.iter().any(|(key, value)| {
                    so(&Self::Dict(vec![(key.clone(), Self::None)])) || key.any(so) || value.any(so)
                }),
                _ => false,
            }
    }

    pub fn is_huge(&self) -> bool {
        matches!(self, Self::Huge(_))
    }
}

fn in_range(value: i128) -> bool {
    (i128::from(i64::MIN)..=i128::from(u64::MAX)).contains(&value)
}

impl PartialEq for Value {
    /// Floats bit by bit, but for "not a number".
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::None, Self::None) => true,
            (Self::Bool(a), Self::Bool(b)) => a == b,
            (Self::Integer(a), Self::Integer(b)) => a == b,
            (Self::Float(a), Self::Float(b)) => {
                a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan()
            }
            (Self::Text(a), Self::Text(b)) => a == b,
            (Self::List(a), Self::List(b)) => a == b,
            (Self::Dict(a), Self::Dict(b)) => a == b,
            _ => false,
        }
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Any)
    }
}

struct Any;

impl<'de> Visitor<'de> for Any {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::None)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(Value::Integer(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Float(value))
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

    fn visit_map<A: MapAccess<'de>>(self, mut pairs: A) -> Result<Value, A::Error> {
        let mut dict = Vec::new();
        while let Some(pair) = pairs.next_entry()? {
            dict.push(pair);
        }
        Ok(Value::Dict(dict))
    }
}

impl Serialize for Value {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::None => serializer.serialize_unit(),
            Self::Bool(value) => value.serialize(serializer),
            Self::Integer(value) => match u64::try_from(*value) {
                Ok(value) => value.serialize(serializer),
                Err(_) => (*value as i64).serialize(serializer),
            },
            Self::Float(value) => value.serialize(serializer),
            Self::Text(text) => text.serialize(serializer),
            Self::List(items) => items.serialize(serializer),
            Self::Dict(pairs) => {
                serializer.collect_map(pairs.iter().map(|(key, value)| (key, value)))
            }
            Self::Huge(_) | Self::Other(_) => Err(serde::ser::Error::custom("never written")),
        }
    }
}
