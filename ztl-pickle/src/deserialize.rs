//! Values of other formats, such as JSON.

use std::fmt;

use serde::de::{DeserializeSeed, Error as _, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::graph::{Chain, Graph, Node, Ref};
use crate::limits::Account;
use crate::{Error, Pickle};

/// From a format that says which types its values have: nothing, truths, numbers, text, lists and dicts. Of equal keys,
/// the last value stays.
///
/// ```
/// use ztl_pickle::Pickle;
///
/// let pickle: Pickle = serde_json::from_str(r#"{"x": [1, 2.5, null, "a"]}"#)?;
/// assert_eq!(pickle.value().repr().to_string(), "{'x': [1, 2.5, None, 'a']}");
/// # Ok::<(), serde_json::Error>(())
/// ```
impl<'de> Deserialize<'de> for Pickle {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut graph = Self::none().graph;
        let root = IntoGraph(&mut graph).deserialize(deserializer)?;
        Self { graph, root }.checked().map_err(D::Error::custom)
    }
}

/// The graph that gets the value. All values share it, so that each takes a few bytes.
struct IntoGraph<'g>(&'g mut Graph);

impl IntoGraph<'_> {
    fn put<E: serde::de::Error>(
        self,
        put: impl FnOnce(&mut Graph, &mut Account) -> Result<Ref, Error>,
    ) -> Result<Ref, E> {
        put(self.0, &mut Account::unlimited()).map_err(E::custom)
    }
}

impl<'de> DeserializeSeed<'de> for IntoGraph<'_> {
    type Value = Ref;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Ref, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for IntoGraph<'_> {
    type Value = Ref;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Ref, E> {
        Ok(Ref::NONE)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Ref, E> {
        Ok(Ref::bool(value))
    }

    fn visit_i64<E: serde::de::Error>(self, value: i64) -> Result<Ref, E> {
        self.put(|graph, account| graph.int(value, account))
    }

    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<Ref, E> {
        self.put(|graph, account| graph.long(&i128::from(value).to_le_bytes(), account))
    }

    fn visit_f64<E: serde::de::Error>(self, value: f64) -> Result<Ref, E> {
        self.put(|graph, account| graph.add(Node::Float(value), account))
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Ref, E> {
        self.put(|graph, account| {
            let span = graph.keep(text.as_bytes(), account)?;
            graph.add(Node::Str(span), account)
        })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Ref, A::Error> {
        let mut chain = Chain::EMPTY;
        while let Some(item) = items.next_element_seed(IntoGraph(self.0))? {
            link(self.0, &mut chain, item)?;
        }
        self.put(|graph, account| graph.add(Node::List(chain), account))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Ref, A::Error> {
        let mut chain = Chain::EMPTY;
        while let Some(key) = entries.next_key_seed(IntoGraph(self.0))? {
            link(self.0, &mut chain, key)?;
            let value = entries.next_value_seed(IntoGraph(self.0))?;
            link(self.0, &mut chain, value)?;
        }
        self.put(|graph, account| graph.add(Node::Dict(chain), account))
    }
}

fn link<E: serde::de::Error>(graph: &mut Graph, chain: &mut Chain, item: Ref) -> Result<(), E> {
    let linked = graph.link(chain, item, &mut Account::unlimited());
    linked.map_err(E::custom)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_becomes_the_values_that_python_reads_from_it() {
        for (json, shown) in [
            ("null", "None"),
            ("true", "True"),
            ("-7", "-7"),
            ("9223372036854775808", "9223372036854775808"),
            ("-9223372036854775808", "-9223372036854775808"),
            ("1e3", "1000.0"),
            (r#""it's \u00e4""#, r#""it's ä""#),
            ("[]", "[]"),
            ("{}", "{}"),
            ("[[1, [2]], [], {}, [3]]", "[[1, [2]], [], {}, [3]]"),
            (
                r#"{"a": {"b": [1], "b": [2]}, "c": 3, "a": [{"d": null}]}"#,
                "{'a': [{'d': None}], 'c': 3}",
            ),
            (r#"[{"a": 1, "a": 2}]"#, "[{'a': 2}]"),
        ] {
            let pickle: Pickle = serde_json::from_str(json).expect(json);
            assert_eq!(pickle.value().repr().to_string(), shown, "{json}");
            let read = Pickle::read(&pickle.to_bytes()).expect(json);
            assert_eq!(read, pickle, "{json}");
        }
        assert!(serde_json::from_str::<Pickle>("[1, 2").is_err());
    }
}
