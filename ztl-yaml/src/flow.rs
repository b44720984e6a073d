//! Collections between brackets.

use crate::node::{Mistake, Node, NodeValue, Span};
use crate::parse_errors::never_closed;
use crate::parser::{Parser, point};
use crate::token::{Bracket, TokenKind};

impl Parser {
    pub(crate) fn square(&mut self) -> Result<NodeValue, Mistake> {
        let open = self.next()?.span;
        let bracket = Bracket::Square;
        let mut items = Vec::new();
        while !self.takes(&TokenKind::Close(bracket))? {
            if !items.is_empty() {
                self.comma(open, bracket)?;
                if self.takes(&TokenKind::Close(bracket))? {
                    break;
                }
            }
            let item = match self.peek()? {
                // A mapping of one key, without its own brackets.
                TokenKind::Key => {
                    let span = self.span()?;
                    self.counted(1, span)?;
                    self.nested(span, |parser| {
                        let pair = parser.pair(open, bracket)?;
                        Ok(parser.map(vec![pair]))
                    })?
                }
                _ => self.flow_node(open, bracket)?,
            };
            items.push(item);
        }
        Ok(NodeValue::List(items))
    }

    pub(crate) fn curly(&mut self) -> Result<NodeValue, Mistake> {
        let open = self.next()?.span;
        let bracket = Bracket::Curly;
        let mut pairs = Vec::new();
        while !self.takes(&TokenKind::Close(bracket))? {
            if !pairs.is_empty() {
                self.comma(open, bracket)?;
                if self.takes(&TokenKind::Close(bracket))? {
                    break;
                }
            }
            let pair = match self.peek()? {
                TokenKind::Key => self.pair(open, bracket)?,
                _ => {
                    let key = self.flow_node(open, bracket)?;
                    let value = self.empty(key.span)?;
                    (key, value)
                }
            };
            pairs.push(pair);
        }
        Ok(self.map(pairs))
    }

    /// A value between brackets.
    fn flow_node(&mut self, open: Span, bracket: Bracket) -> Result<Node, Mistake> {
        match self.peek()? {
            TokenKind::StreamEnd | TokenKind::DocumentStart | TokenKind::DocumentEnd => {
                Err(never_closed(open, bracket))
            }
            _ => self.node(false, false),
        }
    }

    /// `key: value`, `? key : value`, `? key` or `: value` between brackets.
    fn pair(&mut self, open: Span, bracket: Bracket) -> Result<(Node, Node), Mistake> {
        let end = self.next()?.span.end;
        let ends =
            |kind: &TokenKind| *kind == TokenKind::Comma || *kind == TokenKind::Close(bracket);
        let key = match self.peek()? {
            kind if ends(kind) || *kind == TokenKind::Value => self.empty(point(end))?,
            _ => self.flow_node(open, bracket)?,
        };
        if *self.peek()? != TokenKind::Value {
            let value = self.empty(key.span)?;
            return Ok((key, value));
        }
        let end = self.next()?.span.end;
        let value = match ends(self.peek()?) {
            true => self.empty(point(end))?,
            false => self.flow_node(open, bracket)?,
        };
        Ok((key, value))
    }
}
