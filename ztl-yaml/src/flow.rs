//! Collections between brackets.

use super::explain::never_closed;
use super::token::{Bracket, Kind};
use super::tree::{Parser, point};
use super::{Mistake, Node, Span, Value};

impl Parser {
    pub(super) fn square(&mut self) -> Result<Value, Mistake> {
        let open = self.next()?.span;
        let bracket = Bracket::Square;
        let mut items = Vec::new();
        while !self.takes(&Kind::Close(bracket))? {
            if !items.is_empty() {
                self.comma(open, bracket)?;
                if self.takes(&Kind::Close(bracket))? {
                    break;
                }
            }
            let item = match self.peek()? {
                // A mapping of one key, without its own brackets.
                Kind::Key => {
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
        Ok(Value::List(items))
    }

    pub(super) fn curly(&mut self) -> Result<Value, Mistake> {
        let open = self.next()?.span;
        let bracket = Bracket::Curly;
        let mut pairs = Vec::new();
        while !self.takes(&Kind::Close(bracket))? {
            if !pairs.is_empty() {
                self.comma(open, bracket)?;
                if self.takes(&Kind::Close(bracket))? {
                    break;
                }
            }
            let pair = match self.peek()? {
                Kind::Key => self.pair(open, bracket)?,
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
            Kind::StreamEnd | Kind::DocumentStart | Kind::DocumentEnd => {
                Err(never_closed(open, bracket))
            }
            _ => self.node(false, false),
        }
    }

    /// `key: value`, `? key : value`, `? key` or `: value` between brackets.
    fn pair(&mut self, open: Span, bracket: Bracket) -> Result<(Node, Node), Mistake> {
        let end = self.next()?.span.end;
        let ends = |kind: &Kind| *kind == Kind::Comma || *kind == Kind::Close(bracket);
        let key = match self.peek()? {
            kind if ends(kind) || *kind == Kind::Value => self.empty(point(end))?,
            _ => self.flow_node(open, bracket)?,
        };
        if *self.peek()? != Kind::Value {
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
