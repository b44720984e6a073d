//! A configuration file, and all that is wrong in it and in the options beside it, each at its place.

use std::fmt;
use std::path::Path;

use ztl_std::files::load_yaml;
use ztl_yaml::{Diagnostic, Diagnostics, Document, Node, NodeValue, Span};

/// A configuration file, if there is one, and the mistakes that were found so far.
#[derive(Default)]
pub(crate) struct ConfigFile {
    name: Option<String>,
    document: Option<Document>,
    /// Not all of its values could be read.
    incomplete: bool,
    error: ConfigError,
}

/// What is wrong in a configuration.
#[derive(Debug, Default)]
pub(crate) struct ConfigError {
    /// In the file.
    placed: Vec<Diagnostic>,
    /// In the options, or missing.
    elsewhere: Vec<String>,
}

impl ConfigFile {
    /// Parses the file, if there is one.
    pub(crate) fn load(path: Option<&Path>) -> Self {
        let mut file = Self {
            name: path.map(|path| path.display().to_string()),
            ..Self::default()
        };
        match path.map(load_yaml) {
            Some(Ok(document)) => file.document = Some(document),
            Some(Err(mistakes)) => file.add(mistakes),
            None => {}
        }
        file
    }

    /// `None` without a file, and if it cannot be parsed.
    pub(crate) const fn document(&self) -> Option<&Document> {
        self.document.as_ref()
    }

    /// Adds mistakes for which values of the file could not be read.
    pub(crate) fn add(&mut self, mistakes: impl IntoIterator<Item = Diagnostic>) {
        self.error.placed.extend(mistakes);
        self.incomplete |= self.is_wrong();
    }

    /// The value behind these keys.
    pub(crate) fn value(&self, keys: &[&str]) -> Option<&Node> {
        keys.iter().try_fold(self.document()?.root(), |node, key| {
            let NodeValue::Map(pairs) = &node.value else {
                return None;
            };
            let is =
                |name: &Node| matches!(&name.value, NodeValue::Scalar { text, .. } if text == key);
            pairs
                .iter()
                .find(|(name, _)| is(name))
                .map(|(_, value)| value)
        })
    }

    /// The place of the value behind these keys.
    pub(crate) fn place(&self, keys: &[&str]) -> Option<Span> {
        self.value(keys).map(|node| node.span)
    }

    /// Adds a mistake in a value, which stands at this place of the file, or elsewhere.
    pub(crate) fn wrong(&mut self, place: Option<Span>, message: String) {
        match (&self.document, place) {
            (Some(document), Some(span)) => self.error.placed.push(document.mistake(span, message)),
            _ => self.error.elsewhere.push(message),
        }
    }

    /// Adds that a value is missing in the options and the file. Not if other values of the file could not be read: it
    /// may be one of them.
    pub(crate) fn missing(&mut self, what: &str, option: &str, key: &str) {
        if self.incomplete {
            return;
        }
        let key = match &self.name {
            Some(file) => format!("`{key}` in {file}"),
            None => format!("a configuration file (docs/gateway.md) with `{key}`"),
        };
        let message = format!("no {what}: give {option}, or {key}");
        self.error.elsewhere.push(message);
    }

    pub(crate) const fn is_wrong(&self) -> bool {
        !self.error.placed.is_empty() || !self.error.elsewhere.is_empty()
    }

    /// All mistakes, if there are any.
    pub(crate) fn finish(&mut self) -> Result<(), ConfigError> {
        match self.is_wrong() {
            true => Err(std::mem::take(&mut self.error)),
            false => Ok(()),
        }
    }
}

impl ConfigError {
    /// Each mistake on one line: those of the file with their places, then the others.
    pub(crate) fn sentences(self) -> (Vec<String>, Vec<String>) {
        let placed = Diagnostics::new(self.placed);
        (
            placed.iter().map(Diagnostic::sentence).collect(),
            self.elsewhere,
        )
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // Editors expect the place first in the line.
        let mut text = Diagnostics::new(self.placed.clone()).to_string();
        for mistake in &self.elsewhere {
            text += &format!("ztl: {mistake}\n");
        }
        f.write_str(text.trim_end())
    }
}
