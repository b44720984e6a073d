//! From tokens to a tree of nodes, by the rules of PyYAML's parser and composer.

use std::collections::{HashMap, HashSet};

use crate::merge;
use crate::node::{CORE, Mark, Mistake, Node, NodeValue, Rules, Span};
use crate::open_quote::cause_of;
use crate::scanner::Scanner;
use crate::token::{Bracket, Directive, Token, TokenKind};

/// Deepest nesting.
const DEPTH: usize = 64;
/// Most values, including those repeated by `*alias`.
const NODES: usize = 100_000;

/// What `&name` stands for.
struct Anchor {
    place: Mark,
    /// Number of values in it.
    count: usize,
    /// `None` while its collection is open.
    node: Option<Node>,
}

pub(crate) struct Parser {
    scanner: Scanner,
    rules: Rules,
    /// What `!`, `!!` and `!name!` stand for.
    handles: HashMap<String, String>,
    anchors: HashMap<String, Anchor>,
    depth: usize,
    count: usize,
    /// Place of the last token, and whether it was a text in quotes.
    pub(crate) last: (Span, bool),
    mistakes: Vec<Mistake>,
}

/// `&name` and `!tag` in front of a value.
#[derive(Default)]
struct Properties {
    anchor: Option<(String, Mark)>,
    tag: Option<String>,
    span: Option<Span>,
}

/// The tree, if there is one, and the mistakes.
pub(crate) fn parse(text: &str, rules: Rules) -> (Option<Node>, Vec<Mistake>) {
    let mut parser = Parser {
        scanner: Scanner::new(text, rules),
        rules,
        handles: HashMap::new(),
        anchors: HashMap::new(),
        depth: 0,
        count: 0,
        last: (Span::default(), false),
        mistakes: Vec::new(),
    };
    match parser.stream() {
        // An empty configuration is a mapping without keys.
        Ok(root) if rules == Rules::Strict && root.is_null() => {
            let value = NodeValue::Map(Vec::new());
            (Some(Node { value, ..root }), parser.mistakes)
        }
        Ok(root) => (Some(root), parser.mistakes),
        Err(mistake) => {
            let mistake = cause_of(mistake, parser.scanner.long_quote);
            parser.mistakes.push(mistake);
            (None, parser.mistakes)
        }
    }
}

pub(crate) fn at(span: Span, message: impl Into<String>) -> Mistake {
    (span, message.into())
}

pub(crate) const fn point(mark: Mark) -> Span {
    Span {
        start: mark,
        end: mark,
    }
}

/// Nothing is written; where a key has no ':' it stands at the key.
const fn nothing(span: Span) -> Node {
    let text = String::new();
    Node {
        span,
        value: NodeValue::Scalar { text, plain: true },
        tag: None,
    }
}

impl Parser {
    pub(crate) fn peek(&mut self) -> Result<&TokenKind, Mistake> {
        Ok(&self.scanner.peek_token()?.kind)
    }

    pub(crate) fn span(&mut self) -> Result<Span, Mistake> {
        Ok(self.scanner.peek_token()?.span)
    }

    pub(crate) fn next(&mut self) -> Result<Token, Mistake> {
        let token = self.scanner.token()?;
        let quoted = matches!(token.kind, TokenKind::Scalar { plain: false, .. });
        // Skip tokens without text, which indentation makes.
        if token.span.start < token.span.end {
            self.last = (token.span, quoted);
        }
        Ok(token)
    }

    /// Takes the next token if it is this one.
    pub(crate) fn takes(&mut self, kind: &TokenKind) -> Result<bool, Mistake> {
        let is = self.peek()? == kind;
        if is {
            self.next()?;
        }
        Ok(is)
    }

    fn stream(&mut self) -> Result<Node, Mistake> {
        let explicit = matches!(
            self.peek()?,
            TokenKind::Directive(_) | TokenKind::DocumentStart | TokenKind::StreamEnd
        );
        if explicit {
            let start = self.span()?.start;
            if *self.peek()? == TokenKind::StreamEnd {
                return Ok(nothing(point(start)));
            }
            self.directives()?;
        }
        for (handle, prefix) in [("!", "!"), ("!!", CORE)] {
            let entry = self.handles.entry(handle.to_owned());
            entry.or_insert_with(|| prefix.to_owned());
        }
        let start = self.span()?;
        let root = match self.peek()? {
            TokenKind::Directive(_)
            | TokenKind::DocumentStart
            | TokenKind::DocumentEnd
            | TokenKind::StreamEnd
                if explicit =>
            {
                nothing(start)
            }
            _ => self.node(true, false)?,
        };
        let mut ended = self.takes(&TokenKind::DocumentEnd)?;
        while ended && self.takes(&TokenKind::DocumentEnd)? {}
        ended |= *self.peek()? == TokenKind::DocumentStart;
        match self.peek()? {
            TokenKind::StreamEnd => Ok(root),
            _ if ended => Err(at(
                self.span()?,
                "a second document begins; use one file for each",
            )),
            _ => Err(self.unexpected(root.span.start)?),
        }
    }

