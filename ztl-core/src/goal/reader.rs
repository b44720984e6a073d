//! The goal's text, read from left to right: blanks, brackets, plain texts and texts in quotes.

use super::MAX_DEPTH;
use super::error::{Expected, GoalError, GoalErrorKind};
use super::quoted::{Quoted, Scratch};

/// A place in a goal's text, and what is needed to go on from there.
pub(super) struct Reader<'de> {
    text: &'de str,
    /// Bytes read.
    at: usize,
    /// Collections that are open here.
    depth: u8,
    /// Where the key read last begins.
    key: usize,
    scratch: Option<Scratch<'de>>,
}

/// A collection that is being read.
#[derive(Clone, Copy)]
pub(super) struct Open {
    at: usize,
    close: u8,
    /// Items begun, up to two.
    items: u8,
}

fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b'\n' | b'\r')
}

impl<'de> Reader<'de> {
    pub(super) fn new(text: &'de str, scratch: Option<Scratch<'de>>) -> Self {
        Self {
            text,
            at: 0,
            depth: 0,
            key: 0,
            scratch,
        }
    }

    /// Whether this is the goal itself, not something within it: its text has no quotes.
    pub(super) fn is_top(&self) -> bool {
        self.depth == 0
    }

    /// Bytes read.
    pub(super) fn at(&self) -> usize {
        self.at
    }

    /// Where the key read last begins.
    pub(super) fn last_key(&self) -> usize {
        self.key
    }

    /// Goes back to where something else is to be tried.
    pub(super) fn go_back(&mut self, at: usize) {
        self.at = at;
    }

    /// Goes to the key that comes next, and remembers where it begins.
    pub(super) fn begin_key(&mut self) -> usize {
        self.skip_blanks();
        self.key = self.at;
        self.at
    }

