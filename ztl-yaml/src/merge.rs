//! `<<: *base`: the keys of other mappings come first, and a mapping's own keys override them.

use std::collections::HashMap;

use crate::node::{CORE, Mistake, Node, NodeValue, Rules};

/// Whether a key asks to merge mappings.
pub(crate) fn is_merge(key: &Node) -> bool {
    match key.tag.as_deref() {
        Some(tag) if tag.strip_prefix(CORE) == Some("merge") => {
            matches!(key.value, NodeValue::Scalar { .. })
        }
        _ => key.is_plainly("<<"),
    }
}

/// The pairs of a mapping with what it merges, in PyYAML's order. Of a list of mappings the first one wins.
pub(crate) fn merged(
    pairs: Vec<(Node, Node)>,
    rules: Rules,
    mistakes: &mut Vec<Mistake>,
) -> Vec<(Node, Node)> {
    if !pairs.iter().any(|(key, _)| is_merge(key)) {
        return pairs;
    }
    let (merges, own): (Vec<_>, Vec<_>) = pairs.into_iter().partition(|(key, _)| is_merge(key));
    let mut all: Vec<(Node, Node)> = Vec::new();
    // Index of each merged key in `all`.
    let mut places = HashMap::new();
    for (_, value) in merges {
        let span = value.span;
        let maps = match value.value {
            NodeValue::List(maps) => maps.into_iter().rev().collect(),
            _ => vec![value],
        };
        for map in maps {
            let NodeValue::Map(pairs) = map.value else {
                let message = "'<<' takes a mapping or a list of mappings".to_owned();
                mistakes.push((span, message));
                break;
            };
            for pair in pairs {
                let name = identity(&pair.0, rules);
                let place = name.as_ref().and_then(|name| places.get(name).copied());
                match place.and_then(|place: usize| all.get_mut(place)) {
                    Some(place) => place.1 = pair.1,
                    None => {
                        name.map(|name| places.insert(name, all.len()));
                        all.push(pair);
                    }
                }
            }
        }
    }
    for pair in own {
        // A repeated key of its own is reported elsewhere.
        let place = identity(&pair.0, rules).and_then(|name| places.remove(&name));
        match place.and_then(|place| all.get_mut(place)) {
            Some(place) => *place = pair,
            None => all.push(pair),
        }
    }
    all
}

/// What makes two keys equal. By [`Rules::Strict`] it is the text; by Python's, `1` and `'1'` may differ, which is left to the
/// reader: of what remains, the last counts.
fn identity(key: &Node, rules: Rules) -> Option<(String, bool, Option<String>)> {
    match (&key.value, rules) {
        (NodeValue::Scalar { text, .. }, Rules::Strict) => Some((text.clone(), true, None)),
        (NodeValue::Scalar { text, plain }, Rules::Python) => {
            Some((text.clone(), *plain, key.tag.clone()))
        }
        _ => None,
    }
}
