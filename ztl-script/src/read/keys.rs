//! Keys with parameters, and what is wrong with them.

use std::fmt::Display;
use std::time::Duration;

use ztl_yaml::python::{PythonValue, quoted};
use ztl_yaml::{Mark, Node, NodeValue, Span, closest};

use super::params::{self, Piece};
use super::reader::{Cut, Entry, Reader, short};
use crate::durations::spoken;

/// A longer delay was probably written in milliseconds.
const LONG_DELAY: Duration = Duration::from_secs(600);

impl Reader<'_> {
    /// Checks a name that is sent in front of a ':'.
    pub(super) fn sent(&mut self, node: &Node, what: &str, name: &str) {
        if name.contains(':') {
            let message = format!("servers take a {what}'s name to end before the ':'");
            let opens = name.contains(":{") || name.contains(":[");
            self.doubt(node.span, message, spaced(name).filter(|_| opens));
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

    /// Parses a key, and reports doubts about its parentheses.
    pub(super) fn key<'k>(&mut self, key: &'k str, node: &Node) -> params::Key<'k> {
        let parsed = params::parse(key);
        if let Some(doubt) = parsed.doubt {
            self.doubt(node.span, doubt, None);
        }
        parsed
    }

    /// A delay. A value that the original plays differently than written is a doubt.
    pub(super) fn delay(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
    ) -> Option<Duration> {
        let read = params::seconds(piece.value.unwrap_or_default());
        let seconds = self.parsed(entry, key, piece, read)?;
        let delay = params::delay(seconds);
        if seconds < 0.0 {
            let message = "a delay cannot be negative";
            let help = "write the seconds to wait, as delay=3".to_owned();
            self.doubt_at(entry, key, piece, message, Some(help));
        } else if params::is_too_short(seconds) {
            let message = "this waits less than a millisecond";
            let help = "a delay is in seconds, as delay=1.5".to_owned();
            self.doubt_at(entry, key, piece, message, Some(help));
        } else if delay > LONG_DELAY {
            let message = format!("this waits {}", spoken(delay));
            let help = "a delay is in seconds, as delay=1.5".to_owned();
            self.doubt_at(entry, key, piece, &message, Some(help));
        }
        Some(delay)
    }

    pub(super) fn limit(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
    ) -> Option<Option<Duration>> {
        let text = piece.value.unwrap_or_default();
        let limit = self.parsed(entry, key, piece, params::limit(text))?;
        if limit.is_none() && text != "none" {
            let message = "a limit must be above 0 seconds";
            let help = "write timeout=30, or timeout=none for no limit".to_owned();
            self.doubt_at(entry, key, piece, message, Some(help));
        }
        Some(limit)
    }

    /// A component with the name of a parameter is a task, but was probably meant as a parameter.
    pub(super) fn parameter(&mut self, node: &Node, value: &PythonValue) {
        let NodeValue::Scalar { text, plain: true } = &node.value else {
            return;
        };
        // A robot may have a component named `wait`.
        let meant = text != "wait" || matches!(value, PythonValue::Bool(_));
        if params::NAMES.contains(&text.as_str()) && meant {
            let message = format!("this is sent as a task of a component '{text}'");
            self.doubt(node.span, message, Some(in_parentheses(text, value)));
        }
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

    /// A typo is false, as in the original, and a doubt.
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

    /// Reports a parameter that has no effect: why, and what was probably meant.
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
                let message = format!("'{name}' is a separate parameter here");
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
                let elsewhere =
                    params::taken_by(name).map(|by| format!("write it behind the name of a {by}"));
                (name, message, help.or(elsewhere).unwrap_or_else(all))
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

/// Whether nothing follows a key, not even a ':'. The parser then puts its value in the place of the key.
pub(super) fn lacks_colon(name: &Node, value: &Node) -> bool {
    value.is_null() && value.span == name.span
}

/// What is wrong with a key that has no ':'. `None` if it was reported for an earlier part of the same text.
pub(super) fn colon_missing(entry: &Entry<'_>) -> Option<(Span, String, Option<String>)> {
    let key = entry.key.to_string();
    match entry.cut {
        Some(Cut::Again) => None,
        Some(Cut::Behind(value)) => {
            let start = value.span.end;
            let end = Mark {
                column: start.column + 1,
                ..start
            };
            let text = match &value.value {
                NodeValue::Scalar { text, .. } => text.as_str(),
                _ => "",
            };
            let message = format!(
                "this ',' ends '{}', and '{}' has no ':' behind it",
                short(text),
                short(&key)
            );
            let help = "put a text with ',' in it in quotes".to_owned();
            Some((Span { start, end }, message, Some(help)))
        }
        None => {
            let (message, help) = without_colon(&key);
            Some((entry.name.span, message, help))
        }
    }
}

/// Whether a ',' has probably cut a key without a ':' off the text before it. `before`: the value before it, and
/// whether that one was cut off.
pub(super) fn cut<'d>(
    before: Option<(&'d Node, Option<Cut<'d>>)>,
    name: &Node,
    value: &Node,
) -> Option<Cut<'d>> {
    let (before, cut) = before.filter(|_| lacks_colon(name, value))?;
    if cut.is_some() {
        return Some(Cut::Again);
    }
    let (NodeValue::Scalar { text, .. }, NodeValue::Scalar { plain: true, .. }) =
        (&name.value, &before.value)
    else {
        return None;
    };
    let is_text = !before.is_null() && spaced(text).is_none();
    is_text.then_some(Cut::Behind(before))
}

/// The message about a key without a ':', and the remedy.
pub(super) fn without_colon(key: &str) -> (String, Option<String>) {
    let help =
        spaced(key).unwrap_or_else(|| "a text with ',' in it needs quotes within { }".to_owned());
    (format!("'{}' has no ':' behind it", short(key)), Some(help))
}

/// The remedy for a text without a blank after its ':'. `http://` needs none.
pub(super) fn spaced(text: &str) -> Option<String> {
    let (name, value) = text.split_once(':')?;
    let forgotten = !value.is_empty() && !value.starts_with(['/', ' ']);
    let (name, value) = (short(name), short(value));
    forgotten.then(|| format!("write a space after the colon: {name}: {value}"))
}

/// Whether a key was meant as the name of its value.
pub(super) fn is_clear(entry: &Entry<'_>) -> bool {
    let (name, value) = (&entry.name, &entry.value);
    let NodeValue::Scalar { text, .. } = &name.value else {
        return true;
    };
    let is_map = matches!(value.value, NodeValue::Map(_));
    let slip = params::NAMES.contains(&text.as_str()) || spaced(text).is_some();
    !lacks_colon(name, value) && (is_map || !slip)
}

/// The remedy for a parameter outside of parentheses.
pub(super) fn in_parentheses(name: &str, value: impl Display) -> String {
    format!("if it is a parameter, write it in parentheses, as name ({name}={value})")
}

/// The place of a part of a key; the whole key if that cannot be told.
fn within(node: &Node, key: &str, part: &str) -> Span {
    let Span { start, end } = node.span;
    // `part` is a slice of `key`.
    let offset = (part.as_ptr() as usize).checked_sub(key.as_ptr() as usize);
    let before = offset
        .and_then(|offset| key.get(..offset))
        .map(|before| before.chars().count());
    let one_line = start.line == end.line;
    let quotes = usize::from(!matches!(
        &node.value,
        NodeValue::Scalar { plain: true, .. }
    ));
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
