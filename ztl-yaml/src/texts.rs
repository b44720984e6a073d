//! Texts, names, tags and directives: the content of tokens.

use crate::cursor::{Cursor, is_break, is_line_break, is_space};
use crate::node::{Mark, Mistake, Span};
use crate::token::{Directive, TokenKind};

const fn is_name(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '-' | '_')
}

impl Cursor {
    /// The number of characters of this kind that come next.
    fn count(&self, is: impl Fn(char) -> bool) -> usize {
        (0..).take_while(|ahead| is(self.peek(*ahead))).count()
    }

    fn take_name(&mut self) -> String {
        self.take(self.count(is_name))
    }

    /// `*name`, `&name`.
    pub(crate) fn scan_anchor(&mut self) -> Result<TokenKind, Mistake> {
        let start = self.mark;
        let sign = self.peek(0);
        self.forward(1);
        let name = self.take_name();
        let c = self.peek(0);
        if name.is_empty() || !(is_space(c) || "?:,]}%@`".contains(c)) {
            let end = self.mark;
            let message = format!("a text that begins with '{sign}' needs quotes");
            return Err((Span { start, end }, message));
        }
        Ok(match sign {
            '*' => TokenKind::Alias(name),
            _ => TokenKind::Anchor(name),
        })
    }

    /// `!`, `!name`, `!handle!name`, `!<uri>`.
    pub(crate) fn scan_tag(&mut self) -> Result<TokenKind, Mistake> {
        let start = self.mark;
        let kind = match self.peek(1) {
            '<' => {
                self.forward(2);
                let suffix = self.scan_uri(start)?;
                if self.peek(0) != '>' {
                    return Err(self.not_a_tag(start));
                }
                self.forward(1);
                TokenKind::Tag(None, suffix)
            }
            c if is_space(c) => {
                self.forward(1);
                TokenKind::Tag(None, "!".to_owned())
            }
            _ => {
                let rest = 1 + self.count_from(1, |c| c != '!' && c != ' ' && !is_break(c));
                let handle = match self.peek(rest) {
                    '!' => self.scan_handle(start)?,
                    _ => self.take(1),
                };
                TokenKind::Tag(Some(handle), self.scan_uri(start)?)
            }
        };
        match self.peek(0) {
            c if c == ' ' || is_break(c) => Ok(kind),
            _ => Err(self.not_a_tag(start)),
        }
    }

    fn count_from(&self, from: usize, is: impl Fn(char) -> bool) -> usize {
        (from..).take_while(|ahead| is(self.peek(*ahead))).count()
    }

    fn not_a_tag(&self, start: Mark) -> Mistake {
        let end = self.mark;
        let message = "a text that begins with '!' needs quotes".to_owned();
        (Span { start, end }, message)
    }

    fn scan_handle(&mut self, start: Mark) -> Result<String, Mistake> {
        if self.peek(0) != '!' {
            return Err(self.not_a_tag(start));
        }
        let len = 1 + self.count_from(1, is_name);
        match self.peek(len) {
            ' ' if len == 1 => Ok(self.take(1)),
            '!' => Ok(self.take(len + 1)),
            _ => Err(self.not_a_tag(start)),
        }
    }

    fn scan_uri(&mut self, start: Mark) -> Result<String, Mistake> {
        let is_uri = |c: char| is_name(c) || (c != '\0' && ";/?:@&=+$,.!~*'()[]".contains(c));
        let mut uri = String::new();
        loop {
            uri += &self.take(self.count(is_uri));
            if self.peek(0) != '%' {
                break;
            }
            let mut bytes = Vec::new();
            while self.peek(0) == '%' {
                let digits: String = self.ahead(3).iter().skip(1).collect();
                let byte = u8::from_str_radix(&digits, 16).ok();
                let hex = digits.len() == 2 && digits.bytes().all(|c| c.is_ascii_hexdigit());
                bytes.push(byte.filter(|_| hex).ok_or_else(|| self.not_a_tag(start))?);
                self.forward(3);
            }
            uri += &String::from_utf8(bytes).map_err(|_| self.not_a_tag(start))?;
        }
        match uri.is_empty() {
            true => Err(self.not_a_tag(start)),
            false => Ok(uri),
        }
    }

    /// `%YAML 1.1`, `%TAG !name! prefix`, or another, which means nothing.
    pub(crate) fn scan_directive(&mut self) -> Result<Directive, Mistake> {
        let start = self.mark;
        self.forward(1);
        let name = self.take_name();
        let wrong = |cursor: &Self| {
            let end = cursor.mark;
            let message = "a line that begins with '%' is a directive of YAML, as %YAML 1.1; put a text in quotes";
            (Span { start, end }, message.to_owned())
        };
        if name.is_empty() || !(self.peek(0) == ' ' || is_break(self.peek(0))) {
            return Err(wrong(self));
        }
        let directive = match name.as_str() {
            "YAML" => {
                self.skip(|c| c == ' ');
                let major = self.take(self.count(|c| c.is_ascii_digit()));
                let point = self.take(1);
                let minor = self.take(self.count(|c| c.is_ascii_digit()));
                if major.is_empty() || point != "." || minor.is_empty() {
                    return Err(wrong(self));
                }
                Directive::Yaml(major.trim_start_matches('0') == "1")
            }
            "TAG" => {
                self.skip(|c| c == ' ');
                let handle = self.scan_handle(start)?;
                if self.peek(0) != ' ' {
                    return Err(wrong(self));
                }
                self.skip(|c| c == ' ');
                Directive::Tag(handle, self.scan_uri(start)?)
            }
            _ => {
                self.skip(|c| !is_break(c));
                Directive::Other
            }
        };
        if !(self.peek(0) == ' ' || is_break(self.peek(0))) || !self.skip_line() {
            return Err(wrong(self));
        }
        Ok(directive)
    }

