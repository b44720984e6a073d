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
        self.width += columns(&cut);
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
        let blanks = self.most.saturating_sub(self.width + columns(&text));
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

/// Each so many characters of a text that is shown take at least a column.
const MOST_PER_COLUMN: usize = 1;

/// Escapes a text for a line of the screen, and replaces invisible characters that join others: how wide the result is
/// differs between terminals.
fn shown(text: &str) -> String {
    let joins = |char| matches!(char, '\u{200b}'..='\u{200d}' | '\u{2060}'..='\u{2065}');
    flat(text).replace(joins, "\u{fffd}")
}

/// The columns that a text takes on a terminal.
pub(super) fn columns(text: &str) -> usize {
    text.width()
}

/// The beginning of a text, if it certainly fills more than so many columns: the work for a line does not depend on how
/// much a server sends.
fn start(text: &str, columns: usize) -> &str {
    let most = columns.saturating_add(1).saturating_mul(MOST_PER_COLUMN);
    let end = text.char_indices().nth(most).map(|(at, _)| at);
    end.and_then(|end| text.get(..end)).unwrap_or(text)
}

/// Cuts text to at most `most` columns, with `…` at the cut.
pub(super) fn clip(text: &str, most: usize) -> String {
    let text = shown(start(text, most));
    if columns(&text) <= most {
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
    let start = start(text, width.saturating_mul(most));
    let mut shown = shown(start);
    if start.len() < text.len() {
        shown.push('…');
    }
    let indent = shown.chars().take_while(|char| *char == ' ').count();
    let next = " ".repeat((indent + 2).min(width / 2));
    let mut lines = Vec::new();
    let (mut line, mut filled, mut is_blank) = (String::new(), 0, true);
    'words: for word in shown.split_inclusive(' ') {
        let length = columns(word.trim_end());
        let fits = |filled: usize| filled + length <= width;
        // A word that fits on no line is broken at the end of this one.
        if !fits(filled) && fits(next.len()) && !is_blank && lines.len() + 1 < most {
            lines.push(std::mem::replace(&mut line, next.clone()));
            (filled, is_blank) = (next.len(), true);
        }
        for char in word.chars() {
            let more = char.width().unwrap_or(0);
            if char != ' ' && filled + more > width {
                if lines.len() + 1 >= most {
                    line.push('…');
                    break 'words;
                }
                if !is_blank {
                    lines.push(std::mem::replace(&mut line, next.clone()));
                    (filled, is_blank) = (next.len(), true);
                }
            }
            line.push(char);
            filled += more;
            is_blank &= char.is_whitespace();
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
    fn a_huge_text_takes_few_lines_and_says_that_it_was_cut() {
        let blanks = format!("a{}b", " ".repeat(500_000));
        for text in [
            "x".repeat(500_000),
            "word ".repeat(100_000),
            "日".repeat(500_000),
            blanks,
        ] {
            let lines = wrap(&text, 79, 40);
            assert!(lines.len() <= 40, "{}", lines.len());
            assert!(lines.iter().all(|line| columns(line) <= 79));
            assert!(lines.iter().all(|line| line.len() < 2000));
            assert!(lines.last().unwrap().ends_with('…'), "{lines:?}");
        }
        let whole = wrap(&"word ".repeat(1000), 79, usize::MAX);
        assert!(!whole.concat().contains('…') && whole.len() > 60);
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
