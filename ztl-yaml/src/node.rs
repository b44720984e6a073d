//! A YAML value, and its place in the file.

/// A place in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Mark {
    /// From 1.
    pub line: usize,
    /// In characters, from 1.
    pub column: usize,
}

/// A part of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Span {
    /// Its first character.
    pub start: Mark,
    /// After its last character.
    pub end: Mark,
}

/// A value and its place.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// Its place.
    pub span: Span,
    /// The value.
    pub value: NodeValue,
    /// Its tag, as `tag:yaml.org,2002:str` for `!!str`.
    pub tag: Option<String>,
}

/// The rules that a file follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rules {
    /// For configuration files: a repeated key or an unknown tag is a mistake.
    Strict,
    /// PyYAML's: of a repeated key the last value counts, and tags decide. That is left to the reader.
    Python,
}

/// Prefix of YAML's own tags.
pub const CORE: &str = "tag:yaml.org,2002:";

/// What is wrong, and where.
pub(crate) type Mistake = (Span, String);

/// The value of a node. A scalar keeps its text: only the reader knows whether `12` is meant as a number and
/// `on` as a word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NodeValue {
    /// A text, a number, a truth value, or nothing.
    Scalar {
        /// Without quotes, and with escapes resolved.
        text: String,
        /// Whether it was written without quotes.
        plain: bool,
    },
    /// In order.
    List(Vec<Node>),
    /// In order, with what `<<` merges.
    Map(Vec<(Node, Node)>),
}

impl Node {
    /// Whether it is nothing, `~` or `null`.
    #[must_use]
    pub fn is_null(&self) -> bool {
        match &self.value {
            NodeValue::Scalar { text, plain: true } => {
                matches!(text.as_str(), "" | "~" | "null" | "Null" | "NULL")
            }
            _ => false,
        }
    }

    /// Whether it is this text in a form that may mean something else than a text: without quotes or a tag,
    /// or after a single `!`.
    #[must_use]
    pub fn is_plainly(&self, written: &str) -> bool {
        match (&self.value, self.tag.as_deref()) {
            (NodeValue::Scalar { text, plain: true }, None) => text == written,
            (NodeValue::Scalar { text, .. }, Some("!")) => text == written,
            _ => false,
        }
    }

    /// What it is, for messages.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match &self.value {
            _ if self.is_null() => "nothing",
            NodeValue::Scalar { .. } => "a single value",
            NodeValue::List(_) => "a list",
            NodeValue::Map(_) => "a mapping",
        }
    }
}
