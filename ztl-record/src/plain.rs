//! Values that JSON tells completely, and their way back.

use std::fmt;

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use ztl_pickle::{Kind, Pickle, Value};

/// Deepest nesting; `serde_json` reads 127 levels.
const DEPTH: usize = 100;

/// Whether the JSON of a value tells all of it, so that reading it gives an equal value. The caller has checked that
/// the JSON is short: this visits shared parts each time, as the JSON has them.
pub(crate) fn is_plain(value: Value<'_>) -> bool {
    is_plain_to(value, DEPTH)
}

fn is_plain_to(value: Value<'_>, depth: usize) -> bool {
    let Some(depth) = depth.checked_sub(1) else {
        return false;
    };
    match value.kind() {
        Kind::None | Kind::Bool(_) | Kind::Int(_) | Kind::Str(_) => true,
        Kind::Float(value) => value.is_finite(),
        Kind::List(items) => items.into_iter().all(|item| is_plain_to(item, depth)),
        Kind::Dict(entries) => entries
            .into_iter()
            .all(|(key, value)| key.as_str().is_some() && is_plain_to(value, depth)),
        _ => false,
    }
}

/// A value, read from JSON.
pub(crate) struct Plain(pub(crate) Pickle);

impl<'de> Deserialize<'de> for Plain {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(PlainVisitor)
    }
}

struct PlainVisitor;

impl<'de> Visitor<'de> for PlainVisitor {
    type Value = Plain;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Plain, E> {
        Ok(Plain(Pickle::none()))
    }

    fn visit_bool<E>(self, value: bool) -> Result<Plain, E> {
        Ok(Plain(value.into()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Plain, E> {
        Ok(Plain(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Plain, E> {
        Ok(Plain(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Plain, E> {
        Ok(Plain(value.into()))
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Plain, E> {
        Pickle::text(text).map(Plain).map_err(E::custom)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Plain, A::Error> {
        let mut list = Vec::new();
        while let Some(Plain(item)) = items.next_element()? {
            list.push(item);
        }
        Pickle::list(list).map(Plain).map_err(A::Error::custom)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Plain, A::Error> {
        let mut dict = Vec::new();
        while let Some((Plain(key), Plain(value))) = entries.next_entry()? {
            dict.push((key, value));
        }
        Pickle::dict(dict).map(Plain).map_err(A::Error::custom)
    }
}
