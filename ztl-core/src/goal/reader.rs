//! The tokenizer: whitespace, brackets, plain and quoted texts, from left to right.

use super::error::{Expected, Fault, MAX_DEPTH};
use super::quoted::Scratch;
use crate::cursor::Cursor;
use crate::text::is_blank;

/// A position in a goal's text and the state of parsing.
// The order of fields saves flash together with the attributes of `Cursor`.
#[repr(C)]
pub(super) struct Reader<'de> {
    pub(super) text: Cursor<'de>,
    /// Number of open collections.
    depth: u8,
    /// Whether an error was found; `text` then stands at its position.
    failed: bool,
    /// Start of the last key.
    key: usize,
    scratch: Option<Scratch<'de>>,
}

/// A collection that is being read.
pub(super) struct Open {
    at: usize,
    close: u8,
    /// Items started, up to two.
    items: u8,
}

impl Open {
    pub(super) fn is_mapping(&self) -> bool {
        self.close == b'}'
    }
}

/// Methods that fail leave `text` at the error.
impl<'de> Reader<'de> {
    pub(super) fn new(text: &'de str, scratch: Option<Scratch<'de>>) -> Self {
        Self {
            text: Cursor::new(text),
            depth: 0,
            key: 0,
            failed: false,
            scratch,
        }
    }

    /// Whether this is the goal itself rather than part of it; its text has no quotes.
    pub(super) fn is_top(&self) -> bool {
        self.depth == 0
    }

    /// Stores that a key begins here.
    pub(super) fn begin_key(&mut self) {
        self.key = self.text.at;
    }

    /// Start of the last key.
    pub(super) fn last_key(&self) -> usize {
        self.key
    }

    /// Moves to an error's position, unless one is set: the innermost value wins.
    pub(super) fn fail_at(&mut self, at: usize) {
        if !self.failed {
            self.failed = true;
            self.text.at = at;
        }
    }

    /// Bytes needed and available, if the texts with escapes exceed the scratch.
    pub(super) fn scratch_too_small(&self) -> Option<(usize, usize)> {
        self.scratch.as_ref().map(Scratch::room)
    }

    /// Reads the `:` between key and value.
    pub(super) fn colon(&mut self) -> Result<(), Fault> {
        self.text.skip_blanks();
        if self.text.take(b':') {
            Ok(())
        } else {
            Err(Fault::Expected(Expected::Colon))
        }
    }

    /// Checks that nothing follows.
    pub(super) fn end(&mut self) -> Result<(), Fault> {
        self.text.skip_blanks();
        if self.text.is_at_end() {
            Ok(())
        } else {
            Err(Fault::Expected(Expected::End))
        }
    }

