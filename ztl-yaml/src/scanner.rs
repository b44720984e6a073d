//! Splits text into tokens by the rules of PyYAML 6.0, so that this reader and the original read the same
//! values from every file. The algorithm is that of PyYAML's scanner (MIT, see `LICENSE-PYYAML`).

use std::collections::{BTreeMap, VecDeque};

use crate::cursor::{Cursor, is_break, is_space};
use crate::node::{Mark, Mistake, Rules, Span};
use crate::token::{Bracket, Token, TokenKind};

/// Longest key without `?`, in characters.
const LONGEST_KEY: usize = 1024;

/// A place where a key may have begun: a `:` on the same line ends it.
struct SimpleKey {
    token: usize,
    /// Only a key can be there.
    required: bool,
    index: usize,
    mark: Mark,
}

pub(crate) struct Scanner {
    cursor: Cursor,
    /// Whether a tab between tokens counts as a blank. PyYAML rejects it.
    tabs: bool,
    done: bool,
    /// How many `[` and `{` are open.
    flow: usize,
    tokens: VecDeque<Token>,
    taken: usize,
    /// Column of the innermost block, 0 outside of all.
    indent: usize,
    indents: Vec<usize>,
    allow_key: bool,
    /// At most one per level of brackets.
    keys: BTreeMap<usize, SimpleKey>,
    /// Place of the last token.
    last: Span,
    /// The last text in quotes that has more than one line.
    pub(crate) long_quote: Option<Span>,
}

impl Scanner {
    pub(crate) fn new(text: &str, rules: Rules) -> Self {
        Self {
            cursor: Cursor::new(text),
            tabs: rules == Rules::Strict,
            done: false,
            flow: 0,
            tokens: VecDeque::new(),
            taken: 0,
            indent: 0,
            indents: Vec::new(),
            allow_key: true,
            keys: BTreeMap::new(),
            last: Span::default(),
            long_quote: None,
        }
    }

    /// The next token, which stays.
    pub(crate) fn peek_token(&mut self) -> Result<&Token, Mistake> {
        while self.needs_more()? {
            self.fetch()?;
        }
        // The end of the stream repeats.
        if self.tokens.is_empty() {
            self.push(TokenKind::StreamEnd, self.cursor.mark);
        }
        match self.tokens.front() {
            Some(token) => Ok(token),
            None => Err(self.cursor.here("unexpected end of the file")),
        }
    }

    /// Takes the next token.
    pub(crate) fn token(&mut self) -> Result<Token, Mistake> {
        self.peek_token()?;
        self.taken += 1;
        match self.tokens.pop_front() {
            Some(token) => Ok(token),
            None => Err(self.cursor.here("unexpected end of the file")),
        }
    }

    fn needs_more(&mut self) -> Result<bool, Mistake> {
        if self.done {
            return Ok(false);
        }
        if self.tokens.is_empty() {
            return Ok(true);
        }
        // The next token may yet turn out to be a key.
        self.drop_stale_keys()?;
        let first = self.keys.values().map(|key| key.token).min();
        Ok(first == Some(self.taken))
    }

    /// Adds a token that began at `start` and ends here.
    fn push(&mut self, kind: TokenKind, start: Mark) {
        self.push_to(kind, start, self.cursor.mark);
    }

    fn push_to(&mut self, kind: TokenKind, start: Mark, end: Mark) {
        let span = Span { start, end };
        self.last = span;
        self.tokens.push_back(Token { span, kind });
    }

    fn push_forward(&mut self, kind: TokenKind, len: usize) {
        let start = self.cursor.mark;
        self.cursor.forward(len);
        self.push(kind, start);
    }