    /// Skips blanks, a comment and the end of the line; returns whether nothing else is there.
    fn skip_line(&mut self) -> bool {
        self.skip(|c| c == ' ');
        if self.peek(0) == '#' {
            self.skip(|c| !is_break(c));
        }
        let ends = is_break(self.peek(0));
        self.scan_break();
        ends
    }

    /// A text after `|` or `>`, and its end.
    /// `indent`: column of the block around it.
    pub(crate) fn scan_block_scalar(
        &mut self,
        folded: bool,
        indent: usize,
    ) -> Result<(String, Mark), Mistake> {
        let sign = self.peek(0);
        let place = self.here(format!(
            "the text of '{sign}' begins in the next line; put one that begins with '{sign}' in quotes"
        ));
        self.forward(1);
        let (mut keep, mut increment) = (None, None);
        // In either order, each at most once.
        for _ in 0..2 {
            match self.peek(0) {
                c @ ('+' | '-') if keep.is_none() => keep = Some(c == '+'),
                c @ '1'..='9' if increment.is_none() => {
                    increment = c.to_digit(10).and_then(|c| usize::try_from(c).ok());
                }
                _ => break,
            }
            self.forward(1);
        }
        let blank = self.peek(0) == ' ' || is_break(self.peek(0));
        if !blank || !self.skip_line() {
            return Err(place);
        }
        // In blanks before the text.
        let least = indent.max(1);
        let (mut breaks, mut end, indent) = match increment {
            None => {
                let (breaks, deepest, end) = self.scan_indentation();
                (breaks, end, least.max(deepest))
            }
            Some(increment) => {
                let indent = least + increment - 1;
                let (breaks, end) = self.scan_breaks(indent);
                (breaks, end, indent)
            }
        };
        let mut text = String::new();
        let mut line_break = None;
        while self.mark.column == indent + 1 && self.peek(0) != '\0' {
            text += &breaks;
            let leading = matches!(self.peek(0), ' ' | '\t');
            text += &self.take(self.count(|c| !is_break(c)));
            line_break = self.scan_break();
            (breaks, end) = self.scan_breaks(indent);
            if self.mark.column != indent + 1 || self.peek(0) == '\0' {
                break;
            }
            let folds = folded && line_break == Some('\n');
            match folds && !leading && !matches!(self.peek(0), ' ' | '\t') {
                true if breaks.is_empty() => text.push(' '),
                true => {}
                false => text.extend(line_break),
            }
        }
        if keep != Some(false) {
            text.extend(line_break);
        }
        if keep == Some(true) {
            text += &breaks;
        }
        Ok((text, end))
    }

    /// Empty lines before a text, the indentation of its first line, and their end.
    fn scan_indentation(&mut self) -> (String, usize, Mark) {
        let (mut breaks, mut deepest, mut end) = (String::new(), 0, self.mark);
        loop {
            if self.peek(0) == ' ' {
                self.forward(1);
                deepest = deepest.max(self.mark.column - 1);
            } else if let Some(c) = self.scan_break() {
                breaks.push(c);
                end = self.mark;
            } else {
                return (breaks, deepest, end);
            }
        }
    }

    /// Empty lines within a text.
    fn scan_breaks(&mut self, indent: usize) -> (String, Mark) {
        let (mut breaks, mut end) = (String::new(), self.mark);
        loop {
            while self.mark.column <= indent && self.peek(0) == ' ' {
                self.forward(1);
            }
            match self.scan_break() {
                Some(c) => breaks.push(c),
                None => return (breaks, end),
            }
            end = self.mark;
        }
    }

    /// A text in quotes.
    pub(crate) fn scan_quoted(&mut self, double: bool) -> Result<String, Mistake> {
        let start = self.mark;
        let quote = self.peek(0);
        self.forward(1);
        let mut text = String::new();
        loop {
            text += &self.take(self.count(|c| !(is_space(c) || matches!(c, '\'' | '"' | '\\'))));
            match self.peek(0) {
                '\'' if !double && self.peek(1) == '\'' => {
                    text.push('\'');
                    self.forward(2);
                }
                c if c == quote => {
                    self.forward(1);
                    return Ok(text);
                }
                '\\' if double => self.scan_escape(&mut text)?,
                c @ ('\'' | '"' | '\\') => {
                    text.push(c);
                    self.forward(1);
                }
                '\0' => return Err(self.never_closed(start)),
                _ => self.scan_quoted_spaces(&mut text)?,
            }
        }
    }

