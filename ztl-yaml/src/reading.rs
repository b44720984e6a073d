//! Takes values out of a document, and collects what is wrong with them.

use std::fmt::Display;
use std::str::FromStr;

use crate::diagnostic::{Diagnostic, Diagnostics, closest};
use crate::document::Document;
use crate::node::{Node, NodeValue, Span};

/// Takes values out of a [`Document`]. It collects mistakes, so that a person sees all of them at once; a
/// value that could not be read is `None`.
#[derive(Debug)]
pub struct Reading<'d> {
    document: &'d Document,
    mistakes: Vec<Diagnostic>,
}

impl Document {
    /// Takes values out of the document, and collects what is wrong with them. Begins with the document's own
    /// [`mistakes`](Self::mistakes).
    #[must_use]
    pub fn reading(&self) -> Reading<'_> {
        Reading {
            document: self,
            mistakes: self.mistakes().to_vec(),
        }
    }

    /// As [`reading`](Self::reading), for a part of the document, without the document's own mistakes.
    #[must_use]
    pub const fn part_reading(&self) -> Reading<'_> {
        Reading {
            document: self,
            mistakes: Vec::new(),
        }
    }
}

impl<'d> Reading<'d> {
    /// Returns what was read, if nothing was wrong.
    ///
    /// # Errors
    /// All that was wrong.
    pub fn finish<T>(self, read: Option<T>) -> Result<T, Diagnostics> {
        match self.into_parts(read) {
            (Some(read), mistakes) if mistakes.is_empty() => Ok(read),
            (_, mistakes) => Err(Diagnostics::new(mistakes)),
        }
    }

    /// Returns what was read as far as it could be, and all that was wrong: for a check that goes on.
    pub fn into_parts<T>(self, read: Option<T>) -> (Option<T>, Vec<Diagnostic>) {
        let mut mistakes = self.mistakes;
        if read.is_none() && mistakes.is_empty() {
            mistakes.push(Diagnostic::of_file(
                self.document.name(),
                "there is nothing in it",
            ));
        }
        (read, mistakes)
    }

    /// A mistake in `node`, which is not reported yet.
    pub fn mistake(&self, node: &Node, message: impl Into<String>) -> Diagnostic {
        self.document.mistake(node.span, message)
    }

    /// Reports a mistake in `node`.
    pub fn wrong(&mut self, node: &Node, message: impl Into<String>) {
        self.mistakes.push(self.mistake(node, message));
    }

    /// Reports a mistake in `node`, with its remedy.
    pub fn wrong_with(&mut self, node: &Node, message: String, help: Option<String>) {
        let mut mistake = self.document.mistake(node.span, message);
        mistake.help = help;
        self.mistakes.push(mistake);
    }