    /// Scans the next token; sometimes several, or one that is inserted before others.
    fn fetch(&mut self) -> Result<(), Mistake> {
        self.skip_to_token();
        self.drop_stale_keys()?;
        self.unwind(self.cursor.mark.column);
        let c = self.cursor.peek(0);
        let alone = is_space(self.cursor.peek(1));
        match c {
            '\0' => self.fetch_end(),
            '%' if self.cursor.mark.column == 1 => self.fetch_directive(),
            '-' if self.cursor.at_document_mark() => {
                self.fetch_document_mark(TokenKind::DocumentStart)
            }
            '.' if self.cursor.at_document_mark() => {
                self.fetch_document_mark(TokenKind::DocumentEnd)
            }
            '[' => self.fetch_open(Bracket::Square),
            '{' => self.fetch_open(Bracket::Curly),
            ']' => self.fetch_close(Bracket::Square),
            '}' => self.fetch_close(Bracket::Curly),
            ',' => {
                self.allow_key = true;
                self.remove_key()?;
                self.push_forward(TokenKind::Comma, 1);
                Ok(())
            }
            '-' if alone => self.fetch_entry(),
            '?' if alone || self.flow > 0 => self.fetch_key(),
            ':' if alone || self.flow > 0 => self.fetch_value(),
            '*' | '&' => {
                self.save_key()?;
                self.allow_key = false;
                let start = self.cursor.mark;
                let kind = self.cursor.scan_anchor()?;
                self.push(kind, start);
                Ok(())
            }
            '!' => {
                self.save_key()?;
                self.allow_key = false;
                let start = self.cursor.mark;
                let kind = self.cursor.scan_tag()?;
                self.push(kind, start);
                Ok(())
            }
            '|' | '>' if self.flow == 0 => {
                self.allow_key = true;
                self.remove_key()?;
                let start = self.cursor.mark;
                let (text, end) = self.cursor.scan_block_scalar(c == '>', self.indent)?;
                self.push_to(TokenKind::Scalar { text, plain: false }, start, end);
                Ok(())
            }
            '\'' | '"' => {
                self.save_key()?;
                self.allow_key = false;
                let start = self.cursor.mark;
                let text = self.cursor.scan_quoted(c == '"')?;
                self.push(TokenKind::Scalar { text, plain: false }, start);
                if self.last.start.line < self.last.end.line {
                    self.long_quote = Some(self.last);
                }
                Ok(())
            }
            _ if self.at_plain(c, alone) => {
                self.save_key()?;
                let start = self.cursor.mark;
                let (text, end, broken) = self.cursor.scan_plain(self.flow > 0, self.indent);
                self.allow_key = broken;
                self.push_to(TokenKind::Scalar { text, plain: true }, start, end);
                Ok(())
            }
            '\t' => Err(self
                .cursor
                .here("found a tab; indent with spaces, never with the tab key")),
            '|' | '>' => Err(self.cursor.here(format!(
                "a text after '{c}' cannot stand within [ ] or {{ }}; put it in quotes"
            ))),
            c => Err(self
                .cursor
                .here(format!("a text that begins with '{c}' needs quotes"))),
        }
    }

    fn at_plain(&self, c: char, alone: bool) -> bool {
        let indicator = matches!(
            c,
            '-' | '?' | ':' | ',' | '[' | ']' | '{' | '}' | '#' | '&' | '*' | '!' | '|' | '>'
        ) || matches!(c, '\'' | '"' | '%' | '@' | '`');
        let block = self.flow == 0 && matches!(c, '?' | ':');
        (!indicator && !is_space(c)) || (!alone && (c == '-' || block))
    }

    /// Skips blanks, comments and line breaks.
    fn skip_to_token(&mut self) {
        loop {
            // Indentation with tabs is a mistake by all rules.
            let tabs = self.tabs && (self.flow > 0 || !self.allow_key);
            self.cursor.skip(|c| c == ' ' || (tabs && c == '\t'));
            if self.cursor.peek(0) == '#' {
                self.cursor.skip(|c| !is_break(c));
            }
            if self.cursor.scan_break().is_none() {
                return;
            }
            if self.flow == 0 {
                self.allow_key = true;
            }
        }
    }

    // Keys that a ':' ends.

    fn without_colon(&self, key: &SimpleKey) -> Mistake {
        let place = key.token.checked_sub(self.taken);
        let token = place.and_then(|place| self.tokens.get(place));
        let span = token.map_or_else(
            || Span {
                start: key.mark,
                end: key.mark,
            },
            |token| token.span,
        );
        match key.mark.line == self.cursor.mark.line && self.cursor.index - key.index > LONGEST_KEY
        {
            true => (span, format!("a key has at most {LONGEST_KEY} characters")),
            false => (span, "the ':' is missing behind this".to_owned()),
        }
    }

    /// A key ends in its line, after 1024 characters at most.
    fn drop_stale_keys(&mut self) -> Result<(), Mistake> {
        let (line, index) = (self.cursor.mark.line, self.cursor.index);
        let stale = |key: &SimpleKey| key.mark.line != line || index - key.index > LONGEST_KEY;
        if let Some(key) = self.keys.values().find(|key| stale(key) && key.required) {
            return Err(self.without_colon(key));
        }
        self.keys.retain(|_, key| !stale(key));
        Ok(())
    }

    fn save_key(&mut self) -> Result<(), Mistake> {
        if self.allow_key {
            self.remove_key()?;
            let key = SimpleKey {
                token: self.taken + self.tokens.len(),
                required: self.flow == 0 && self.indent == self.cursor.mark.column,
                index: self.cursor.index,
                mark: self.cursor.mark,
            };
            self.keys.insert(self.flow, key);
        }
        Ok(())
    }

    fn remove_key(&mut self) -> Result<(), Mistake> {
        match self.keys.remove(&self.flow) {
            Some(key) if key.required => Err(self.without_colon(&key)),
            _ => Ok(()),
        }
    }

