//! Mistakes in files, as shown to people.

use std::fmt;

use crate::cursor::is_line_break;
use crate::node::{Mark, Span};

/// Most characters of a line that are shown.
const SHOWN: usize = 100;

/// One mistake in a file, its place and its remedy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// Name of the file.
    pub file: String,
    /// Its place; `None` if it is about the whole file.
    pub span: Option<Span>,
    /// What is wrong.
    pub message: String,
    /// The remedy, shown after the message.
    pub help: Option<String>,
    /// The line where it begins.
    line: String,
}

impl Diagnostic {
    /// A mistake about a whole file.
    #[must_use]
    pub fn of_file(file: &str, message: impl Into<String>) -> Self {
        Self {
            file: file.to_owned(),
            span: None,
            message: message.into(),
            help: None,
            line: String::new(),
        }
    }

    /// A mistake at a place in `text`, the content of the file.
    pub(crate) fn at(file: &str, text: &str, span: Span, message: String) -> Self {
        let (start, line) = place(text, span.start);
        let end = if span.end > start { span.end } else { start };
        Self {
            file: file.to_owned(),
            span: Some(Span { start, end }),
            message,
            help: None,
            line: line.to_owned(),
        }
    }

    /// The place, the mistake and its remedy, on one line.
    #[must_use]
    pub fn sentence(&self) -> String {
        let Self { file, message, .. } = self;
        let mut text = match self.span {
            Some(Span { start, .. }) => {
                format!("{file}:{}:{}: {message}", start.line, start.column)
            }
            None => format!("{file}: {message}"),
        };
        if let Some(help) = &self.help {
            text.push_str("; ");
            text.push_str(help);
        }
        text
    }

    /// Adds the remedy.
    #[must_use]
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }
}

/// A place within the text, and its line. A parser at the end is past the last line.
fn place(text: &str, mark: Mark) -> (Mark, &str) {
    match lines(text).nth(mark.line.saturating_sub(1)) {
        Some(line) => (mark, line),
        None => (end_of(text), lines(text).last().unwrap_or_default()),
    }
}

/// The lines of a text. YAML has more line breaks than '\n'.
fn lines(text: &str) -> impl Iterator<Item = &str> {
    let ended = text.split_inclusive(is_line_break);
    // "\r\n" is cut in two.
    let mut after_return = false;
    ended.filter_map(move |line| {
        let second_half = after_return && line == "\n";
        after_return = line.ends_with('\r');
        (!second_half).then(|| line.trim_end_matches(is_line_break))
    })
}

/// The place after the last character of a text.
pub(crate) fn end_of(text: &str) -> Mark {
    let last = lines(text).last().unwrap_or_default();
    Mark {
        line: lines(text).count().max(1),
        column: last.chars().count() + 1,
    }
}

/// The word of `known` that was probably meant.
#[must_use]
pub fn closest<'a>(written: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let plain = |text: &str| text.to_lowercase().replace('_', "-");
    let written = plain(written);
    let allowed = (written.chars().count() / 3).max(1);
    known
        .into_iter()
        .map(|word| (strsim::osa_distance(&written, &plain(word)), word))
        .filter(|(distance, word)| *distance <= allowed && *distance < word.chars().count())
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, word)| word)
}

impl fmt::Display for Diagnostic {
    /// The sentence; below it the line, and a mark under the mistake.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.sentence())?;
        let Some(Span { start, end }) = self.span else {
            return Ok(());
        };
        let before = start.column.saturating_sub(1);
        // Of a long line, show the part around the mistake.
        let left_out = before.saturating_sub(SHOWN / 2);
        let shown: String = self
            .line
            .chars()
            .skip(left_out)
            .take(SHOWN)
            .map(visible)
            .collect();
        let shown = shown.trim_end();
        let number = start.line.to_string();
        writeln!(f, "  {number} | {shown}")?;
        let room = shown.chars().count().saturating_sub(before - left_out);
        let width = match end.line == start.line {
            true => end.column.saturating_sub(start.column).min(room),
            false => room,
        };
        // Keep tabs, so that the mark is below the mistake.
        let below: String = shown
            .chars()
            .chain(std::iter::repeat(' '))
            .take(before - left_out)
            .map(|c| if c == '\t' { '\t' } else { ' ' })
            .collect();
        let marks = "^".repeat(width.max(1));
        writeln!(f, "  {:width$} | {below}{marks}", "", width = number.len())
    }
}

/// A character that a terminal shows and does not obey.
fn visible(c: char) -> char {
    match c {
        '\t' => c,
        c if c.is_control() => '\u{fffd}',
        c => c,
    }
}

/// All mistakes of a file, in its order; at least one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostics(Vec<Diagnostic>);

impl Diagnostics {
    /// Sorts them by place.
    #[must_use]
    pub fn new(mut mistakes: Vec<Diagnostic>) -> Self {
        mistakes.sort_by_key(|mistake| mistake.span.map(|span| span.start));
        Self(mistakes)
    }

    /// Each of them.
    pub fn iter(&self) -> std::slice::Iter<'_, Diagnostic> {
        self.0.iter()
    }
}

impl From<Diagnostic> for Diagnostics {
    fn from(mistake: Diagnostic) -> Self {
        Self(vec![mistake])
    }
}

impl IntoIterator for Diagnostics {
    type Item = Diagnostic;
    type IntoIter = std::vec::IntoIter<Diagnostic>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.into_iter()
    }
}

impl<'a> IntoIterator for &'a Diagnostics {
    type Item = &'a Diagnostic;
    type IntoIter = std::slice::Iter<'a, Diagnostic>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl fmt::Display for Diagnostics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|mistake| mistake.fmt(f))
    }
}

impl std::error::Error for Diagnostics {}