    /// A single value, as its text; `what` describes it, as `a scope, as /lab`.
    pub fn text(&mut self, node: &'d Node, what: &str) -> Option<&'d str> {
        match &node.value {
            NodeValue::Scalar { text, .. } if !node.is_null() => Some(text),
            _ => {
                self.wrong(node, format!("found {}; expected {what}", node.kind()));
                None
            }
        }
    }

    /// A whole number.
    pub fn whole<N: FromStr>(&mut self, node: &'d Node, what: &str) -> Option<N> {
        let text = self.text(node, what)?;
        let number = text.parse().ok();
        if number.is_none() {
            self.wrong(node, format!("'{text}' is not {what}"));
        }
        number
    }

    /// `true` or `false`; also `yes` and `no`, `on` and `off`.
    pub fn truth(&mut self, node: &'d Node) -> Option<bool> {
        match self.text(node, "true or false")? {
            "true" | "True" | "yes" | "on" => Some(true),
            "false" | "False" | "no" | "off" => Some(false),
            other => {
                self.wrong(node, format!("'{other}' is neither true nor false"));
                None
            }
        }
    }

    /// One of a few words.
    pub fn one_of<T: Copy>(&mut self, node: &'d Node, known: &[(&str, T)]) -> Option<T> {
        let words = known.iter().map(|(word, _)| *word);
        let list = words.clone().collect::<Vec<_>>().join(", ");
        let text = self.text(node, &list)?;
        let found = known.iter().find(|(word, _)| *word == text);
        if found.is_none() {
            let help = match closest(text, words) {
                Some(word) => format!("did you mean '{word}'?"),
                None => format!("there are: {list}"),
            };
            self.wrong_with(node, format!("'{text}' is not known here"), Some(help));
        }
        found.map(|(_, value)| *value)
    }

    /// A text parsed by a function, whose error becomes the message.
    pub fn parsed<T, E: Display>(
        &mut self,
        node: &'d Node,
        what: &str,
        parse: impl FnOnce(&str) -> Result<T, E>,
    ) -> Option<T> {
        match parse(self.text(node, what)?) {
            Ok(value) => Some(value),
            Err(error) => {
                self.wrong(node, error.to_string());
                None
            }
        }
    }

    /// A mapping with known keys: ask for each, then [`finish`](Fields::finish) it.
    pub fn fields(&mut self, node: &'d Node, what: &str) -> Option<Fields<'d>> {
        let pairs = self.pairs(node, what)?;
        Some(Fields {
            node,
            pairs,
            known: Vec::new(),
            missing: Vec::new(),
        })
    }

    /// A mapping with free keys.
    pub fn pairs(&mut self, node: &'d Node, what: &str) -> Option<&'d [(Node, Node)]> {
        match &node.value {
            NodeValue::Map(pairs) => Some(pairs),
            _ => {
                let message = format!("found {}; expected a mapping: {what}", node.kind());
                self.wrong(node, message);
                None
            }
        }
    }

    /// A list.
    pub fn list(&mut self, node: &'d Node, what: &str) -> Option<&'d [Node]> {
        match &node.value {
            NodeValue::List(nodes) => Some(nodes),
            _ => {
                self.wrong(
                    node,
                    format!("found {}; expected a list: {what}", node.kind()),
                );
                None
            }
        }
    }
}

/// A mapping with known keys.
#[derive(Debug)]
#[must_use = "only `finish` finds unknown and missing keys"]
pub struct Fields<'d> {
    node: &'d Node,
    pairs: &'d [(Node, Node)],
    known: Vec<&'static str>,
    missing: Vec<Missing>,
}

/// A required key that is not there.
#[derive(Debug)]
struct Missing {
    /// The key, or several, of which one is enough.
    keys: Vec<&'static str>,
    message: String,
    /// How to write it.
    example: String,
}

impl<'d> Fields<'d> {
    /// The value of a key; `None` if the key or its value is missing.
    pub fn optional(&mut self, key: &'static str) -> Option<&'d Node> {
        self.present(key).filter(|value| !value.is_null())
    }

    /// The value of a key, also an empty one; `None` if the key is missing. For settings that protect something: a
    /// forgotten value must not leave them out.
    pub fn present(&mut self, key: &'static str) -> Option<&'d Node> {
        self.known.push(key);
        let found = self.pairs.iter().find(|(name, _)| is(name, key));
        found.map(|(_, value)| value)
    }

    /// The keys that were not asked for, each with its text.
    pub fn unknown(&self) -> impl Iterator<Item = (&'d Node, &'d str)> {
        let texts = self.pairs.iter().filter_map(|(name, _)| match &name.value {
            NodeValue::Scalar { text, .. } => Some((name, text.as_str())),
            _ => None,
        });
        texts.filter(|(_, text)| !self.known.contains(text))
    }

    /// The key itself, if it is there.
    fn key(&self, key: &str) -> Option<&'d Node> {
        let mut names = self.pairs.iter().map(|(name, _)| name);
        names.find(|name| is(name, key))
    }

    /// The value of a required key; `example` is how to write it: `port: 12345`.
    pub fn required(&mut self, key: &'static str, example: &'static str) -> Option<&'d Node> {
        let found = self.optional(key);
        if found.is_none() {
            self.missing.push(Missing {
                keys: vec![key],
                message: format!("'{key}' is missing"),
                example: example.to_owned(),
            });
        }
        found
    }

    /// Whether one of these keys is there, without asking for it.
    #[must_use]
    pub fn has_one_of(&self, keys: &[&str]) -> bool {
        keys.iter().any(|key| self.key(key).is_some())
    }

    /// None of these keys is there, and one is required. The message is left out if an unknown key seems to be one of them.
    pub fn lacks_one_of(
        &mut self,
        keys: impl IntoIterator<Item = &'static str>,
        message: &str,
        example: &str,
    ) {
        self.missing.push(Missing {
            keys: keys.into_iter().collect(),
            message: message.to_owned(),
            example: example.to_owned(),
        });
    }

    /// Reports missing and unknown keys, and what was probably meant.
    pub fn finish(mut self, reading: &mut Reading<'d>) {
        for (name, _) in self.pairs {
            let NodeValue::Scalar { text, .. } = &name.value else {
                reading.wrong(name, "a key is a single word");
                continue;
            };
            if self.known.contains(&text.as_str()) {
                continue;
            }
            let open = self.known.iter().copied();
            let open = open.filter(|key| self.key(key).is_none());
            let help = match closest(text, open) {
                Some(key) => {
                    // The unknown key stands in its place.
                    self.missing.retain(|missing| !missing.keys.contains(&key));
                    format!("did you mean '{key}'?")
                }
                None => format!("there are: {}", self.known.join(", ")),
            };
            reading.wrong_with(name, format!("unknown key '{text}'"), Some(help));
        }
        for missing in &self.missing {
            let help = Some(format!("write {}", missing.example));
            let mut present = missing
                .keys
                .iter()
                .filter_map(|key| Some((key, self.key(key)?)));
            match present.next() {
                Some((key, name)) => {
                    // The example may be of another one of these keys.
                    let help = match missing.example.starts_with(key) {
                        true => help,
                        false => Some(format!("write its value after '{key}:'")),
                    };
                    reading.wrong_with(name, format!("'{key}' has no value"), help);
                }
                None => {
                    let start = self.node.span.start;
                    let begin = Span { start, end: start };
                    let mut mistake = reading.document.mistake(begin, missing.message.as_str());
                    mistake.help = help;
                    reading.mistakes.push(mistake);
                }
            }
        }
    }
}

fn is(name: &Node, key: &str) -> bool {
    matches!(&name.value, NodeValue::Scalar { text, .. } if text == key)
}