    fn rest(&self) -> &'de [u8] {
        self.text.as_bytes().get(self.at..).unwrap_or_default()
    }

    /// The next byte.
    pub(super) fn peek(&self) -> Option<u8> {
        self.rest().first().copied()
    }

    /// Goes to the next byte that is no blank, and shows it.
    pub(super) fn skip_blanks(&mut self) -> Option<u8> {
        let blanks = self.rest().iter().take_while(|&&byte| is_blank(byte));
        self.at += blanks.count();
        self.peek()
    }

    fn take(&mut self, byte: u8) -> bool {
        let there = self.skip_blanks() == Some(byte);
        self.at += usize::from(there);
        there
    }

    /// Reads the `:` between key and value, and goes to the value.
    pub(super) fn colon(&mut self) -> Result<(), GoalError> {
        if !self.take(b':') {
            return Err(GoalError::expected(self.at, Expected::Colon));
        }
        self.skip_blanks();
        Ok(())
    }

    /// Checks that nothing follows.
    pub(super) fn end(&mut self) -> Result<(), GoalError> {
        match self.skip_blanks() {
            None => Ok(()),
            Some(_) => Err(GoalError::expected(self.at, Expected::End)),
        }
    }

    /// The whole text, for a goal that is a text: it stands there without quotes.
    pub(super) fn whole(&mut self) -> &'de str {
        self.at = self.text.len();
        self.text
    }

    /// Reads an opening bracket; `None` when it is none of these.
    pub(super) fn open(&mut self, brackets: &[u8]) -> Result<Option<Open>, GoalError> {
        let Some(bracket) = self.skip_blanks().filter(|byte| brackets.contains(byte)) else {
            return Ok(None);
        };
        if self.depth == MAX_DEPTH {
            return Err(GoalError::new(self.at, GoalErrorKind::TooDeep));
        }
        let close = match bracket {
            b'[' => b']',
            b'(' => b')',
            _ => b'}',
        };
        let open = Open {
            at: self.at,
            close,
            items: 0,
        };
        self.depth += 1;
        self.at += 1;
        Ok(Some(open))
    }

    /// Goes to the next item, or to the closing bracket and says that there is none.
    pub(super) fn more(&mut self, open: &mut Open) -> Result<bool, GoalError> {
        let first = open.items == 0;
        let comma = !first && self.take(b',');
        match self.skip_blanks() {
            None => Err(GoalError::new(open.at, GoalErrorKind::Unterminated)),
            Some(byte) if byte == open.close => {
                // Python reads (1) as the number 1.
                if byte == b')' && open.items == 1 && !comma {
                    return Err(GoalError::expected(self.at, Expected::Comma));
                }
                // Asked again, it is still there.
                open.items = open.items.max(2);
                Ok(false)
            }
            Some(_) if first || comma => {
                open.items = open.items.saturating_add(1);
                Ok(true)
            }
            Some(_) => Err(GoalError::expected(self.at, Expected::CommaOrClose)),
        }
    }

    /// Reads the closing bracket, which [`more`](Self::more) found.
    pub(super) fn close(&mut self) {
        self.at += 1;
        self.depth -= 1;
    }

    /// Reads a plain text: at the top all that there is, else up to the mark that ends it.
    pub(super) fn plain(&mut self) -> Result<&'de str, GoalError> {
        self.skip_blanks();
        let len = if self.is_top() {
            self.rest().len()
        } else {
            self.plain_len()?
        };
        let text = self.text.get(self.at..self.at + len).unwrap_or_default();
        self.at += len;
        Ok(text.trim_end_matches(|c| u8::try_from(c).is_ok_and(is_blank)))
    }

    fn plain_len(&self) -> Result<usize, GoalError> {
        let bytes = self.rest();
        let not_here = |len: usize, expected| Err(GoalError::expected(self.at + len, expected));
        match bytes {
            // Marks of YAML for what is not read here, and Python's bytes.
            [
                b'#' | b'&' | b'*' | b'!' | b'|' | b'>' | b'%' | b'@' | b'`' | b'\'' | b'"',
                ..,
            ]
            | [b'b' | b'B', b'\'' | b'"', ..]
            | [b'-' | b'?', b' ' | b'\t' | b'\n' | b'\r', ..] => {
                return not_here(0, Expected::Value);
            }
            _ => {}
        }
        // The outermost of the brackets that are open within the text.
        let (mut outer, mut brackets) = (0, 0usize);
        let mut before = b'a';
        let mut len = 0;
        for (place, &byte) in bytes.iter().enumerate() {
            let next = bytes.get(place + 1).copied();
            let ends = match byte {
                b',' | b']' | b'}' | b'\n' | b'\r' => true,
                b')' if brackets == 0 => true,
                b':' => next.is_none_or(|next| is_blank(next) || b",[]{}()".contains(&next)),
                _ => false,
            };
            if ends {
                break;
            }
            match byte {
                b'(' => {
                    outer = if brackets == 0 { place } else { outer };
                    brackets += 1;
                }
                b')' => brackets -= 1,
                b'[' | b'{' => return not_here(place, Expected::CommaOrClose),
                b'#' if is_blank(before) => return not_here(place, Expected::CommaOrClose),
                _ => {}
            }
            before = byte;
            len = place + 1;
        }
        if brackets > 0 {
            return not_here(outer, Expected::CommaOrClose);
        }
        if len == 0 {
            return not_here(0, Expected::Value);
        }
        Ok(len)
    }

    /// Reads a text in quotes, whose opening quote is the next byte.
    pub(super) fn quoted(&mut self) -> Result<&'de str, GoalError> {
        let start = self.at;
        let quoted = self.skip_quoted()?;
        match (quoted.special, &mut self.scratch) {
            (None, _) => Ok(quoted.inner),
            (Some(_), Some(scratch)) => scratch.unescape(&quoted, start),
            (Some(special), None) => {
                let at = start + 1 + special;
                Err(GoalError::new(at, GoalErrorKind::NeedsScratch))
            }
        }
    }

    /// Reads a text in quotes, whose opening quote is the next byte, without looking into it.
    pub(super) fn skip_quoted(&mut self) -> Result<Quoted<'de>, GoalError> {
        let text = self.text.get(self.at..).unwrap_or_default();
        let quoted =
            Quoted::find(text).ok_or(GoalError::new(self.at, GoalErrorKind::Unterminated))?;
        self.at += quoted.inner.len() + 2;
        Ok(quoted)
    }
}
