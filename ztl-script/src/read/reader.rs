//! What reading keys, values and scenes has in common: the findings.

use ztl_yaml::python::{PythonValue, quoted};
use ztl_yaml::{Document, Node, Span};

use crate::finding::Finding;
use crate::model::Defaults;

/// Most characters of a value that a message repeats.
const SHOWN: usize = 40;

/// Reads a document and collects findings.
pub(super) struct Reader<'d> {
    pub(super) document: &'d Document,
    pub(super) defaults: Defaults,
    pub(super) findings: Vec<Finding>,
}

/// A key and its value.
pub(super) struct Entry<'d> {
    pub(super) key: PythonValue,
    pub(super) name: &'d Node,
    pub(super) value: &'d Node,
    /// Earlier entries with the same key, which are not played.
    pub(super) lost: Vec<(&'d Node, &'d Node)>,
    /// If a ',' has probably cut the key off a text.
    pub(super) cut: Option<Cut<'d>>,
}

/// A key without a ':' that a ',' has probably cut off the text before it.
#[derive(Debug, Clone, Copy)]
pub(super) enum Cut<'d> {
    /// The first one, behind this value.
    Behind(&'d Node),
    /// Behind another such key.
    Again,
}

impl Reader<'_> {
    pub(super) fn new(document: &Document, defaults: Defaults) -> Reader<'_> {
        let mistakes = document.mistakes().iter().cloned();
        Reader {
            document,
            defaults,
            findings: mistakes.map(Finding::mistake).collect(),
        }
    }

    pub(super) fn mistake(&mut self, span: Span, message: impl Into<String>, help: Option<String>) {
        let mut found = self.document.mistake(span, message);
        found.help = help;
        self.findings.push(Finding::mistake(found));
    }

    pub(super) fn doubt(&mut self, span: Span, message: impl Into<String>, help: Option<String>) {
        let mut found = self.document.mistake(span, message);
        found.help = help;
        self.findings.push(Finding::doubt(found));
    }

    /// How many mistakes were found.
    pub(super) fn mistakes(&self) -> usize {
        let mistakes = self.findings.iter().filter(|found| !found.is_doubt());
        mistakes.count()
    }
}

pub(super) fn short(text: &str) -> String {
    match text.char_indices().nth(SHOWN) {
        Some((at, _)) => format!("{}…", text.get(..at).unwrap_or_default()),
        None => text.to_owned(),
    }
}

pub(super) fn short_quoted(text: &str) -> String {
    quoted(&short(text))
}
