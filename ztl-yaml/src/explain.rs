//! What is wrong where a text is invalid YAML: shown at its cause, not where the reader noticed it.

use super::token::{Bracket, Kind};
use super::tree::{Parser, at};
use super::{Mark, Mistake, Span};

impl Parser {
    /// The ',' between two values. Where the next one stands in another line, the bracket was probably
    /// meant to end before.
    pub(super) fn comma(&mut self, open: Span, bracket: Bracket) -> Result<(), Mistake> {
        if self.takes(&Kind::Comma)? {
            return Ok(());
        }
        let (sign, close) = (bracket.open(), bracket.close());
        let (last, quoted) = self.last;
        let next = self.span()?;
        Err(match self.peek()? {
            Kind::StreamEnd | Kind::DocumentStart | Kind::DocumentEnd => {
                never_closed(open, bracket)
            }
            Kind::Close(other) => {
                let line = open.start.line;
                let message = format!(
                    "expected '{close}' for the '{sign}' in line {line}, found '{}'",
                    other.close()
                );
                at(next, message)
            }
            _ if last.start.line < next.start.line => at(
                open,
                format!(
                    "this '{sign}' is not closed, or a ',' is missing before line {}",
                    next.start.line
                ),
            ),
            Kind::Value => at(next, "a second ':'; put a text with ': ' in it in quotes"),
            _ if quoted => behind_quotes(next),
            _ => at(next, format!("expected ',' or '{close}' before this")),
        })
    }

    /// A value was expected.
    pub(super) fn no_value(&mut self) -> Result<Mistake, Mistake> {
        let span = self.span()?;
        let message = match self.peek()? {
            Kind::Close(bracket) => format!(
                "'{}' without a '{}' before it",
                bracket.close(),
                bracket.open()
            ),
            Kind::Comma => "a value is missing before this ','".to_owned(),
            Kind::Entry => {
                "a '- ' cannot stand between brackets; separate the values by ','".to_owned()
            }
            Kind::StreamEnd | Kind::DocumentStart | Kind::DocumentEnd => {
                "a value is missing at the end".to_owned()
            }
            _ => "a value is missing before this".to_owned(),
        };
        Ok(at(span, message))
    }

    /// Something that does not belong to the block that began at `start`.
    pub(super) fn unexpected(&mut self, start: Mark) -> Result<Mistake, Mistake> {
        let (last, quoted) = self.last;
        let span = self.span()?;
        let same_line = last.end.line == span.start.line;
        Ok(match self.peek()? {
            Kind::Close(_) => self.no_value()?,
            Kind::Value => at(span, "a key is missing before this ':'"),
            Kind::Comma => at(
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

pub(super) fn never_closed(open: Span, bracket: Bracket) -> Mistake {
    at(open, format!("this '{}' is never closed", bracket.open()))
}

fn behind_quotes(span: Span) -> Mistake {
    let message = "a text behind the closing quote; within '…' write an apostrophe as ''";
    at(span, message)
}
