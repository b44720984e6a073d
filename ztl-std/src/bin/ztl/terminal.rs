//! Text for people, on stdout and stderr. A reader that has gone (`| head`) is not an error here.
//!
//! Everything this program prints goes through here, because results, device names and answers come
//! from elsewhere and a terminal obeys what it is sent. On a terminal such characters are shown as
//! JSON escapes (`\u001b`), so that JSON stays JSON. Pipes and files get the bytes as they are.

use std::borrow::Cow;
use std::fmt::{Display, Write as _};
use std::io::{IsTerminal, Write};

use ztl_std::State;

/// Prints a line at once, also into a pipe.
pub(crate) fn line(text: impl Display) {
    put(std::io::stdout().lock(), format!("{text}\n").as_bytes());
}

/// Prints without ending the line.
pub(crate) fn part(text: impl Display) {
    put(std::io::stdout().lock(), text.to_string().as_bytes());
}

/// Prints a line on stderr.
pub(crate) fn error_line(text: impl Display) {
    put(std::io::stderr().lock(), format!("{text}\n").as_bytes());
}

/// Prints on stderr without ending the line.
pub(crate) fn error_part(text: impl Display) {
    put(std::io::stderr().lock(), text.to_string().as_bytes());
}

/// stderr for log lines, which are looked at later and elsewhere: what commands a terminal is always
/// escaped.
pub(crate) struct Errors;

impl Write for Errors {
    /// Takes whole events.
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let text = String::from_utf8_lossy(bytes);
        let mut to = std::io::stderr().lock();
        to.write_all(shown(&text).as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

/// Prints a line with a state in it, in colour where a person sees it and has not declined colours.
pub(crate) fn line_with_state(before: &str, state: State, after: &str) {
    let Some(colour) = colour(state) else {
        return line(format_args!("{before}{}{after}", state.name()));
    };
    let (before, after) = (shown(before), shown(after));
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{before}\x1b[{colour}m{}\x1b[0m{after}", state.name())
        .and_then(|()| out.flush());
}

/// Writes text to a stream, where only what a terminal may get reaches one.
pub(crate) fn put(mut to: impl Write + IsTerminal, text: &[u8]) {
    let _ = if to.is_terminal() {
        let text = String::from_utf8_lossy(text);
        to.write_all(shown(&text).as_bytes())
    } else {
        to.write_all(text)
    }
    .and_then(|()| to.flush());
}

/// Text as a terminal may get it: lines and tabs stay.
fn shown(text: &str) -> Cow<'_, str> {
    escaped(text, &['\n', '\t'])
}

/// Text as part of one line, wherever it is written: line breaks are escaped as well.
pub(crate) fn flat(text: &str) -> Cow<'_, str> {
    escaped(text, &[])
}

/// Escapes what a terminal obeys instead of showing it, but for the characters in `kept`.
fn escaped<'t>(text: &'t str, kept: &[char]) -> Cow<'t, str> {
    let escapes = |c: char| commands(c) && !kept.contains(&c);
    if !text.contains(escapes) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        // Writing to a `String` does not fail.
        let _ = match c {
            c if !escapes(c) => out.write_char(c),
            '\n' => out.write_str("\\n"),
            '\r' => out.write_str("\\r"),
            '\t' => out.write_str("\\t"),
            c => write!(out, "\\u{:04x}", u32::from(c)),
        };
    }
    Cow::Owned(out)
}

/// Whether a character changes how a terminal shows others: control characters (C0, DEL, C1), line
/// separators, and what reorders text (Unicode's bidirectional controls).
pub(crate) fn commands(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Whether a person sees stdout, so that lines can be rewritten.
pub(crate) fn is_live() -> bool {
    std::io::stdout().is_terminal()
}

/// Writes over the line that the cursor is in, cut where it would wrap: that would be two to the
/// cursor. Only for terminals.
pub(crate) fn rewrite(text: &str, end: &str) {
    let width = terminal_size::terminal_size().map_or(80, |(width, _)| usize::from(width.0));
    let text: String = flat(text).chars().take(width).collect();
    let mut out = std::io::stdout().lock();
    let _ = write!(out, "\r\x1b[K{text}{end}").and_then(|()| out.flush());
}

/// Moves the cursor up by so many lines. Only for terminals.
pub(crate) fn up(lines: usize) {
    let mut out = std::io::stdout().lock();
    let _ = write!(out, "\x1b[{lines}A").and_then(|()| out.flush());
}

/// The colour of a state, where a person sees it and has not declined that (`NO_COLOR`).
fn colour(state: State) -> Option<u8> {
    let declined = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let dumb = std::env::var_os("TERM").is_none_or(|term| term == "dumb");
    let seen = is_live() && !dumb && !declined("NO_COLOR");
    seen.then_some(match state {
        State::Completed => 32,
        State::Failed | State::Rejected => 31,
        State::Aborted => 33,
        State::Initiated | State::Accepted => 36,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_is_escaped_and_all_else_stays() {
        for (text, on_terminal, in_a_line) in [
            (
                "grüße 👍\u{200d} a\u{a0}b",
                "grüße 👍\u{200d} a\u{a0}b",
                "grüße 👍\u{200d} a\u{a0}b",
            ),
            ("a\n\tb", "a\n\tb", "a\\n\\tb"),
            ("\x1b]0;x\x07", "\\u001b]0;x\\u0007", "\\u001b]0;x\\u0007"),
            (
                "\u{9b}2J\x7f\r",
                "\\u009b2J\\u007f\\r",
                "\\u009b2J\\u007f\\r",
            ),
            (
                "\u{202e}abc\u{2066}",
                "\\u202eabc\\u2066",
                "\\u202eabc\\u2066",
            ),
        ] {
            assert_eq!(shown(text), on_terminal);
            assert_eq!(flat(text), in_a_line);
        }
        // An escape is one in JSON too.
        let json = shown("\"\u{9b}\"").into_owned();
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), "\u{9b}");
    }
}
