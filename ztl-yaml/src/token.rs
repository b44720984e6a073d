//! Tokens: between text and tree.

use crate::node::Span;

/// A token and its place.
#[derive(Debug)]
pub(crate) struct Token {
    pub(crate) span: Span,
    pub(crate) kind: TokenKind,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum TokenKind {
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
    /// `?`, or inserted before a key that a `:` ends.
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
pub(crate) enum Bracket {
    Square,
    Curly,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Directive {
    /// `%YAML`: whether its version is 1.x.
    Yaml(bool),
    /// `%TAG HANDLE PREFIX`
    Tag(String, String),
    Other,
}

impl Bracket {
    pub(crate) const fn open(self) -> char {
        match self {
            Self::Square => '[',
            Self::Curly => '{',
        }
    }

    pub(crate) const fn close(self) -> char {
        match self {
            Self::Square => ']',
            Self::Curly => '}',
        }
    }
}