    /// `%YAML`, `%TAG`, and the `---` behind them.
    fn directives(&mut self) -> Result<(), Mistake> {
        let mut version = false;
        while let TokenKind::Directive(directive) = self.peek()?.clone() {
            let span = self.next()?.span;
            match directive {
                Directive::Yaml(_) if version => {
                    return Err(at(span, "the version is given twice"));
                }
                Directive::Yaml(false) => {
                    return Err(at(span, "the version of YAML is 1.1 or 1.2"));
                }
                Directive::Yaml(true) => version = true,
                Directive::Tag(handle, prefix) => {
                    if self.handles.insert(handle, prefix).is_some() {
                        return Err(at(span, "this handle is defined twice"));
                    }
                }
                Directive::Other => {}
            }
        }
        match self.takes(&TokenKind::DocumentStart)? {
            true => Ok(()),
            false => Err(at(self.span()?, "a line '---' is missing before this")),
        }
    }

    /// A value. `block`: indentation may make it a collection; `list`: its `- ` may be as far left as its
    /// key.
    pub(crate) fn node(&mut self, block: bool, list: bool) -> Result<Node, Mistake> {
        if let TokenKind::Alias(name) = self.peek()? {
            let name = name.clone();
            let span = self.next()?.span;
            return self.alias(&name, span);
        }
        let properties = self.properties()?;
        let before = self.count;
        let span = self.span()?;
        let anchor = properties.anchor.clone();
        if let Some((name, place)) = &anchor {
            let anchor = Anchor {
                place: *place,
                count: 0,
                node: None,
            };
            if let Some(first) = self.anchors.insert(name.clone(), anchor) {
                let line = first.place.line;
                let message = format!("'&{name}' stands for something else since line {line}");
                return Err(at(point(*place), message));
            }
        }
        let mut node = match self.peek()? {
            TokenKind::Entry if list => self.nested(span, |parser| parser.list_entries(None))?,
            TokenKind::Scalar { .. } => {
                let Token { span, kind } = self.next()?;
                let TokenKind::Scalar { text, plain } = kind else {
                    return Err(at(span, "expected a text"));
                };
                Node {
                    span,
                    value: NodeValue::Scalar { text, plain },
                    tag: None,
                }
            }
            TokenKind::Open(Bracket::Square) => self.nested(span, Self::square)?,
            TokenKind::Open(Bracket::Curly) => self.nested(span, Self::curly)?,
            TokenKind::ListStart if block => {
                self.nested(span, |parser| parser.list_entries(Some(span.start)))?
            }
            TokenKind::MapStart if block => {
                self.nested(span, |parser| parser.map_entries(span.start))?
            }
            _ => match properties.span {
                Some(span) => nothing(point(span.end)),
                None => return Err(self.no_value()?),
            },
        };
        node.tag = self.tag(properties)?;
        self.counted(1, node.span)?;
        if let Some((name, _)) = anchor
            && let Some(anchor) = self.anchors.get_mut(&name)
        {
            anchor.count = self.count - before;
            anchor.node = Some(node.clone());
        }
        Ok(node)
    }

    /// Reads a collection that begins at `span`.
    pub(crate) fn nested(
        &mut self,
        span: Span,
        read: impl FnOnce(&mut Self) -> Result<NodeValue, Mistake>,
    ) -> Result<Node, Mistake> {
        if self.depth >= DEPTH {
            return Err(at(span, format!("nested deeper than {DEPTH}")));
        }
        self.depth += 1;
        let value = read(self)?;
        self.depth -= 1;
        let (start, end) = (span.start, self.last.0.end);
        Ok(Node {
            span: Span { start, end },
            value,
            tag: None,
        })
    }

    pub(crate) fn counted(&mut self, more: usize, span: Span) -> Result<(), Mistake> {
        self.count += more;
        match self.count > NODES {
            true => Err(at(span, format!("more than {NODES} values"))),
            false => Ok(()),
        }
    }

