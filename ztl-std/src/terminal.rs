//! Escapes text from elsewhere for a terminal. Otherwise results, names and the output of programs could clear
//! the screen, change its title, or imitate other output.
//!
//! Control characters are written as JSON escapes (`\u001b`), so that JSON stays JSON. Pipes and files get the
//! bytes unchanged.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write};

/// Writes text to a stream and flushes it; escapes it with [`shown`] if the stream is a terminal.
///
/// # Errors
/// The stream's error.
pub fn write_shown(mut to: impl Write + IsTerminal, text: &[u8]) -> io::Result<()> {
    if to.is_terminal() {
        let text = String::from_utf8_lossy(text);
        to.write_all(shown(&text).as_bytes())?;
    } else {
        to.write_all(text)?;
    }
    to.flush()
}

/// Escapes a text for a terminal; line feeds and tabs stay.
#[must_use]
pub fn shown(text: &str) -> Cow<'_, str> {
    escaped(text, &['\n', '\t'])
}

/// Escapes a text for one line of a terminal; also escapes line feeds and tabs.
#[must_use]
pub fn flat(text: &str) -> Cow<'_, str> {
    escaped(text, &[])
}

/// Escapes control characters except those in `kept`.
fn escaped<'t>(text: &'t str, kept: &[char]) -> Cow<'t, str> {
    let escapes = |c: char| controls(c) && !kept.contains(&c);
    if !text.contains(escapes) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        // Writing to a `String` cannot fail.
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
fn controls(c: char) -> bool {
    let reorders = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || reorders || matches!(c, '\u{2028}' | '\u{2029}')
}

/// Longest quoted part of a text, in bytes.
const QUOTED: usize = 300;

/// A text as messages quote it: if it is long, its beginning and its length.
#[must_use]
pub fn quoted(text: &str) -> Cow<'_, str> {
    match text.get(..text.floor_char_boundary(QUOTED)) {
        Some(start) if start.len() < text.len() => {
            Cow::Owned(format!("{start}… ({} bytes)", text.len()))
        }
        _ => Cow::Borrowed(text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_control_characters_are_escaped() {
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
        // The escapes are valid in JSON.
        let json = shown("\"\u{9b}\"").into_owned();
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), "\u{9b}");
    }

    #[test]
    fn a_long_text_is_quoted_by_its_beginning_and_its_length() {
        let fits = "x".repeat(QUOTED);
        assert_eq!(quoted(&fits), fits);
        assert_eq!(quoted(""), "");
        assert_eq!(quoted(&format!("{fits}x")), format!("{fits}… (301 bytes)"));
        // Not in the middle of a character.
        let wide = "€".repeat(QUOTED);
        assert_eq!(quoted(&wide), format!("{}… (900 bytes)", "€".repeat(100)));
    }
}
