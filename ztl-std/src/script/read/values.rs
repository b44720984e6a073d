//! Values as PyYAML has them: `<<` merged, of equal keys the last value at the place of the first, and
//! what became something else than its writer probably meant.

use std::collections::HashMap;

use super::super::finding::Finding;
use super::super::model::Defaults;
use super::super::scalar::{self, CORE};
use super::super::value::Value;
use super::{Entry, Reader, short, short_quoted};
use crate::yaml::{Diagnostics, Document, LOOP, Node, Rules, Value as Yaml};

impl Value {
    /// What PyYAML's `safe_load` makes of a file: a goal as it would stand in a script.
    ///
    /// # Errors
    /// What PyYAML would not take.
    pub fn read(file: &str, bytes: &[u8]) -> Result<Self, Diagnostics> {
        let document = Document::parse_by(file, bytes, Rules::Python)?;
        let (defaults, findings) = (Defaults::default(), Vec::new());
        let mut reader = Reader {
            document: &document,
            defaults,
            findings,
        };
        let value = reader.value(document.root(), None);
        let mistakes = reader
            .findings
            .into_iter()
            .filter(|finding| !finding.is_doubt());
        let mistakes: Vec<_> = mistakes.map(Finding::into_diagnostic).collect();
        match mistakes.is_empty() {
            true => Ok(value),
            false => Err(Diagnostics::new(mistakes)),
        }
    }
}

