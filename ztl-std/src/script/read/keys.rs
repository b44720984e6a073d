//! Keys with parameters: what is wrong with them, and where.

use std::time::Duration;

use super::super::params::{self, Piece};
use super::super::value::quoted;
use super::{Entry, Reader, short};
use crate::yaml::{Mark, Node, Span, Value as Yaml, closest};

impl Reader<'_> {
    /// A name that goes over the wire in front of a ':'.
    pub(super) fn sent(&mut self, node: &Node, what: &str, name: &str) {
        if name.contains(':') {
            let message = format!("servers take a {what}'s name to end before the ':'");
            self.doubt(node.span, message, None);
        } else if name.trim() != name {
            let message = format!(
                "the {what}'s name is sent with its blanks: {}",
                quoted(name)
            );
            let help = name.trim_start() == name;
            let help = help.then(|| "write no blank before the '('".to_owned());
            self.doubt(node.span, message, help);
        }
    }

    /// Takes a key apart, and says what is doubtful about its parentheses.
    pub(super) fn key<'k>(&mut self, key: &'k str, node: &Node) -> params::Key<'k> {
        let parsed = params::parse(key);
        if let Some(doubt) = parsed.doubt {
            self.doubt(node.span, doubt, None);
        }
        parsed
    }

    pub(super) fn seconds(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
    ) -> Option<Duration> {
        self.parsed(
            entry,
            key,
            piece,
            params::seconds(piece.value.unwrap_or_default()),
        )
    }

    pub(super) fn limit(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
    ) -> Option<Option<Duration>> {
        self.parsed(
            entry,
            key,
            piece,
            params::limit(piece.value.unwrap_or_default()),
        )
    }

    pub(super) fn parsed<T>(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        read: Result<T, String>,
    ) -> Option<T> {
        match read {
            Ok(value) => Some(value),
            Err(message) => {
                let span = within(entry.name, key, piece.value.unwrap_or(piece.text));
                self.mistake(span, message, None);
                None
            }
        }
    }

    /// A typo is false, as in the original, and doubtful.
    pub(super) fn truth(&mut self, entry: &Entry<'_>, key: &str, value: &str) -> bool {
        let (truth, known) = params::truth(value);
        if !known {
            let help = closest(value, ["true", "false", "yes", "no", "on", "off"]);
            let help = match help {
                Some(meant) => format!("did you mean '{meant}'?"),
                None => "write yes or no".to_owned(),
            };
            let span = within(entry.name, key, value);
            let value = short(value);
            self.doubt(
                span,
                format!("'{value}' is neither yes nor no, and is taken for no"),
                Some(help),
            );
        }
        truth
    }

    /// A parameter that has no effect: why, and what was probably meant.
    pub(super) fn unknown(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        whose: &str,
        known: &[&str],
    ) {
        let all = || {
            let first = known.first().unwrap_or(&"");
            format!("write as ({first}=…); there are: {}", known.join(", "))
        };
        let (text, message, help) = match (piece.name, piece.value) {
            (None, _) => {
                let message = format!("'{}' has more than one '='", short(piece.text));
                (piece.text, message, all())
            }
            (Some(name), None) if name.bytes().all(|c| c.is_ascii_digit()) => {
                let message = format!("'{name}' is a parameter of its own here");
                (
                    name,
                    message,
                    "write a fraction with a point, as 1.5".to_owned(),
                )
            }
            (Some(name), None) if known.contains(&name) => {
                (name, format!("'{name}' has no value"), all())
            }
            (Some(name), _) => {
                let message = format!("{whose} has no parameter '{}'", short(name));
                let meant = closest(name, known.iter().copied());
                let help = meant.map(|meant| format!("did you mean '{meant}'?"));
                (name, message, help.unwrap_or_else(all))
            }
        };
        let message = format!("{message}: it has no effect");
        self.doubt_at(entry, key, Piece { text, ..piece }, &message, Some(help));
    }

    pub(super) fn doubt_at(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        message: &str,
        help: Option<String>,
    ) {
        let span = within(entry.name, key, piece.text);
        self.doubt(span, message, help);
    }
}

/// Where a part of a key stands; the whole key where that cannot be told.
fn within(node: &Node, key: &str, part: &str) -> Span {
    let Span { start, end } = node.span;
    // `part` is a slice of `key`.
    let offset = (part.as_ptr() as usize).checked_sub(key.as_ptr() as usize);
    let before = offset
        .and_then(|offset| key.get(..offset))
        .map(|before| before.chars().count());
    let one_line = start.line == end.line;
    let quotes = usize::from(!matches!(&node.value, Yaml::Scalar { plain: true, .. }));
    let as_written = end.column.saturating_sub(start.column) == key.chars().count() + 2 * quotes;
    match before {
        Some(before) if one_line && as_written => {
            let column = start.column + quotes + before;
            let from = Mark { column, ..start };
            let to = Mark {
                column: column + part.chars().count(),
                ..start
            };
            Span {
                start: from,
                end: to,
            }
        }
        _ => node.span,
    }
}
