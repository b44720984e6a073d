//! What a server of this project says of itself: its answer to `probe`.

use std::collections::BTreeMap;

use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize, Serializer};

use super::error::RequestError;
use super::remote_task::RemoteTask;
use crate::offers::Offers;
use crate::remote_id::RemoteId;

/// What a server of this project says of itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Description {
    /// Its version.
    pub version: String,
    /// Differs after each restart of the server.
    pub boot: u32,
    /// What each scope offers; an empty map if the server does not report it.
    pub scopes: BTreeMap<String, Offers>,
    /// The tasks that have not ended, by id, with their scopes; `None` if the server does not report them.
    #[serde(serialize_with = "as_map")]
    pub running: Option<Vec<(RemoteId, String)>>,
    /// How many more have not ended, but have an unreadable id or scope.
    #[serde(skip)]
    pub unread: usize,
}

/// Writes pairs as a JSON object.
fn as_map<S: Serializer>(
    pairs: &Option<Vec<(RemoteId, String)>>,
    to: S,
) -> Result<S::Ok, S::Error> {
    match pairs {
        Some(pairs) => to.collect_map(pairs.iter().map(|(id, scope)| (id.as_str(), scope))),
        None => to.serialize_none(),
    }
}

impl RemoteTask {
    /// Asks the server what it offers; `None` if it is not one of this project.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn describe(&mut self) -> Result<Option<Description>, RequestError> {
        let Some(answer) = self.ask_server("probe")? else {
            return Ok(None);
        };
        Description::read(answer).map(Some)
    }
}

impl Description {
    /// Reads the answer to `probe`, which is YAML in flow style. Skips unknown keys, and what is unreadable
    /// does not hide the rest.
    ///
    /// # Errors
    /// [`RequestError::Undescribed`].
    pub fn read(answer: String) -> Result<Self, RequestError> {
        Self::parse(&answer).ok_or(RequestError::Undescribed { answer })
    }

    pub(super) fn parse(answer: &str) -> Option<Self> {
        let root: Node = serde_yaml_ng::from_str(answer).ok()?;
        let offers = |handlers: &Node| -> Offers {
            let names = |node: &Node| match node {
                Node::List(items) => items.iter().filter_map(Node::text).collect(),
                _ => Vec::new(),
            };
            let handlers = handlers.pairs().unwrap_or_default().iter();
            handlers
                .map(|(name, components)| (name.clone(), names(components)))
                .collect()
        };
        let running = root.get("running").and_then(Node::pairs);
        let task = |(id, scope): &(String, Node)| {
            let id = id.parse().ok().filter(RemoteId::names_task)?;
            Some((id, scope.text()?))
        };
        let read: Option<Vec<_>> = running.map(|all| all.iter().filter_map(task).collect());
        let scopes = root.get("scopes").and_then(Node::pairs);
        Some(Self {
            version: root.get("version")?.text()?,
            boot: root.get("boot")?.text()?.parse().ok()?,
            scopes: scopes
                .unwrap_or_default()
                .iter()
                .map(|(name, handlers)| (name.clone(), offers(handlers)))
                .collect(),
            unread: running.map_or(0, <[_]>::len) - read.as_ref().map_or(0, Vec::len),
            running: read,
        })
    }
}

/// A value in the answer. Unlike a struct that is derived, it keeps repeated keys and entries of another type.
enum Node {
    Text(String),
    List(Vec<Self>),
    Map(Vec<(String, Self)>),
    Nothing,
}

impl Node {
    fn text(&self) -> Option<String> {
        match self {
            Self::Text(text) => Some(text.clone()),
            _ => None,
        }
    }

    fn pairs(&self) -> Option<&[(String, Self)]> {
        match self {
            Self::Map(pairs) => Some(pairs),
            _ => None,
        }
    }

    fn get(&self, key: &str) -> Option<&Self> {
        let mut pairs = self.pairs()?.iter();
        pairs.find(|(name, _)| name == key).map(|(_, value)| value)
    }
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from.deserialize_any(NodeVisitor)
    }
}

struct NodeVisitor;

impl<'de> Visitor<'de> for NodeVisitor {
    type Value = Node;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("any value")
    }

    fn visit_unit<E>(self) -> Result<Node, E> {
        Ok(Node::Nothing)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Node, E> {
        Ok(Node::Text(value.to_string()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Node, E> {
        Ok(Node::Text(value.to_string()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Node, E> {
        Ok(Node::Text(value.to_string()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Node, E> {
        Ok(Node::Text(value.to_string()))
    }

    fn visit_str<E>(self, text: &str) -> Result<Node, E> {
        Ok(Node::Text(text.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Node, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Node::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut pairs: A) -> Result<Node, A::Error> {
        let mut map = Vec::new();
        while let Some(pair) = pairs.next_entry()? {
            map.push(pair);
        }
        Ok(Node::Map(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unreadable_entry_hides_no_other() {
        let answer = "{ztl: 1, version: '0.1.0', boot: 7, more: {a: [1]}, \
            scopes: {\"/lab\": {\"arm\": [\"left\", \"it's\"], 7: 8, base: [on, {}]}, \"/odd\": x}, \
            running: {8: \"/lab\", 99999999999999999999: /t, x: /t, 8: /u, 9: [], 0: /t}, boot: 9}";
        let told = Description::parse(answer).expect("readable");
        assert_eq!((told.version.as_str(), told.boot), ("0.1.0", 7));
        let arm = ["left", "it's"].map(str::to_owned).to_vec();
        let base = vec!["on".to_owned()];
        let lab = Offers::from([
            ("arm".to_owned(), arm),
            ("7".to_owned(), Vec::new()),
            ("base".to_owned(), base),
        ]);
        let scopes = [("/lab".to_owned(), lab), ("/odd".to_owned(), Offers::new())];
        assert_eq!(told.scopes, BTreeMap::from(scopes));
        let running = told.running.expect("told");
        let running: Vec<_> = running
            .iter()
            .map(|(id, scope)| (id.as_str(), scope.as_str()))
            .collect();
        let expected = [("8", "/lab"), ("99999999999999999999", "/t"), ("8", "/u")];
        assert_eq!(running, expected);
        assert_eq!(told.unread, 3);
        for unreadable in [
            "",
            "nonsense",
            "{version: '1'}",
            "{boot: 7",
            "{boot: 7, version: 1, '",
        ] {
            assert!(Description::parse(unreadable).is_none(), "{unreadable}");
        }
    }
}