impl<'d> Reader<'d> {
    /// The entries of a mapping: `<<` merged, of equal keys the last value at the place of the first.
    pub(super) fn entries(&mut self, node: &'d Node, tell: bool) -> Vec<Entry<'d>> {
        let mut pairs = Vec::new();
        self.flatten(node, &mut pairs);
        let mut entries: Vec<Entry<'d>> = Vec::new();
        // Where each is, and in which line of this very mapping it stands.
        let mut seen: HashMap<String, (usize, Option<usize>)> = HashMap::new();
        for (name, value, merged) in pairs {
            let key = match &name.value {
                // As a value it would have a meaning of its own.
                Yaml::Scalar { text, plain: true } if text == "=" => Value::Text(text.clone()),
                _ => self.value(name, tell.then_some(false)),
            };
            if !key.is_hashable() {
                self.mistake(name.span, "a collection cannot be a key", None);
                continue;
            }
            let line = (!merged).then_some(name.span.start.line);
            let identity = key.identity();
            let Some((index, first)) = seen.get(&identity).copied() else {
                seen.insert(identity, (entries.len(), line));
                entries.push(Entry {
                    key,
                    name,
                    value,
                    lost: Vec::new(),
                });
                continue;
            };
            if let Some(entry) = entries.get_mut(index) {
                if first.is_some() && !merged {
                    entry.lost.push((entry.name, entry.value));
                }
                entry.name = if merged { entry.name } else { name };
                entry.value = value;
            }
            // What was merged is there to be replaced.
            if let (Some(first), false) = (first, merged) {
                let key = key.to_string();
                let message = format!(
                    "'{}' stands here for the second time: this one counts, in the place of the first (line {first}), whose content is lost",
                    short(&key)
                );
                self.doubt(
                    name.span,
                    message,
                    Some("give them different names".to_owned()),
                );
            }
        }
        entries
    }

    /// Puts what is merged in front, as PyYAML does.
    pub(super) fn flatten(&mut self, node: &'d Node, pairs: &mut Vec<(&'d Node, &'d Node, bool)>) {
        let Yaml::Map(own) = &node.value else { return };
        let (merges, rest): (Vec<_>, Vec<_>) = own.iter().partition(|(key, _)| is_merge(key));
        for (_, value) in merges {
            let maps: Vec<&Node> = match &value.value {
                Yaml::Map(_) => vec![value],
                // The first ones win.
                Yaml::List(maps) => maps.iter().rev().collect(),
                Yaml::Scalar { .. } => Vec::new(),
            };
            if maps.is_empty() || maps.iter().any(|map| !matches!(map.value, Yaml::Map(_))) {
                if !matches!(&value.value, Yaml::List(maps) if maps.is_empty()) {
                    self.mistake(
                        value.span,
                        "'<<' takes a mapping or a list of mappings",
                        None,
                    );
                }
                continue;
            }
            for map in maps {
                let mut merged = Vec::new();
                self.flatten(map, &mut merged);
                pairs.extend(merged.into_iter().map(|(key, value, _)| (key, value, true)));
            }
        }
        pairs.extend(rest.into_iter().map(|(key, value)| (key, value, false)));
    }

    /// A value as Python has it. `tell`: whether to say what became something else than what stands
    /// there, and whether it is within a collection.
    pub(super) fn value(&mut self, node: &'d Node, tell: Option<bool>) -> Value {
        let tag = node
            .tag
            .as_deref()
            .filter(|tag| !matches!(*tag, "!" | "" | LOOP));
        let kind = match tag {
            None => None,
            Some(tag) => match tag.strip_prefix(CORE) {
                Some(kind) => Some(kind),
                None => {
                    let message = format!("the tag '{tag}' is not known; leave it out");
                    self.mistake(node.span, message, None);
                    return Value::Null;
                }
            },
        };
        match (&node.value, kind) {
            (Yaml::Scalar { text, .. }, None) if node.tag.as_deref() == Some(LOOP) => {
                Value::Loop(text.clone())
            }
            (Yaml::Scalar { text, plain }, kind) => self.scalar(node, text, *plain, kind, tell),
            (Yaml::List(items), None | Some("seq")) => Value::List(
                items
                    .iter()
                    .map(|item| self.value(item, tell.map(|_| true)))
                    .collect(),
            ),
            (Yaml::List(items), Some("omap" | "pairs")) => self.ordered(items, tell),
            (Yaml::Map(_), None | Some("map")) => {
                let entries = self.entries(node, tell.is_some());
                let pairs = entries.into_iter().map(|entry| {
                    // What is lost must be valid as well.
                    for (_, lost) in &entry.lost {
                        self.value(lost, None);
                    }
                    let value = self.value(entry.value, tell.map(|_| true));
                    (entry.key, value)
                });
                Value::Map(pairs.collect())
            }
            (Yaml::Map(_), Some("set")) => Value::Set(
                self.entries(node, tell.is_some())
                    .into_iter()
                    .map(|entry| entry.key)
                    .collect(),
            ),
            (_, Some(kind)) => {
                let message = format!("the tag '!!{kind}' does not belong to {}", node.kind());
                self.mistake(node.span, message, None);
                Value::Null
            }
        }
    }

    pub(super) fn ordered(&mut self, items: &'d [Node], tell: Option<bool>) -> Value {
        let mut pairs = Vec::new();
        for item in items {
            match &item.value {
                Yaml::Map(pair) if let [(key, value)] = pair.as_slice() => {
                    let tell = tell.map(|_| true);
                    pairs.push((self.value(key, tell), self.value(value, tell)));
                }
                _ => self.mistake(item.span, "wanted is a mapping of one key", None),
            }
        }
        Value::Pairs(pairs)
    }

    pub(super) fn scalar(
        &mut self,
        node: &Node,
        text: &str,
        plain: bool,
        kind: Option<&str>,
        tell: Option<bool>,
    ) -> Value {
        let read = match kind {
            Some(kind) => scalar::tagged(kind, text),
            None if plain || node.tag.is_some() => scalar::plain(text),
            None => Ok(Value::Text(text.to_owned())),
        };
        let value = read.unwrap_or_else(|message| {
            self.mistake(node.span, message, None);
            Value::Null
        });
        if let (Some(within), None, true) = (tell, kind, plain)
            && let Some(message) = surprise(text, &value, within)
        {
            let help = match (text, &value) {
                ("", _) => "write '' for an empty text, or None".to_owned(),
                (text, Value::Text(_)) => match text.parse().map(Value::Float) {
                    Ok(number) => format!("if you mean the number, write {number}"),
                    Err(_) => "put it in quotes".to_owned(),
                },
                (text, _) => format!("if you mean the text, put it in quotes: '{}'", short(text)),
            };
            self.doubt(node.span, message, Some(help));
        }
        value
    }
}

fn is_merge(key: &Node) -> bool {
    match (&key.value, key.tag.as_deref()) {
        (Yaml::Scalar { text, plain: true }, None) => text == "<<",
        (Yaml::Scalar { .. }, Some(tag)) => tag.strip_prefix(CORE) == Some("merge"),
        _ => false,
    }
}

/// What became something that its writer probably did not mean.
fn surprise(text: &str, value: &Value, within: bool) -> Option<String> {
    let became = |value: &Value| Some(format!("YAML reads {} as {value}", short_quoted(text)));
    match value {
        Value::Null if text.is_empty() => {
            Some("nothing is written here, which YAML reads as None".to_owned())
        }
        Value::Null => became(value),
        Value::Bool(_) if !matches!(text.to_lowercase().as_str(), "true" | "false") => {
            became(value)
        }
        // Digits of another base than ten; blanks and signs are as people mean them.
        Value::Int(digits)
            if !text.starts_with(['+']) && *digits != text && !text.contains('x') =>
        {
            became(value)
        }
        Value::Float(_) if text.contains([':', '_']) => became(value),
        Value::Date(_) | Value::Time(_) if within || value.to_string() != text => Some(format!(
            "YAML reads {} as a date, which is sent as {}",
            short_quoted(text),
            Value::List(vec![value.clone()])
        )),
        Value::Text(_) if within && is_almost_number(text) => Some(format!(
            "YAML reads {} as a text, which is sent in quotes",
            short_quoted(text)
        )),
        _ => None,
    }
}

/// `1e3`, `-.5`, `08`: numbers to people and to most programs, and not to YAML 1.1.
fn is_almost_number(text: &str) -> bool {
    text.contains(|c: char| c.is_ascii_digit()) && text.parse::<f64>().is_ok()
}
