//! Values as PyYAML has them: `<<` merged, of equal keys the last value at the place of the first, and
//! what became something else than its writer probably meant.

use std::collections::HashMap;

use super::super::finding::Finding;
use super::super::model::Defaults;
use super::keys::{lacks_colon, without_colon};
use super::{Entry, Reader, short, short_quoted};
use ztl_yaml::python::{self, Value};
use ztl_yaml::{CORE, Diagnostics, Document, Node, Rules, Value as Yaml};

/// What PyYAML's `safe_load` makes of a file: a goal as it would stand in a script.
///
/// # Errors
/// What PyYAML would not take.
pub fn read_value(file: &str, bytes: &[u8]) -> Result<Value, Diagnostics> {
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

impl<'d> Reader<'d> {
    /// The entries of a mapping: `<<` merged, of equal keys the last value at the place of the first.
    pub(super) fn entries(&mut self, node: &'d Node, tell: bool) -> Vec<Entry<'d>> {
        let Yaml::Map(pairs) = &node.value else {
            return Vec::new();
        };
        let mut entries: Vec<Entry<'d>> = Vec::new();
        let mut seen: HashMap<String, usize> = HashMap::new();
        for (name, value) in pairs {
            let key = match name.is_plainly("=") {
                // As a value it would have a meaning of its own.
                true => Value::Text("=".to_owned()),
                // Of a key without a ':' that is said, and no more.
                false => self.value(name, (tell && !lacks_colon(name, value)).then_some(false)),
            };
            if !key.is_hashable() {
                self.mistake(name.span, "a collection cannot be a key", None);
                continue;
            }
            let identity = key.identity();
            let first = seen.get(&identity).copied();
            let Some(entry) = first.and_then(|first| entries.get_mut(first)) else {
                seen.insert(identity, entries.len());
                entries.push(Entry {
                    key,
                    name,
                    value,
                    lost: Vec::new(),
                });
                continue;
            };
            let line = entry.name.span.start.line;
            entry.lost.push((entry.name, entry.value));
            (entry.name, entry.value) = (name, value);
            let key = key.to_string();
            let message = format!(
                "'{}' stands here for the second time: this one counts, in the place of the first (line {line}), whose content is lost",
                short(&key)
            );
            let help = "give them different names".to_owned();
            self.doubt(name.span, message, Some(help));
        }
        entries
    }

    /// A value as Python has it. `tell`: whether to say what became something else than what stands
    /// there, and whether it is within a collection.
    pub(super) fn value(&mut self, node: &'d Node, tell: Option<bool>) -> Value {
        let tag = node.tag.as_deref().filter(|tag| *tag != "!");
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
                    let mut within = tell.map(|_| true);
                    if lacks_colon(entry.name, entry.value) && within.take().is_some() {
                        let (message, help) = without_colon(&entry.key.to_string());
                        self.doubt(entry.name.span, message, help);
                    }
                    let value = self.value(entry.value, within);
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
        let value = match python::read(text, plain, node.tag.as_deref()) {
            Ok(value) => value,
            Err(message) => {
                self.mistake(node.span, message, None);
                return Value::Null;
            }
        };
        if let (Some(within), None, true) = (tell, kind, plain)
            && let Some(message) = surprise(text, &value, within)
        {
            let help = match (text, &value) {
                ("", _) => "write '' for an empty text, or None".to_owned(),
                (text, Value::Text(_)) if is_in_curly_quotes(text) => {
                    let text = text.trim_matches(CURLY_QUOTES);
                    format!("write straight quotes: {}", short_quoted(text))
                }
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
        Value::Text(_) if is_in_curly_quotes(text) => {
            Some("YAML takes these quotes for a part of the text".to_owned())
        }
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

/// What a word processor makes of " and '.
const CURLY_QUOTES: [char; 8] = ['“', '”', '„', '‟', '‘', '’', '‚', '‛'];

/// Whether a text begins and ends so, or one half of what a ',' has cut does. A single ’ is an apostrophe.
fn is_in_curly_quotes(text: &str) -> bool {
    let double = ['“', '”', '„', '‟'];
    let both = text.starts_with(CURLY_QUOTES) && text.ends_with(CURLY_QUOTES);
    both || text.starts_with(double) || text.ends_with(double)
}
