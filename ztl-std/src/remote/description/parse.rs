//! Reads the answer to `probe`.

use ztl_yaml::{Document, Node, NodeValue, Rules};

use super::super::RemoteId;
use super::{Description, Offers};

impl Description {
    /// Reads the answer to `probe`. Unknown keys are skipped; a repeated key does not hide what else can be read.
    pub(crate) fn parse(probed: &str) -> Option<Self> {
        let document = Document::parse_by("$ztl", probed.as_bytes(), Rules::Python).ok()?;
        let root = document.root();
        let offers = |handlers: &Node| -> Offers {
            let names = |node: &Node| match &node.value {
                NodeValue::List(items) => {
                    items.iter().filter_map(text).map(str::to_owned).collect()
                }
                _ => Vec::new(),
            };
            let pair = |(name, components): &(Node, Node)| {
                Some((text(name)?.to_owned(), names(components)))
            };
            let handlers = pairs(handlers).unwrap_or_default();
            handlers.iter().filter_map(pair).collect()
        };
        let scope =
            |(name, handlers): &(Node, Node)| Some((text(name)?.to_owned(), offers(handlers)));
        let task = |(id, scope): &(Node, Node)| {
            let id = text(id)?.parse().ok().filter(RemoteId::names_task)?;
            Some((id, text(scope)?.to_owned()))
        };
        let all = |key| get(root, key).and_then(pairs);
        let running = all("running");
        let read: Option<Vec<_>> = running.map(|all| all.iter().filter_map(task).collect());
        Some(Self {
            version: text(get(root, "version")?)?.to_owned(),
            boot: text(get(root, "boot")?)?.parse().ok()?,
            scopes: all("scopes")
                .unwrap_or_default()
                .iter()
                .filter_map(scope)
                .collect(),
            unread: running.map_or(0, <[_]>::len) - read.as_ref().map_or(0, Vec::len),
            running: read,
        })
    }
}

fn pairs(node: &Node) -> Option<&[(Node, Node)]> {
    match &node.value {
        NodeValue::Map(pairs) => Some(pairs),
        _ => None,
    }
}

fn get<'n>(node: &'n Node, key: &str) -> Option<&'n Node> {
    let mut pairs = pairs(node)?.iter();
    let (_, value) = pairs.find(|(name, _)| text(name) == Some(key))?;
    Some(value)
}

fn text(node: &Node) -> Option<&str> {
    match &node.value {
        NodeValue::Scalar { text, .. } => Some(text),
        _ => None,
    }
}
