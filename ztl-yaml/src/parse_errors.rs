//! Messages about invalid YAML, shown at the cause and not where the parser noticed it.

use crate::node::{Mark, Mistake, Span};
use crate::parser::{Parser, at};
use crate::token::{Bracket, TokenKind};

impl Parser {
    /// Expects the ',' between two values. If the next one is on another line, the bracket was probably meant
    /// to end before.
    pub(crate) fn comma(&mut self, open: Span, bracket: Bracket) -> Result<(), Mistake> {
        if self.takes(&TokenKind::Comma)? {
            return Ok(());
        }
        let (sign, close) = (bracket.open(), bracket.close());
        let (last, quoted) = self.last;
        // A text without quotes may have swallowed the next line.
        let ends = if quoted { last.end } else { last.start };
        let next = self.span()?;
        Err(match self.peek()? {
            TokenKind::StreamEnd | TokenKind::DocumentStart | TokenKind::DocumentEnd => {
                never_closed(open, bracket)
            }
            TokenKind::Close(other) => {
                let line = open.start.line;
                let message = format!(
                    "expected '{close}' for the '{sign}' in line {line}, found '{}'",
                    other.close()
                );
                at(next, message)
            }
            _ if ends.line < next.start.line => at(
                open,
                format!(
                    "this '{sign}' is not closed, or a ',' is missing before line {}",
                    next.start.line
                ),
            ),
            TokenKind::Value => at(next, "a second ':'; put a text with ': ' in it in quotes"),
            _ if quoted => behind_quotes(next),
            _ => at(next, format!("expected ',' or '{close}' before this")),
        })
    }

    /// The message where a value was expected.
    pub(crate) fn no_value(&mut self) -> Result<Mistake, Mistake> {
        let span = self.span()?;
        let message = match self.peek()? {
            TokenKind::Close(bracket) => format!(
                "'{}' without a '{}' before it",
                bracket.close(),
                bracket.open()
            ),
            TokenKind::Comma => "a value is missing before this ','".to_owned(),
            TokenKind::Entry => {
                "a '- ' cannot stand between brackets; separate the values by ','".to_owned()
            }
            TokenKind::StreamEnd | TokenKind::DocumentStart | TokenKind::DocumentEnd => {
                "a value is missing at the end".to_owned()
            }
            _ => "a value is missing before this".to_owned(),
        };
        Ok(at(span, message))
    }

    /// The message about something that does not belong to the block that began at `start`.
    pub(crate) fn unexpected(&mut self, start: Mark) -> Result<Mistake, Mistake> {
        let (last, quoted) = self.last;
        let span = self.span()?;
        let same_line = last.end.line == span.start.line;
        Ok(match self.peek()? {
            TokenKind::Close(_) => self.no_value()?,
            TokenKind::Value => at(span, "a key is missing before this ':'"),
            TokenKind::Comma => at(
                span,
                "a ',' behind a text in quotes; put all of it in quotes",
            ),
            _ if same_line && quoted => behind_quotes(span),
            _ if same_line => at(
                span,
                "this belongs to nothing; a ',' or quotes may be missing",
            ),
            _ => at(
                span,
                format!(
                    "this line begins in column {}, and what it belongs to in column {} (line {})",
                    span.start.column, start.column, start.line
                ),
            ),
        })
    }
}

pub(crate) fn never_closed(open: Span, bracket: Bracket) -> Mistake {
    at(open, format!("this '{}' is never closed", bracket.open()))
}

fn behind_quotes(span: Span) -> Mistake {
    let message = "a text behind the closing quote; within '…' write an apostrophe as ''";
    at(span, message)
}
