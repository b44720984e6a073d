//! Lines of a screen: pieces of text with a style, as wide as the screen and no wider.

use unicode_width::{UnicodeWidthChar, UnicodeWidthStr};

/// What a piece of text is, which tells how it looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Style {
    Plain,
    Strong,
    /// Less important.
    Soft,
    Good,
    Bad,
    /// Asks for attention.
    Warning,
    /// Is under way.
    Active,
    /// A bar across the screen.
    Bar,
}

impl Style {
    /// The attributes of ECMA-48. Without colours what matters is still told by signs and words.
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

/// A line under construction: it never becomes wider than it may.
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

    /// Adds text, cut where the line ends.
    pub(super) fn put(&mut self, style: Style, text: &str) {
        let cut = clip(text, self.most.saturating_sub(self.width));
        self.width += cut.width();
        self.pieces.push((style, cut));
    }

    /// The same, in one expression.
    pub(super) fn and(mut self, style: Style, text: &str) -> Self {
        self.put(style, text);
        self
    }

    /// Blanks up to a column.
    pub(super) fn pad(&mut self, style: Style, column: usize) {
        let blanks = column.min(self.most).saturating_sub(self.width);
        self.put(style, &" ".repeat(blanks));
    }

    /// Text that ends where the line does.
    pub(super) fn put_right(&mut self, style: Style, text: &str) {
        let text = clip(text, self.most);
        self.pad(style, self.most.saturating_sub(text.width()));
        self.put(style, &text);
    }

    pub(super) const fn width(&self) -> usize {
        self.width
    }

    /// As a terminal takes it; `ascii` for one that shows nothing else.
    pub(super) fn encoded(&self, colour: bool, ascii: bool) -> String {
        let mut out = String::new();
        for (style, text) in &self.pieces {
            let attributes = style.attributes(colour);
            let text: String = match ascii {
                true => text.chars().map(plain).collect(),
                false => text.clone(),
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

/// Signs of ours in ASCII, one character for one, so that columns stay.
const fn plain(char: char) -> char {
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

/// What of a text can be shown: nothing that a terminal would act on, and nothing that would turn the
/// direction of what comes after.
pub(super) fn shown(text: &str) -> String {
    let show = |char: char| match char {
        '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{2069}' => '\u{fffd}',
        char if char.is_control() => ' ',
        char => char,
    };
    text.chars().map(show).collect()
}

/// Text of at most so many columns; what is cut off is told by `…`.
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

/// Text on lines of at most so many columns, broken at blanks or where a word is too long, what comes after the
/// first a little to the right; the last of `most` lines is cut.
pub(super) fn wrap(text: &str, width: usize, most: usize) -> Vec<String> {
    let text = shown(text);
    let indent = text.chars().take_while(|char| *char == ' ').count();
    let mut lines = Vec::new();
    let mut line = String::new();
    let next = " ".repeat((indent + 2).min(width / 2));
    for word in text.split_inclusive(' ') {
        let length = word.trim_end().width();
        let fits = |line: &str| line.width() + length <= width;
        // One that fits on no line is broken where this one ends.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_never_wider_than_it_may_be() {
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
    fn a_message_is_broken_at_blanks_and_cut_after_some_lines() {
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
    fn a_terminal_is_never_told_what_to_do_by_a_text() {
        let evil = "\x1b[2J\u{9b}31m\u{202e}\r\n\x07";
        let line = Line::new(80).and(Style::Plain, evil).encoded(true, false);
        assert_eq!(line, " [2J 31m\u{fffd}   ");
    }

    #[test]
    fn without_colour_there_is_none() {
        let line = Line::new(80)
            .and(Style::Bad, "✗ bad")
            .and(Style::Good, "ok");
        assert_eq!(line.encoded(false, true), "\x1b[1m! bad\x1b[0mok");
        assert_eq!(
            line.encoded(true, false),
            "\x1b[1;31m✗ bad\x1b[0m\x1b[32mok\x1b[0m"
        );
    }
}