    // Indentation.

    /// Ends the blocks that are deeper than this column. Between brackets indentation means nothing.
    fn unwind(&mut self, column: usize) {
        while self.flow == 0 && self.indent > column {
            self.indent = self.indents.pop().unwrap_or(0);
            self.push(TokenKind::BlockEnd, self.cursor.mark);
        }
    }

    /// Begins a block if this column is deeper; returns whether it is.
    fn indents_to(&mut self, column: usize) -> bool {
        let deeper = self.indent < column;
        if deeper {
            self.indents.push(self.indent);
            self.indent = column;
        }
        deeper
    }

    // Tokens.

    fn fetch_end(&mut self) -> Result<(), Mistake> {
        self.unwind(0);
        self.remove_key()?;
        self.allow_key = false;
        self.keys.clear();
        self.push(TokenKind::StreamEnd, self.cursor.mark);
        self.done = true;
        Ok(())
    }

    fn fetch_directive(&mut self) -> Result<(), Mistake> {
        self.unwind(0);
        self.remove_key()?;
        self.allow_key = false;
        let start = self.cursor.mark;
        let directive = self.cursor.scan_directive()?;
        self.push(TokenKind::Directive(directive), start);
        Ok(())
    }

    fn fetch_document_mark(&mut self, kind: TokenKind) -> Result<(), Mistake> {
        self.unwind(0);
        self.remove_key()?;
        self.allow_key = false;
        self.push_forward(kind, 3);
        Ok(())
    }

    fn fetch_open(&mut self, bracket: Bracket) -> Result<(), Mistake> {
        self.save_key()?;
        self.flow += 1;
        self.allow_key = true;
        self.push_forward(TokenKind::Open(bracket), 1);
        Ok(())
    }

    fn fetch_close(&mut self, bracket: Bracket) -> Result<(), Mistake> {
        self.remove_key()?;
        let Some(flow) = self.flow.checked_sub(1) else {
            let open = bracket.open();
            return Err(self.cursor.here(format!(
                "'{}' without a '{open}' before it",
                bracket.close()
            )));
        };
        self.flow = flow;
        self.allow_key = false;
        self.push_forward(TokenKind::Close(bracket), 1);
        Ok(())
    }

    fn fetch_entry(&mut self) -> Result<(), Mistake> {
        if self.flow == 0 {
            if !self.allow_key {
                return Err(self
                    .cursor
                    .here("a list cannot begin here; write each '- ' on its own line"));
            }
            if self.indents_to(self.cursor.mark.column) {
                self.push(TokenKind::ListStart, self.cursor.mark);
            }
        }
        self.allow_key = true;
        self.remove_key()?;
        self.push_forward(TokenKind::Entry, 1);
        Ok(())
    }

    fn fetch_key(&mut self) -> Result<(), Mistake> {
        if self.flow == 0 {
            if !self.allow_key {
                return Err(self
                    .cursor
                    .here("a text that begins with '? ' needs quotes"));
            }
            if self.indents_to(self.cursor.mark.column) {
                self.push(TokenKind::MapStart, self.cursor.mark);
            }
        }
        self.allow_key = self.flow == 0;
        self.remove_key()?;
        self.push_forward(TokenKind::Key, 1);
        Ok(())
    }

    fn fetch_value(&mut self) -> Result<(), Mistake> {
        if let Some(key) = self.keys.remove(&self.flow) {
            let place = key.token - self.taken.min(key.token);
            let place = place.min(self.tokens.len());
            let span = Span {
                start: key.mark,
                end: key.mark,
            };
            let begin = |kind| Token { span, kind };
            self.tokens.insert(place, begin(TokenKind::Key));
            if self.flow == 0 && self.indents_to(key.mark.column) {
                self.tokens.insert(place, begin(TokenKind::MapStart));
            }
            self.allow_key = false;
        } else {
            if self.flow == 0 {
                if !self.allow_key {
                    return Err(self.misplaced_colon());
                }
                if self.indents_to(self.cursor.mark.column) {
                    self.push(TokenKind::MapStart, self.cursor.mark);
                }
            }
            self.allow_key = self.flow == 0;
            self.remove_key()?;
        }
        self.push_forward(TokenKind::Value, 1);
        Ok(())
    }

    /// A ':' that ends no key. The line before may lack its own ':'.
    fn misplaced_colon(&self) -> Mistake {
        match self.last {
            last if last.start.line < self.cursor.mark.line => (
                last,
                "the ':' is missing behind this, or the next line is indented too far".to_owned(),
            ),
            _ => self
                .cursor
                .here("a second ':' in one line; put a text with ': ' in it in quotes"),
        }
    }
}
