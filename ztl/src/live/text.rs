//! Styled lines, never wider than the screen, and the escaping, cutting and wrapping of text.

use std::time::Duration;

use unicode_width::{UnicodeWidthChar, UnicodeWidthStr};

use crate::terminal::flat;

/// The meaning of a text, which determines its attributes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Style {
    Plain,
    Strong,
    /// Less important.
    Soft,
    Good,
    Bad,
    /// Needs attention.
    Warning,
    /// In progress.
    Active,
    /// Reversed: the title bar, and keys.
    Bar,
}

impl Style {
    /// SGR attributes (ECMA-48). Without colours, signs and words still carry the meaning.
    const fn attributes(self, colour: bool) -> &'static str {
        match (self, colour) {
            (Self::Plain, _) => "",
            (Self::Strong, _) => "1",
            (Self::Soft, _) => "2",
            (Self::Bar, _) => "7",
            (Self::Good, true) => "32",
            (Self::Bad, true) => "1;31",
            (Self::Warning, true) => "1;33",
            (Self::Active, true) => "36",
            (Self::Good | Self::Active, false) => "",
            (Self::Bad | Self::Warning, false) => "1",
        }
    }
}

/// A paragraph of a message or a page.
pub(super) type Paragraph = (Style, String);

/// What the terminal can show.
#[derive(Debug, Clone, Copy)]
pub(super) struct Capabilities {
    pub(super) colour: bool,
    pub(super) utf8: bool,
}

impl Capabilities {
    /// Those of this process's terminal, by `NO_COLOR` and the locale.
    pub(super) fn of_terminal() -> Self {
        let locale = ["LC_ALL", "LC_CTYPE", "LANG"]
            .into_iter()
            .filter_map(|name| std::env::var(name).ok())
            .find(|value| !value.is_empty())
            .unwrap_or_default()
            .to_ascii_lowercase();
        Self {
            colour: !crate::terminal::is_colour_declined(),
            utf8: locale.contains("utf-8") || locale.contains("utf8"),
        }
    }
}

/// A line of pieces with a style each. It never becomes wider than `most` columns.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Line {
    pieces: Vec<(Style, String)>,
    width: usize,
    most: usize,
}

impl Line {
    pub(super) const fn new(most: usize) -> Self {
        Self {
            pieces: Vec::new(),
            width: 0,
            most,
        }
    }

    /// Appends text, cut at the end of the line.
    pub(super) fn put(&mut self, style: Style, text: &str) {
        let cut = clip(text, self.most.saturating_sub(self.width));
        self.width += cut.width();
        self.pieces.push((style, cut));
    }

    /// The same, for chaining.
    pub(super) fn and(mut self, style: Style, text: &str) -> Self {
        self.put(style, text);
        self
    }

    /// Appends text at the right edge.
    pub(super) fn put_right(&mut self, style: Style, text: &str) {
        let text = clip(text, self.most);
        let blanks = self.most.saturating_sub(self.width + text.width());
        self.put(style, &" ".repeat(blanks));
        self.put(style, &text);
    }

    pub(super) const fn width(&self) -> usize {
        self.width
    }

    /// The bytes for the terminal.
    pub(super) fn encoded(&self, Capabilities { colour, utf8 }: Capabilities) -> String {
        let mut out = String::new();
        for (style, text) in &self.pieces {
            let attributes = style.attributes(colour);
            let text: String = match utf8 {
                true => text.clone(),
                false => text.chars().map(ascii).collect(),
            };
            if attributes.is_empty() || text.is_empty() {
                out.push_str(&text);
            } else {
                out.push_str(&format!("\x1b[{attributes}m{text}\x1b[0m"));
            }
        }
        out
    }
}

/// Replaces a character by one of ASCII, so that columns stay aligned.
const fn ascii(char: char) -> char {
    match char {
        '✓' => '+',
        '✗' => '!',
        '▶' => '>',
        '·' | '…' => '.',
        '■' => '#',
        '−' | '─' => '-',
        '↑' => '^',
        '↓' => 'v',
        '↻' => '~',
        '█' => '=',
        '░' => '.',
        char if char.is_ascii() => char,
        _ => '?',
    }
}

/// Escapes a text for a line of the screen, and replaces invisible characters that join others: how wide the result is
/// differs between terminals.
fn shown(text: &str) -> String {
    let joins = |char| matches!(char, '\u{200b}'..='\u{200d}' | '\u{2060}'..='\u{2065}');
    flat(text).replace(joins, "\u{fffd}")
}

