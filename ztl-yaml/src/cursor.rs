//! The characters of a text, each with its place.

use crate::node::{Mark, Mistake, Span};

/// The end of a line or of the text.
pub(crate) const fn is_break(c: char) -> bool {
    is_line_break(c) || c == '\0'
}

pub(crate) const fn is_line_break(c: char) -> bool {
    matches!(c, '\r' | '\n' | '\u{85}' | '\u{2028}' | '\u{2029}')
}

/// A blank, a tab, or the end of a line or of the text.
pub(crate) const fn is_space(c: char) -> bool {
    is_break(c) || matches!(c, ' ' | '\t')
}

/// A place in a text.
pub(crate) struct Cursor {
    chars: Vec<char>,
    pub(crate) index: usize,
    pub(crate) mark: Mark,
}

impl Cursor {
    pub(crate) fn new(text: &str) -> Self {
        Self {
            chars: text.chars().collect(),
            index: 0,
            mark: Mark { line: 1, column: 1 },
        }
    }

    pub(crate) fn peek(&self, ahead: usize) -> char {
        self.chars.get(self.index + ahead).copied().unwrap_or('\0')
    }

    /// The next characters.
    pub(crate) fn ahead(&self, len: usize) -> &[char] {
        let end = (self.index + len).min(self.chars.len());
        self.chars.get(self.index..end).unwrap_or_default()
    }

    /// Takes the next characters.
    pub(crate) fn take(&mut self, len: usize) -> String {
        let text = self.ahead(len).iter().collect();
        self.forward(len);
        text
    }

    pub(crate) fn forward(&mut self, len: usize) {
        for _ in 0..len {
            let Some(c) = self.chars.get(self.index).copied() else {
                return;
            };
            self.index += 1;
            if is_line_break(c) && !(c == '\r' && self.peek(0) == '\n') {
                self.mark.line += 1;
                self.mark.column = 1;
            } else if c != '\u{feff}' {
                self.mark.column += 1;
            }
        }
    }

    pub(crate) fn skip(&mut self, is: impl Fn(char) -> bool) {
        while is(self.peek(0)) && self.index < self.chars.len() {
            self.forward(1);
        }
    }

    /// A mistake at the next character.
    pub(crate) fn here(&self, message: impl Into<String>) -> Mistake {
        let end = Mark {
            column: self.mark.column + 1,
            ..self.mark
        };
        let start = self.mark;
        (Span { start, end }, message.into())
    }

    /// `---` or `...` at the beginning of a line.
    pub(crate) fn at_document_mark(&self) -> bool {
        self.mark.column == 1
            && matches!(self.ahead(3), ['-', '-', '-'] | ['.', '.', '.'])
            && is_space(self.peek(3))
    }

    /// Takes the end of a line, as the text that it stands for.
    pub(crate) fn scan_break(&mut self) -> Option<char> {
        let c = self.peek(0);
        match c {
            '\r' if self.peek(1) == '\n' => self.forward(2),
            c if is_line_break(c) => self.forward(1),
            _ => return None,
        }
        Some(match c {
            '\u{2028}' | '\u{2029}' => c,
            _ => '\n',
        })
    }
}