    fn never_closed(&self, start: Mark) -> Mistake {
        let end = Mark {
            column: start.column + 1,
            ..start
        };
        let message = "this quote is never closed".to_owned();
        (Span { start, end }, message)
    }

    fn scan_quoted_spaces(&mut self, text: &mut String) -> Result<(), Mistake> {
        let blanks = self.take(self.count(|c| matches!(c, ' ' | '\t')));
        let Some(line_break) = self.scan_break() else {
            *text += &blanks;
            return Ok(());
        };
        let breaks = self.scan_quoted_breaks()?;
        match line_break {
            '\n' if breaks.is_empty() => text.push(' '),
            '\n' => {}
            other => text.push(other),
        }
        *text += &breaks;
        Ok(())
    }

    /// Empty lines, and the blanks before what follows.
    fn scan_quoted_breaks(&mut self) -> Result<String, Mistake> {
        let mut breaks = String::new();
        loop {
            if self.at_document_mark() {
                return Err(self.here("a line '---' or '...' ends the document within quotes"));
            }
            self.skip(|c| matches!(c, ' ' | '\t'));
            match self.scan_break() {
                Some(c) => breaks.push(c),
                None => return Ok(breaks),
            }
        }
    }

    fn scan_escape(&mut self, text: &mut String) -> Result<(), Mistake> {
        let wrong =
            self.here("unknown escape in \"…\"; write a backslash as \\\\, or put the text in '…'");
        self.forward(1);
        let c = self.peek(0);
        let meant = match c {
            '0' => '\0',
            'a' => '\u{7}',
            'b' => '\u{8}',
            't' | '\t' => '\t',
            'n' => '\n',
            'v' => '\u{b}',
            'f' => '\u{c}',
            'r' => '\r',
            'e' => '\u{1b}',
            ' ' | '"' | '\\' | '/' => c,
            'N' => '\u{85}',
            '_' => '\u{a0}',
            'L' => '\u{2028}',
            'P' => '\u{2029}',
            'x' => return self.scan_code(2, wrong, text),
            'u' => return self.scan_code(4, wrong, text),
            'U' => return self.scan_code(8, wrong, text),
            c if is_line_break(c) => {
                self.scan_break();
                *text += &self.scan_quoted_breaks()?;
                return Ok(());
            }
            _ => return Err(wrong),
        };
        text.push(meant);
        self.forward(1);
        Ok(())
    }

    /// Hexadecimal digits of a character.
    fn scan_code(&mut self, len: usize, wrong: Mistake, text: &mut String) -> Result<(), Mistake> {
        self.forward(1);
        let digits: String = self.ahead(len).iter().collect();
        let hex = digits.len() == len && digits.bytes().all(|c| c.is_ascii_hexdigit());
        if !hex {
            let message = format!("expected {len} hexadecimal digits after this");
            return Err((wrong.0, message));
        }
        let code = u32::from_str_radix(&digits, 16).ok();
        let Some(c) = code.and_then(char::from_u32) else {
            return Err((wrong.0, "there is no such character".to_owned()));
        };
        text.push(c);
        self.forward(len);
        Ok(())
    }

    /// A text without quotes, its end, and whether a line break follows it. `flow`: it is between brackets;
    /// `indent`: column of the block around it.
    pub(crate) fn scan_plain(&mut self, flow: bool, indent: usize) -> (String, Mark, bool) {
        let (mut text, mut blanks, mut end) = (String::new(), String::new(), self.mark);
        let mut broken = false;
        let ends = |cursor: &Self, ahead: usize| {
            let (c, next) = (cursor.peek(ahead), cursor.peek(ahead + 1));
            is_space(c)
                || (c == ':' && (is_space(next) || (flow && ",[]{}".contains(next))))
                || (flow && ",?[]{}".contains(c))
        };
        while self.peek(0) != '#' {
            let len = (0..).take_while(|ahead| !ends(self, *ahead)).count();
            if len == 0 {
                break;
            }
            text += &blanks;
            text += &self.take(len);
            end = self.mark;
            (blanks, broken) = self.scan_plain_spaces();
            let left = !flow && self.mark.column <= indent;
            if blanks.is_empty() || left {
                break;
            }
        }
        (text, end, broken)
    }

    /// The text that blanks and line breaks in a text without quotes stand for, empty at its end; and
    /// whether there was a line break.
    fn scan_plain_spaces(&mut self) -> (String, bool) {
        let blanks = self.take(self.count(|c| c == ' '));
        let Some(line_break) = self.scan_break() else {
            return (blanks, false);
        };
        let mut breaks = String::new();
        loop {
            if self.at_document_mark() {
                return (String::new(), true);
            }
            self.skip(|c| c == ' ');
            match self.scan_break() {
                Some(c) => breaks.push(c),
                None => break,
            }
        }
        let blanks = match line_break {
            '\n' if breaks.is_empty() => " ".to_owned(),
            '\n' => breaks,
            other => format!("{other}{breaks}"),
        };
        (blanks, true)
    }
}
