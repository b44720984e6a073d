//! YAML files that people write: parsed with the place of every value, so that each mistake is
//! shown where it stands, with what would be right, and all of them at once.
//!
//! ```
//! use ztl_yaml::Document;
//!
//! let document = Document::parse("lab.yaml", b"port: 12345\nscpoe: /lab\n").unwrap();
//! let mut reading = document.reading();
//! let mut fields = reading.fields(document.root(), "a gateway").unwrap();
//! let port = fields.optional("port").and_then(|node| reading.whole::<u16>(node, "a port"));
//! fields.optional("scope");
//! fields.finish(&mut reading);
//! let mistakes = reading.finish(port).unwrap_err();
//! assert_eq!(mistakes.to_string(), "\
//! lab.yaml:2:1: unknown key 'scpoe'; did you mean 'scope'?
//!   2 | scpoe: /lab
//!     | ^^^^^
//! ");
//! ```

mod chars;
mod diagnostic;
mod explain;
mod flow;
mod merge;
pub mod python;
mod reading;
mod scalars;
mod scanner;
mod token;
mod tree;

pub use diagnostic::{Diagnostic, Diagnostics, closest};
pub use reading::{Fields, Reading};

/// Longest file that is to be read, in bytes.
pub const MAX_FILE: u64 = 1 << 20;

/// A place in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Mark {
    /// From 1.
    pub line: usize,
    /// In characters, from 1.
    pub column: usize,
}

/// From one place to another, which does not belong to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Span {
    /// Its first character.
    pub start: Mark,
    /// After its last.
    pub end: Mark,
}

/// A value and where it stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// Where.
    pub span: Span,
    /// What.
    pub value: Value,
    /// Its tag, as `tag:yaml.org,2002:str` for `!!str`.
    pub tag: Option<String>,
}

/// Whose rules a file follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rules {
    /// Those of our own files: a repeated key and a tag that is not YAML's own are mistakes.
    Ours,
    /// PyYAML's: of a repeated key the last value counts, and tags decide. That is left to the reader.
    Python,
}

/// Prefix of YAML's own tags.
pub const CORE: &str = "tag:yaml.org,2002:";

/// What is wrong, and where.
type Mistake = (Span, String);

/// What a YAML file is made of. A scalar stays the text that was written: whether `12` is a number
/// and `on` a word is for the one who asks, who knows what belongs there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Value {
    /// A text, a number, a truth value, or nothing.
    Scalar {
        /// Without quotes and with escapes resolved.
        text: String,
        /// Whether it stood there without quotes, so that it may be a number or nothing.
        plain: bool,
    },
    /// In order.
    List(Vec<Node>),
    /// In order, with what `<<` merges.
    Map(Vec<(Node, Node)>),
}

impl Node {
    /// Whether nothing was written, or `~` or `null`.
    #[must_use]
    pub fn is_null(&self) -> bool {
        match &self.value {
            Value::Scalar { text, plain: true } => {
                matches!(text.as_str(), "" | "~" | "null" | "Null" | "NULL")
            }
            _ => false,
        }
    }

    /// Whether it is this text and may mean something else than a text: without quotes, or after a
    /// single `!`, and without another tag.
    #[must_use]
    pub fn is_plainly(&self, written: &str) -> bool {
        match (&self.value, self.tag.as_deref()) {
            (Value::Scalar { text, plain: true }, None) => text == written,
            (Value::Scalar { text, .. }, Some("!")) => text == written,
            _ => false,
        }
    }

    /// What it is, for people.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match &self.value {
            _ if self.is_null() => "nothing",
            Value::Scalar { .. } => "a single value",
            Value::List(_) => "a list",
            Value::Map(_) => "a mapping",
        }
    }
}

/// A YAML file.
#[derive(Debug, Clone)]
pub struct Document {
    name: String,
    /// It began with a byte order mark, which is no part of the text.
    marked: bool,
    text: String,
    root: Node,
}

impl Document {
    /// Parses the content of a file; `name` is the file's, for mistakes.
    ///
    /// # Errors
    /// Where and why it is no YAML, has more than one document, repeats a key, or is nested deeper
    /// than any file of ours needs.
    pub fn parse(name: &str, bytes: &[u8]) -> Result<Self, Diagnostics> {
        Self::parse_by(name, bytes, Rules::Ours)
    }

    /// The same by other rules.
    ///
    /// # Errors
    /// As [`parse`](Self::parse), where these rules have it so.
    pub fn parse_by(name: &str, bytes: &[u8], rules: Rules) -> Result<Self, Diagnostics> {
        let text = match std::str::from_utf8(bytes) {
            Ok(text) => text,
            Err(error) => return Err(not_utf8(name, bytes, error.valid_up_to()).into()),
        };
        let plain = text.strip_prefix('\u{feff}').unwrap_or(text);
        let (marked, text) = (plain.len() < text.len(), plain);
        if let Some(mistake) = unprintable(name, text) {
            return Err(mistake.into());
        }
        let (root, mistakes) = tree::parse(text, rules);
        let shown = |(span, message)| Diagnostic::at(name, text, span, message);
        let mistakes: Vec<Diagnostic> = mistakes.into_iter().map(shown).collect();
        match root {
            Some(root) if mistakes.is_empty() => Ok(Self {
                name: name.to_owned(),
                marked,
                text: text.to_owned(),
                root,
            }),
            _ => Err(Diagnostics::new(mistakes)),
        }
    }

    /// The name of the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The outermost value; an empty file is an empty mapping.
    #[must_use]
    pub const fn root(&self) -> &Node {
        &self.root
    }

    /// The bytes that the file had.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        let mark = if self.marked { "\u{feff}" } else { "" };
        [mark.as_bytes(), self.text.as_bytes()].concat()
    }

    /// To take values out of it, and to collect what is wrong with them.
    #[must_use]
    pub fn reading(&self) -> Reading<'_> {
        Reading::new(self)
    }

    /// A mistake in this document.
    pub fn mistake(&self, span: Span, message: impl Into<String>) -> Diagnostic {
        Diagnostic::at(&self.name, &self.text, span, message.into())
    }
}

/// The first character that PyYAML does not take.
fn unprintable(name: &str, text: &str) -> Option<Diagnostic> {
    let taken = |c: char| match c {
        '\t' | '\n' | '\r' | ' '..='~' | '\u{85}' => true,
        c => c >= '\u{a0}' && !matches!(c, '\u{fffe}' | '\u{ffff}'),
    };
    let (at, c) = text.char_indices().find(|(_, c)| !taken(*c))?;
    let span = character_after(text.get(..at).unwrap_or_default());
    let message = format!(
        "the character U+{:04X} cannot stand in a file; within \"…\" write it as an escape",
        u32::from(c)
    );
    Some(Diagnostic::at(name, text, span, message))
}

/// Where the first byte stands that is no UTF-8.
fn not_utf8(name: &str, bytes: &[u8], place: usize) -> Diagnostic {
    let before = String::from_utf8_lossy(bytes.get(..place).unwrap_or_default());
    let span = character_after(&before);
    let text = String::from_utf8_lossy(bytes);
    let message = "this is no UTF-8; save the file as UTF-8".to_owned();
    Diagnostic::at(name, &text, span, message)
}

/// The place of the character that follows this text.
fn character_after(before: &str) -> Span {
    // The mark makes it a part of the line that it stands in.
    let end = diagnostic::end_of(&format!("{before}x"));
    let start = Mark {
        column: end.column - 1,
        ..end
    };
    Span { start, end }
}

#[cfg(test)]
mod tests;
