//! A value of any kind, as a goal has it and as a program's JSON has it.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, Serializer};
use ztl_core::goal::{self, GoalError, WriteError};

/// What Python, YAML and JSON know alike; mappings in their order.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    Nothing,
    Truth(bool),
    /// At most 64 bits with or without a sign.
    Whole(i128),
    Number(f64),
    Text(String),
    List(Vec<Value>),
    Map(Vec<(Value, Value)>),
}

impl Value {
    /// Reads a goal.
    pub(super) fn of_goal(text: &str) -> Result<Self, GoalError> {
        // `\L` and `\P` take one byte more than they are written with.
        let mut scratch = vec![0; text.len() * 2];
        goal::from_str_with(text, &mut scratch)
    }

    /// The value behind a key; of a list, the item with that number.
    pub(super) fn part(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Map(pairs) => {
                let mut found = pairs.iter().filter(|(name, _)| name.is_called(key));
                found.next().map(|(_, value)| value)
            }
            Self::List(items) => items.get(key.parse::<usize>().ok()?),
            _ => None,
        }
    }

    fn is_called(&self, key: &str) -> bool {
        match self {
            Self::Text(text) => text == key,
            Self::Whole(number) => number.to_string() == key,
            _ => false,
        }
    }

    /// As the original writes it: what Python's `str` makes of it.
    pub(super) fn to_text(&self) -> Result<String, WriteError> {
        let mut bytes = Vec::new();
        goal::to_sink(self, &mut |part: &[u8]| bytes.extend_from_slice(part))?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }
}

impl<'de> Deserialize<'de> for Value {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from.deserialize_any(Any)
    }
}

struct Any;

impl<'de> Visitor<'de> for Any {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_none<E>(self) -> Result<Value, E> {
        Ok(Value::Nothing)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(Value::Truth(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(Value::Whole(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(Value::Whole(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(Value::Number(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(Value::Text(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Value::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let mut pairs = Vec::new();
        while let Some(pair) = entries.next_entry()? {
            pairs.push(pair);
        }
        Ok(Value::Map(pairs))
    }
}

impl Serialize for Value {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Nothing => to.serialize_unit(),
            Self::Truth(value) => to.serialize_bool(*value),
            Self::Whole(value) => match (i64::try_from(*value), u64::try_from(*value)) {
                (Ok(value), _) => to.serialize_i64(value),
                (_, Ok(value)) => to.serialize_u64(value),
                _ => to.serialize_i128(*value),
            },
            Self::Number(value) => to.serialize_f64(*value),
            Self::Text(value) => to.serialize_str(value),
            Self::List(items) => to.collect_seq(items),
            Self::Map(pairs) => to.collect_map(pairs.iter().map(|(key, value)| (key, value))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_becomes_what_the_original_would_write_in_its_order() {
        let json =
            r#"{"z": [1, -2.5, true], "a": {"it's": null}, "big": 18446744073709551615, "e": 1e3}"#;
        let value: Value = serde_json::from_str(json).expect("JSON");
        let text = r#"{'z': [1, -2.5, True], 'a': {"it's": None}, 'big': 18446744073709551615, 'e': 1000.0}"#;
        assert_eq!(value.to_text().as_deref(), Ok(text));
        let bare: Value = serde_json::from_str("\"hi, there\"").expect("JSON");
        assert_eq!(bare.to_text().as_deref(), Ok("hi, there"));
        let deep: Value = serde_json::from_str("[[[[[[[[[1]]]]]]]]]").expect("JSON");
        assert!(deep.to_text().is_err());
    }

    #[test]
    fn parts_are_found_by_key_and_by_number() {
        let goal = Value::of_goal("{pose: [1, {'x': -0.5}], 7: seven}").expect("a goal");
        let found = |path: &[&str]| {
            let part = path.iter().try_fold(&goal, |value, key| value.part(key))?;
            part.to_text().ok()
        };
        assert_eq!(found(&["pose", "1", "x"]).as_deref(), Some("-0.5"));
        assert_eq!(found(&["7"]).as_deref(), Some("seven"));
        assert_eq!(found(&["pose", "2"]), None);
        assert_eq!(found(&["pose", "x"]), None);
        assert_eq!(found(&["nothing"]), None);
    }
}
