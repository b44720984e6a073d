//! What a text is cut into before it becomes a tree.

use super::Span;

/// A token and where it stands.
#[derive(Debug)]
pub(super) struct Token {
    pub(super) span: Span,
    pub(super) kind: Kind,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Kind {
    StreamEnd,
    Directive(Directive),
    DocumentStart,
    DocumentEnd,
    /// A block's first line.
    ListStart,
    MapStart,
    BlockEnd,
    /// `[`, `{`.
    Open(Bracket),
    /// `]`, `}`.
    Close(Bracket),
    /// `- `
    Entry,
    /// `,`
    Comma,
    /// `?`, or the place before a key that a `:` follows.
    Key,
    /// `:`
    Value,
    Alias(String),
    Anchor(String),
    /// Handle, if there is one, and suffix.
    Tag(Option<String>, String),
    Scalar {
        text: String,
        plain: bool,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Bracket {
    Square,
    Curly,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Directive {
    /// `%YAML`: whether its version is 1.x.
    Yaml(bool),
    /// `%TAG HANDLE PREFIX`
    Tag(String, String),
    Other,
}

impl Bracket {
    pub(super) const fn open(self) -> char {
        match self {
            Self::Square => '[',
            Self::Curly => '{',
        }
    }

    pub(super) const fn close(self) -> char {
        match self {
            Self::Square => ']',
            Self::Curly => '}',
        }
    }
}
