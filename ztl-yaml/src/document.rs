//! A parsed file.

use crate::diagnostic::{Diagnostic, Diagnostics, end_of};
use crate::node::{Mark, Node, Rules, Span};
use crate::parser;

/// A YAML file.
#[derive(Debug, Clone)]
pub struct Document {
    name: String,
    /// Whether it began with a byte order mark, which is not part of the text.
    marked: bool,
    text: String,
    root: Node,
    mistakes: Vec<Diagnostic>,
}

impl Document {
    /// Parses a configuration file; `name` is its name in messages. Mistakes that do not keep it from being read,
    /// such as a duplicate key, are in [`mistakes`](Self::mistakes), and in what a [`Reading`](crate::Reading) of it returns.
    ///
    /// # Errors
    /// Where and why it is invalid YAML, has more than one document, or is nested too deeply.
    pub fn parse(name: &str, bytes: &[u8]) -> Result<Self, Diagnostics> {
        Self::parse_by(name, bytes, Rules::Strict)
    }

    /// Parses a file by other rules.
    ///
    /// # Errors
    /// As [`parse`](Self::parse), as far as these rules go.
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
        let (root, mistakes) = parser::parse(text, rules);
        let shown = |(span, message)| Diagnostic::at(name, text, span, message);
        let mistakes: Vec<Diagnostic> = mistakes.into_iter().map(shown).collect();
        match root {
            Some(root) => Ok(Self {
                name: name.to_owned(),
                marked,
                text: text.to_owned(),
                root,
                mistakes,
            }),
            None => Err(Diagnostics::new(mistakes)),
        }
    }

    /// The name of the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The outermost value. By [`Rules::Strict`] an empty file is an empty mapping.
    #[must_use]
    pub const fn root(&self) -> &Node {
        &self.root
    }

    /// What is wrong in the file, but does not keep its values from being read: duplicate keys and invalid merges.
    #[must_use]
    pub fn mistakes(&self) -> &[Diagnostic] {
        &self.mistakes
    }

    /// The bytes of the file.
    #[must_use]
    pub fn bytes(&self) -> Vec<u8> {
        let mark = if self.marked { "\u{feff}" } else { "" };
        [mark.as_bytes(), self.text.as_bytes()].concat()
    }

    /// A mistake in this document.
    pub fn mistake(&self, span: Span, message: impl Into<String>) -> Diagnostic {
        Diagnostic::at(&self.name, &self.text, span, message.into())
    }
}

/// The first character that PyYAML does not accept.
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

/// The first byte that is not UTF-8.
fn not_utf8(name: &str, bytes: &[u8], place: usize) -> Diagnostic {
    let before = String::from_utf8_lossy(bytes.get(..place).unwrap_or_default());
    let span = character_after(&before);
    let text = String::from_utf8_lossy(bytes);
    let message = "the file is not UTF-8; save it as UTF-8".to_owned();
    Diagnostic::at(name, &text, span, message)
}

/// The place of the character after this text.
fn character_after(before: &str) -> Span {
    // With one more character, so that the text does not end with a line break.
    let end = end_of(&format!("{before}x"));
    let start = Mark {
        column: end.column - 1,
        ..end
    };
    Span { start, end }
}
