//! What a server of this project says of itself: its answer to `probe`.

use std::collections::BTreeMap;

use serde::{Serialize, Serializer};
use ztl_yaml::{Document, Node, NodeValue, Rules};

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
        // Unlike serde, its nodes keep repeated keys and entries of another type.
        let document = Document::parse_by("probe", answer.as_bytes(), Rules::Python).ok()?;
        let root = pairs(document.root())?;
        let get = |key: &str| {
            let found = root
                .iter()
                .find(|(name, _)| text(name).is_some_and(|name| name == key));
            found.map(|(_, value)| value)
        };
        let offers = |handlers: &Node| -> Offers {
            let names = |node: &Node| match &node.value {
                NodeValue::List(items) => items.iter().filter_map(text).collect(),
                _ => Vec::new(),
            };
            let handlers = pairs(handlers).unwrap_or_default().iter();
            handlers
                .filter_map(|(name, components)| Some((text(name)?, names(components))))
                .collect()
        };
        let running = get("running").and_then(pairs);
        let task = |(id, scope): &(Node, Node)| {
            let id = text(id)?.parse().ok().filter(RemoteId::names_task)?;
            Some((id, text(scope)?))
        };
        let read: Option<Vec<_>> = running.map(|all| all.iter().filter_map(task).collect());
        let scopes = get("scopes").and_then(pairs).unwrap_or_default();
        Some(Self {
            version: text(get("version")?)?,
            boot: text(get("boot")?)?.parse().ok()?,
            scopes: scopes
                .iter()
                .filter_map(|(name, handlers)| Some((text(name)?, offers(handlers))))
                .collect(),
            unread: running.map_or(0, <[_]>::len) - read.as_ref().map_or(0, Vec::len),
            running: read,
        })
    }
}

/// The text of a single value as it is written; `None` for nothing.
fn text(node: &Node) -> Option<String> {
    match &node.value {
        NodeValue::Scalar { text, .. } if !node.is_null() => Some(text.clone()),
        _ => None,
    }
}

fn pairs(node: &Node) -> Option<&[(Node, Node)]> {
    match &node.value {
        NodeValue::Map(pairs) => Some(pairs),
        _ => None,
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
