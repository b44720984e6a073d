//! Styled lines, never wider than the screen, and the escaping, cutting and wrapping of text.

use std::borrow::Cow;
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
            let text = match utf8 {
                true => Cow::Borrowed(text.as_str()),
                false => Cow::Owned(ascii(text)),
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

/// Replaces characters by ASCII of the same width, so that columns stay aligned.
fn ascii(text: &str) -> String {
    let replace = |char: char| {
        let (sign, width) = match ascii_sign(char) {
            Some(sign) => (sign, 1),
            None => ('?', char.width().unwrap_or(0)),
        };
        std::iter::repeat_n(sign, width)
    };
    text.chars().flat_map(replace).collect()
}

const fn ascii_sign(char: char) -> Option<char> {
    Some(match char {
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
        _ => return None,
    })
}

/// Most accents and other marks that are shown on one character.
const MARKS: usize = 4;
/// Each so many characters of a text take at least one column when it is shown.
const MOST_PER_COLUMN: usize = MARKS + 1;

/// Escapes a text for a line of the screen. Replaces characters that are invisible or join others, and marks without a
/// character that they belong to: how wide these are differs between terminals.
fn shown(text: &str) -> String {
    let text = flat(text);
    let mut out = String::with_capacity(text.len());
    // The marks on the last character.
    let mut marks = MARKS;
    for char in text.chars() {
        let is_mark = !is_invisible(char) && char.width() == Some(0);
        if is_mark && marks < MARKS {
            marks += 1;
            // Without it, all terminals show the same width.
            if !is_variation(char) {
                out.push(char);
            }
        } else if is_mark || is_invisible(char) {
            marks = MARKS;
            out.push(char::REPLACEMENT_CHARACTER);
        } else {
            marks = 0;
            out.push(char);
        }
    }
    out
}

/// Whether a character chooses how the one before it is drawn.
const fn is_variation(char: char) -> bool {
    matches!(char, '\u{fe00}'..='\u{fe0f}')
}

/// Whether a character is usually not drawn at all (Unicode's `Default_Ignorable_Code_Point`).
const fn is_invisible(char: char) -> bool {
    matches!(char,
        '\u{ad}' | '\u{34f}' | '\u{61c}' | '\u{115f}' | '\u{1160}' | '\u{17b4}' | '\u{17b5}'
        | '\u{180b}'..='\u{180f}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}'
        | '\u{2060}'..='\u{206f}' | '\u{3164}' | '\u{feff}' | '\u{ffa0}' | '\u{fff0}'..='\u{fff8}'
        | '\u{1bca0}'..='\u{1bca3}' | '\u{1d173}'..='\u{1d17a}' | '\u{e0000}'..='\u{e0fff}')
}

/// The most columns that a text takes on a terminal. Terminals that do not join characters, such as an emoji with its
/// skin tone, show each of them.
pub(super) fn columns(text: &str) -> usize {
    let single = text.chars().filter_map(char::width).sum();
    text.width().max(single)
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
mod tests;