    /// The whole text, for a goal that is an unquoted text.
    pub(super) fn whole(&mut self) -> &'de str {
        let text = self.text.text();
        self.text.at = text.len();
        text
    }

    /// Reads the opening bracket of a sequence, a mapping, or either.
    pub(super) fn open(&mut self, expected: Expected) -> Result<Open, Fault> {
        let bracket = self.text.peek();
        let fits = match bracket {
            b'[' | b'(' => expected != Expected::Mapping,
            b'{' => expected != Expected::Sequence,
            _ => false,
        };
        if !fits {
            return Err(Fault::Expected(expected));
        }
        if self.depth == MAX_DEPTH {
            return Err(Fault::TooDeep);
        }
        let at = self.text.at;
        self.depth += 1;
        self.text.at += 1;
        // In ASCII, `[` and `]`, and `{` and `}`, are two apart.
        let close = bracket + if bracket == b'(' { 1 } else { 2 };
        Ok(Open {
            at,
            close,
            items: 0,
        })
    }

    /// Moves to the next item, or to the closing bracket and returns `false`.
    pub(super) fn more(&mut self, open: &mut Open) -> Result<bool, Fault> {
        self.text.skip_blanks();
        let separated = open.items == 0 || self.text.take(b',');
        let next = self.text.skip_blanks();
        if next == open.close {
            // Python reads `(1)` as the number 1.
            if next == b')' && open.items == 1 && !separated {
                return Err(Fault::Expected(Expected::Comma));
            }
            // A second call must give the same answer.
            open.items = 2;
            return Ok(false);
        }
        if next == 0 {
            self.text.at = open.at;
            return Err(Fault::Unterminated);
        }
        if !separated {
            return Err(Fault::Expected(Expected::CommaOrClose));
        }
        open.items = 1 + u8::from(open.items != 0);
        Ok(true)
    }

    /// Reads the closing bracket; fails if there are more items.
    pub(super) fn close(&mut self, open: &mut Open) -> Result<(), Fault> {
        if self.more(open)? {
            return Err(Fault::WrongLength);
        }
        self.text.at += 1;
        self.depth -= 1;
        Ok(())
    }

    /// Reads a plain text without trailing whitespace: at the top the whole rest, else up to the mark that
    /// ends it. Within a collection it must not be empty.
    pub(super) fn plain(&mut self) -> &'de str {
        let start = self.text.at;
        if self.is_top() || !self.is_mark() {
            self.skip_plain();
        }
        self.text.part(start, self.text.at)
    }

    /// Whether no plain text can begin here: at a YAML mark that is not supported, or Python's bytes.
    fn is_mark(&self) -> bool {
        let byte = self.text.peek();
        let next = self.text.ahead(1);
        match byte {
            b'b' | b'B' => matches!(next, b'\'' | b'"'),
            b'-' | b'?' => is_blank(next),
            _ => is_one_of(byte, b"#&*!|>%@`'\""),
        }
    }

    /// Skips a plain text without its trailing whitespace, including brackets that it opens.
    fn skip_plain(&mut self) {
        let top = self.is_top();
        let mut end = self.text.at;
        let mut brackets = 0usize;
        loop {
            let byte = self.text.peek();
            let next = self.text.ahead(1);
            let ends = match byte {
                0 => true,
                _ if top => false,
                b')' => brackets == 0,
                b':' => is_blank(next) || is_one_of(next, b",[]{}()\0"),
                // Within a collection there is always a previous byte.
                b'#' => is_blank(self.text.ahead(usize::MAX)),
                _ => is_one_of(byte, b",[]{}\n\r"),
            };
            if ends {
                break;
            }
            match byte {
                _ if top => {}
                b'(' => brackets += 1,
                b')' => brackets -= 1,
                _ => {}
            }
            self.text.at += 1;
            if brackets == 0 && !is_blank(byte) {
                end = self.text.at;
            }
        }
        self.text.at = end;
    }

    /// Reads a quoted text; the next byte is its opening quote.
    pub(super) fn quoted(&mut self) -> Result<&'de str, Fault> {
        let start = self.text.at;
        let special = self.skip_quoted()?;
        if special == 0 {
            return Ok(self.text.part(start + 1, self.text.at - 1));
        }
        if let Some(scratch) = &mut self.scratch {
            return scratch.unescape(start, &mut self.text);
        }
        self.text.at = special;
        Err(Fault::NeedsScratch)
    }

    /// Skips a quoted text; the next byte is its opening quote. Returns the offset of the first escape,
    /// doubled quote or line break, or 0 if there is none.
    pub(super) fn skip_quoted(&mut self) -> Result<usize, Fault> {
        let start = self.text.at;
        let quote = self.text.peek();
        let mut special = 0;
        loop {
            self.text.at += 1;
            let here = self.text.at;
            let byte = self.text.peek();
            if byte == 0 {
                self.text.at = start;
                return Err(Fault::Unterminated);
            }
            if byte == quote && (byte == b'"' || self.text.ahead(1) != quote) {
                self.text.at += 1;
                return Ok(special);
            }
            // Skips the second of the two bytes.
            self.text.at += usize::from(byte == quote || byte == b'\\');
            if special == 0 && (byte == b'\n' || self.text.at != here) {
                special = here;
            }
        }
    }
}

#[expect(clippy::manual_contains, reason = "memchr takes five times the flash")]
fn is_one_of(byte: u8, bytes: &[u8]) -> bool {
    bytes.iter().any(|&one| one == byte)
}
