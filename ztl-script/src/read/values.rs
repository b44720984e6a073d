//! Values as PyYAML reads them: `<<` merged, and of equal keys the last value in the place of the first. A
//! value that was probably meant otherwise is a doubt.

use std::collections::HashMap;

use ztl_yaml::python::{self, PythonValue};
use ztl_yaml::{CORE, Diagnostics, Document, Node, NodeValue, Rules};

use super::keys::{colon_missing, cut, lacks_colon};
use super::reader::{Cut, Entry, Reader, short, short_quoted};
use crate::finding::Finding;
use crate::model::Defaults;

/// Reads a file as PyYAML's `safe_load` does: as a goal in a script.
///
/// # Errors
/// Everything that PyYAML would not accept.
pub fn read_value(file: &str, bytes: &[u8]) -> Result<PythonValue, Diagnostics> {
    let document = Document::parse_by(file, bytes, Rules::Python)?;
    let mut reader = Reader::new(&document, Defaults::default());
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
        let NodeValue::Map(pairs) = &node.value else {
            return Vec::new();
        };
        let mut entries: Vec<Entry<'d>> = Vec::new();
        let mut seen: HashMap<String, usize> = HashMap::new();
        let mut before = None;
        for (name, value) in pairs {
            let cut = cut(before, name, value);
            before = Some((value, cut));
            let key = match name.is_plainly("=") {
                // As a value, '=' has a meaning of its own.
                true => PythonValue::Text("=".to_owned()),
                // About a key without a ':', that is the only finding.
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
                    cut,
                });
                continue;
            };
            if matches!(cut, Some(Cut::Again)) && lacks_colon(entry.name, entry.value) {
                // It changes nothing, and was reported.
                continue;
            }
            let line = entry.name.span.start.line;
            entry.lost.push((entry.name, entry.value));
            (entry.name, entry.value) = (name, value);
            let key = key.to_string();
            let message = format!(
                "duplicate key '{}': this one is played, in the place of the first (line {line})",
                short(&key)
            );
            let help = "give them different names".to_owned();
            self.doubt(name.span, message, Some(help));
        }
        entries
    }

    /// A value as Python reads it. `tell`: whether to report a value that was probably meant otherwise, and
    /// whether it is within a collection.
    pub(super) fn value(&mut self, node: &'d Node, tell: Option<bool>) -> PythonValue {
        let tag = node.tag.as_deref().filter(|tag| *tag != "!");
        let kind = match tag {
            None => None,
            Some(tag) => match tag.strip_prefix(CORE) {
                Some(kind) => Some(kind),
                None => {
                    let message = format!("the tag '{tag}' is not known; leave it out");
                    self.mistake(node.span, message, None);
                    return PythonValue::Null;
                }
            },
        };
        match (&node.value, kind) {
            (NodeValue::Scalar { text, plain }, kind) => {
                self.scalar(node, text, *plain, kind, tell)
            }
            (NodeValue::List(items), None | Some("seq")) => PythonValue::List(
                items
                    .iter()
                    .map(|item| self.value(item, tell.map(|_| true)))
                    .collect(),
            ),
            (NodeValue::List(items), Some("omap" | "pairs")) => self.ordered(items, tell),
            (NodeValue::Map(_), None | Some("map")) => {
                let entries = self.entries(node, tell.is_some());
                let pairs = entries.into_iter().map(|entry| {
                    // A lost value must be valid, too.
                    for (_, lost) in &entry.lost {
                        self.value(lost, None);
                    }
                    let mut within = tell.map(|_| true);
                    if lacks_colon(entry.name, entry.value)
                        && within.take().is_some()
                        && let Some((span, message, help)) = colon_missing(&entry)
                    {
                        self.doubt(span, message, help);
                    }
                    let value = self.value(entry.value, within);
                    (entry.key, value)
                });
                PythonValue::Map(pairs.collect())
            }
            (NodeValue::Map(_), Some("set")) => PythonValue::Set(
                self.entries(node, tell.is_some())
                    .into_iter()
                    .map(|entry| entry.key)
                    .collect(),
            ),
            (_, Some(kind)) => {
                let message = format!("the tag '!!{kind}' does not belong to {}", node.kind());
                self.mistake(node.span, message, None);
                PythonValue::Null
            }
        }
    }

    fn ordered(&mut self, items: &'d [Node], tell: Option<bool>) -> PythonValue {
        let mut pairs = Vec::new();
        for item in items {
            match &item.value {
                NodeValue::Map(pair) if let [(key, value)] = pair.as_slice() => {
                    let tell = tell.map(|_| true);
                    pairs.push((self.value(key, tell), self.value(value, tell)));
                }
                _ => self.mistake(item.span, "expected a mapping of one key", None),
            }
        }
        PythonValue::Pairs(pairs)
    }

    fn scalar(
        &mut self,
        node: &Node,
        text: &str,
        plain: bool,
        kind: Option<&str>,
        tell: Option<bool>,
    ) -> PythonValue {
        let value = match python::read(text, plain, node.tag.as_deref()) {
            Ok(value) => value,
            Err(message) => {
                self.mistake(node.span, message, None);
                return PythonValue::Null;
            }
        };
        if let (Some(within), None, true) = (tell, kind, plain)
            && let Some(message) = surprise(text, &value, within)
        {
            let help = match (text, &value) {
                ("", _) => "write '' for an empty text, or None".to_owned(),
                (text, PythonValue::Text(_)) if is_in_curly_quotes(text) => {
                    let text = text.trim_matches(CURLY_QUOTES);
                    format!("write straight quotes: {}", short_quoted(text))
                }
                (text, PythonValue::Text(_)) => match text.parse().map(PythonValue::Float) {
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

/// The message about a value that its writer probably did not mean.
fn surprise(text: &str, value: &PythonValue, within: bool) -> Option<String> {
    let became =
        |value: &PythonValue| Some(format!("YAML reads {} as {value}", short_quoted(text)));
    match value {
        PythonValue::Null if text.is_empty() => {
            Some("nothing is written here, which YAML reads as None".to_owned())
        }
        PythonValue::Null => became(value),
        PythonValue::Bool(_) if !matches!(text.to_lowercase().as_str(), "true" | "false") => {
            became(value)
        }
        // Digits in another base than ten.
        PythonValue::Int(digits)
            if !text.starts_with(['+']) && *digits != text && !text.contains('x') =>
        {
            became(value)
        }
        PythonValue::Float(_) if text.contains([':', '_']) => became(value),
        PythonValue::Date(_) | PythonValue::Time(_) if within || value.to_string() != text => {
            Some(format!(
                "YAML reads {} as a date, which is sent as {}",
                short_quoted(text),
                PythonValue::List(vec![value.clone()])
            ))
        }
        PythonValue::Text(_) if is_in_curly_quotes(text) => {
            Some("YAML takes these quotes for a part of the text".to_owned())
        }
        PythonValue::Text(_) if within && is_almost_number(text) => Some(format!(
            "YAML reads {} as a text, which is sent in quotes",
            short_quoted(text)
        )),
        _ => None,
    }
}

/// `1e3`, `-.5`, `08`: numbers to people and most programs, but not in YAML 1.1.
fn is_almost_number(text: &str) -> bool {
    text.contains(|c: char| c.is_ascii_digit()) && text.parse::<f64>().is_ok()
}

/// A word processor's quotes.
const CURLY_QUOTES: [char; 8] = ['“', '”', '„', '‟', '‘', '’', '‚', '‛'];

/// Whether a text begins and ends with such quotes, or is one half of a text that a ',' cut in two. A single
/// ’ is an apostrophe.
fn is_in_curly_quotes(text: &str) -> bool {
    let double = ['“', '”', '„', '‟'];
    let both = text.starts_with(CURLY_QUOTES) && text.ends_with(CURLY_QUOTES);
    both || text.starts_with(double) || text.ends_with(double)
}
