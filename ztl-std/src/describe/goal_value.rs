//! Values of goals, and of programs' results in JSON.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::ser::{Serialize, Serializer};
use ztl_core::goal::{self, GoalError, WriteError};

/// A value that Python, YAML and JSON have in common. Mappings keep their order.
#[derive(Debug, Clone, PartialEq)]
pub enum GoalValue {
    /// Nothing.
    Null,
    /// True or False.
    Bool(bool),
    /// Fits into `i64` or `u64`.
    Integer(i128),
    /// A number with a fraction.
    Float(f64),
    /// A text.
    Text(String),
    /// Values in order.
    List(Vec<GoalValue>),
    /// Values by key.
    Map(Vec<(GoalValue, GoalValue)>),
}

impl GoalValue {
    /// Parses a goal.
    ///
    /// # Errors
    /// Where the goal is malformed.
    pub fn parse(text: &str) -> Result<Self, GoalError> {
        // `\L` and `\P` take one byte more than they are written with.
        let mut scratch = vec![0; text.len() * 2];
        goal::from_str_with(text, &mut scratch)
    }

    /// The value of a key, or the item of a list with this index.
    #[must_use]
    pub fn part(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Map(pairs) => {
                let mut found = pairs.iter().filter(|(name, _)| name.is_key(key));
                found.next().map(|(_, value)| value)
            }
            Self::List(items) => items.get(key.parse::<usize>().ok()?),
            _ => None,
        }
    }

    fn is_key(&self, key: &str) -> bool {
        match self {
            Self::Text(text) => text == key,
            Self::Integer(number) => number.to_string() == key,
            _ => false,
        }
    }

    /// The text that the original writes: that of Python's `str`.
    ///
    /// # Errors
    /// If it has too many levels.
    pub fn to_text(&self) -> Result<String, WriteError> {
        let mut bytes = Vec::new();
        goal::to_sink(self, &mut |part: &[u8]| bytes.extend_from_slice(part))?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }
}

impl<'de> Deserialize<'de> for GoalValue {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from.deserialize_any(Any)
    }
}

struct Any;

impl<'de> Visitor<'de> for Any {
    type Value = GoalValue;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_unit<E>(self) -> Result<GoalValue, E> {
        Ok(GoalValue::Null)
    }

    fn visit_none<E>(self) -> Result<GoalValue, E> {
        Ok(GoalValue::Null)
    }

    fn visit_bool<E>(self, value: bool) -> Result<GoalValue, E> {
        Ok(GoalValue::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<GoalValue, E> {
        Ok(GoalValue::Integer(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<GoalValue, E> {
        Ok(GoalValue::Integer(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<GoalValue, E> {
        Ok(GoalValue::Float(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<GoalValue, E> {
        Ok(GoalValue::Text(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<GoalValue, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(GoalValue::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<GoalValue, A::Error> {
        let mut pairs = Vec::new();
        while let Some(pair) = entries.next_entry()? {
            pairs.push(pair);
        }
        Ok(GoalValue::Map(pairs))
    }
}

impl Serialize for GoalValue {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Null => to.serialize_unit(),
            Self::Bool(value) => to.serialize_bool(*value),
            Self::Integer(value) => match (i64::try_from(*value), u64::try_from(*value)) {
                (Ok(value), _) => to.serialize_i64(value),
                (_, Ok(value)) => to.serialize_u64(value),
                _ => to.serialize_i128(*value),
            },
            Self::Float(value) => to.serialize_f64(*value),
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
    fn json_is_converted_like_the_original_in_key_order() {
        let json =
            r#"{"z": [1, -2.5, true], "a": {"it's": null}, "big": 18446744073709551615, "e": 1e3}"#;
        let value: GoalValue = serde_json::from_str(json).expect("JSON");
        let text = r#"{'z': [1, -2.5, True], 'a': {"it's": None}, 'big': 18446744073709551615, 'e': 1000.0}"#;
        assert_eq!(value.to_text().as_deref(), Ok(text));
        let bare: GoalValue = serde_json::from_str("\"hi, there\"").expect("JSON");
        assert_eq!(bare.to_text().as_deref(), Ok("hi, there"));
        let deep: GoalValue = serde_json::from_str("[[[[[[[[[1]]]]]]]]]").expect("JSON");
        assert!(deep.to_text().is_err());
    }

    #[test]
    fn parts_are_found_by_key_and_by_number() {
        let goal = GoalValue::parse("{pose: [1, {'x': -0.5}], 7: seven}").expect("a goal");
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