/// Cuts text to at most `most` columns, with `…` at the cut.
pub(super) fn clip(text: &str, most: usize) -> String {
    let text = shown(text);
    if text.width() <= most {
        return text;
    }
    let mut out = String::new();
    let mut width = 0;
    for char in text.chars() {
        let more = char.width().unwrap_or(0);
        if width + more + 1 > most {
            break;
        }
        width += more;
        out.push(char);
    }
    if most > 0 {
        out.push('…');
    }
    out
}

/// Wraps text at blanks, and inside words that fit on no line. Lines after the first are indented; the last of
/// `most` lines is cut.
pub(super) fn wrap(text: &str, width: usize, most: usize) -> Vec<String> {
    let text = shown(text);
    let indent = text.chars().take_while(|char| *char == ' ').count();
    let mut lines = Vec::new();
    let mut line = String::new();
    let next = " ".repeat((indent + 2).min(width / 2));
    for word in text.split_inclusive(' ') {
        let length = word.trim_end().width();
        let fits = |line: &str| line.width() + length <= width;
        // A word that fits on no line is broken at the end of this one.
        if !fits(&line) && fits(&next) && !line.trim().is_empty() && lines.len() + 1 < most {
            lines.push(std::mem::replace(&mut line, next.clone()));
        }
        for char in word.chars() {
            let full = char != ' ' && line.width() + char.width().unwrap_or(0) > width;
            if full && !line.trim().is_empty() && lines.len() + 1 < most {
                lines.push(std::mem::replace(&mut line, next.clone()));
            }
            line.push(char);
        }
    }
    lines.push(line);
    lines
        .iter()
        .map(|line| clip(line.trim_end(), width))
        .collect()
}

/// Seconds with one decimal; from a minute on minutes and seconds.
pub(super) fn clock(time: Duration) -> String {
    let whole = time.as_secs();
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    match (hours, minutes) {
        (0, 0) => format!("{seconds}.{} s", time.subsec_millis() / 100),
        (0, _) => format!("{minutes}:{seconds:02}"),
        _ => format!("{hours}:{minutes:02}:{seconds:02}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: Capabilities = Capabilities {
        colour: false,
        utf8: false,
    };
    const FULL: Capabilities = Capabilities {
        colour: true,
        utf8: true,
    };

    #[test]
    fn a_line_is_never_wider_than_its_limit() {
        for most in 0..12 {
            for text in [
                "plain text",
                "日本語のテキスト",
                "a\u{301}b\u{301}c\u{301}defghijkl",
                "",
            ] {
                assert!(clip(text, most).width() <= most, "{text} in {most}");
                let mut line = Line::new(most).and(Style::Good, text).and(Style::Bar, text);
                line.put_right(Style::Plain, "right");
                assert!(line.width() <= most);
            }
        }
    }

    #[test]
    fn text_is_wrapped_at_blanks_and_cut_after_the_last_line() {
        assert_eq!(wrap("one line", 20, 3), ["one line"]);
        assert_eq!(
            wrap("  two lines of this", 11, 3),
            ["  two lines", "    of this"]
        );
        assert_eq!(wrap("a b c d e f g h", 5, 2), ["a b c", "  d …"]);
        assert_eq!(wrap("unbreakable", 5, 9), ["unbre", "  aka", "  ble"]);
        assert_eq!(wrap("unbreakable", 5, 2), ["unbre", "  ak…"]);
        assert_eq!(wrap("too narrow", 0, 3), ["", "", ""]);
        assert_eq!(wrap("", 5, 3), [""]);
    }

    #[test]
    fn text_cannot_control_the_terminal() {
        let evil = "\x1b[2J\u{9b}31m\u{202e}\u{61c}\u{2028}\u{2029}\r\n\x07";
        let line = Line::new(80).and(Style::Plain, evil).encoded(FULL);
        let escaped = r"\u001b[2J\u009b31m\u202e\u061c\u2028\u2029\r\n\u0007";
        assert_eq!(line, escaped);
        assert_eq!(wrap(evil, 80, 9), [escaped]);
        // Columns stay aligned.
        let joined = Line::new(80).and(Style::Plain, "a\u{200d}\u{200b}b\u{2060}");
        assert_eq!(joined.encoded(FULL), "a\u{fffd}\u{fffd}b\u{fffd}");
        assert_eq!(joined.width(), 5);
    }

    #[test]
    fn signs_and_attributes_follow_the_capabilities() {
        let line = Line::new(80)
            .and(Style::Bad, "✗ bad")
            .and(Style::Good, "ok");
        assert_eq!(line.encoded(PLAIN), "\x1b[1m! bad\x1b[0mok");
        assert_eq!(
            line.encoded(FULL),
            "\x1b[1;31m✗ bad\x1b[0m\x1b[32mok\x1b[0m"
        );
    }
}