    fn alias(&mut self, name: &str, span: Span) -> Result<Node, Mistake> {
        let Some(anchor) = self.anchors.get(name) else {
            let message = format!(
                "there is no '&{name}' before this; a text that begins with '*' needs quotes"
            );
            return Err(at(span, message));
        };
        let Some(node) = anchor.node.clone() else {
            return Err(at(span, format!("'*{name}' stands within itself")));
        };
        let count = anchor.count;
        self.counted(count, span)?;
        Ok(Node { span, ..node })
    }

    fn properties(&mut self) -> Result<Properties, Mistake> {
        let mut found = Properties::default();
        loop {
            match self.peek()?.clone() {
                TokenKind::Anchor(name) if found.anchor.is_none() => {
                    found.anchor = Some((name, self.span()?.start));
                }
                TokenKind::Tag(handle, suffix) if found.tag.is_none() => {
                    let prefix = match handle {
                        None => "",
                        Some(handle) => match self.handles.get(&handle) {
                            Some(prefix) => prefix,
                            None => {
                                let message = format!(
                                    "the tag '{handle}{suffix}' is not known; leave it out"
                                );
                                return Err(at(self.span()?, message));
                            }
                        },
                    };
                    found.tag = Some(format!("{prefix}{suffix}"));
                }
                _ => return Ok(found),
            }
            let span = self.next()?.span;
            let start = found.span.map_or(span.start, |span| span.start);
            let end = span.end;
            found.span = Some(Span { start, end });
        }
    }

    /// By [`Rules::Strict`] a tag other than YAML's own is a mistake.
    fn tag(&self, properties: Properties) -> Result<Option<String>, Mistake> {
        match (properties.tag, properties.span) {
            (Some(tag), Some(span)) if self.rules == Rules::Strict && !tag.starts_with(CORE) => {
                let message = format!("the tag '{tag}' is not known here; leave it out");
                Err(at(span, message))
            }
            (tag, _) => Ok(tag),
        }
    }

    /// `- a`, `- b`; without a block of their own if they are as far left as their key.
    fn list_entries(&mut self, block: Option<Mark>) -> Result<NodeValue, Mistake> {
        if block.is_some() {
            self.next()?;
        }
        let mut items = Vec::new();
        while *self.peek()? == TokenKind::Entry {
            let end = self.next()?.span.end;
            let empty = match self.peek()? {
                TokenKind::Entry | TokenKind::BlockEnd => true,
                TokenKind::Key | TokenKind::Value => block.is_none(),
                _ => false,
            };
            let item = match empty {
                true => self.empty(point(end))?,
                false => self.node(true, false)?,
            };
            items.push(item);
        }
        if let Some(start) = block
            && !self.takes(&TokenKind::BlockEnd)?
        {
            return Err(self.unexpected(start)?);
        }
        Ok(NodeValue::List(items))
    }

    pub(crate) fn empty(&mut self, span: Span) -> Result<Node, Mistake> {
        self.counted(1, span)?;
        Ok(nothing(span))
    }

    fn map_entries(&mut self, start: Mark) -> Result<NodeValue, Mistake> {
        self.next()?;
        let mut pairs = Vec::new();
        let ends = |kind: &TokenKind| {
            matches!(
                kind,
                TokenKind::Key | TokenKind::Value | TokenKind::BlockEnd
            )
        };
        loop {
            // A value may lack its key.
            let key = match self.peek()? {
                TokenKind::Key => {
                    let end = self.next()?.span.end;
                    match ends(self.peek()?) {
                        true => self.empty(point(end))?,
                        false => self.node(true, true)?,
                    }
                }
                TokenKind::BlockEnd => break,
                _ => return Err(self.unexpected(start)?),
            };
            let value = match self.peek()? {
                TokenKind::Value => {
                    let end = self.next()?.span.end;
                    match ends(self.peek()?) {
                        true => self.empty(point(end))?,
                        false => self.node(true, true)?,
                    }
                }
                _ => self.empty(key.span)?,
            };
            pairs.push((key, value));
        }
        self.next()?;
        Ok(self.map(pairs))
    }

    pub(crate) fn map(&mut self, pairs: Vec<(Node, Node)>) -> NodeValue {
        if self.rules == Rules::Strict {
            self.refuse_repeated(&pairs);
        }
        NodeValue::Map(merge::merged(pairs, self.rules, &mut self.mistakes))
    }

    fn refuse_repeated(&mut self, pairs: &[(Node, Node)]) {
        let mut seen = HashSet::new();
        for (key, _) in pairs {
            if let NodeValue::Scalar { text, .. } = &key.value
                && !merge::is_merge(key)
                && !seen.insert(text)
            {
                let message = format!("duplicate key '{text}'");
                self.mistakes.push((key.span, message));
            }
        }
    }
}
