//! From a parser's events to a tree of values with their places.

use std::collections::{HashMap, HashSet};

use saphyr_parser::{Event, Marker, Parser, ScalarStyle, ScanError, Tag};

use super::{LOOP, Mark, Node, Rules, Span, Value};

/// Deepest nesting.
const DEPTH: usize = 64;
/// Most values, those repeated by `*alias` included.
const NODES: usize = 100_000;

type Mistake = (Span, String);

/// A list or mapping that has begun.
struct Open {
    start: Span,
    anchor: usize,
    map: bool,
    tag: Option<String>,
    nodes: Vec<Node>,
}

struct Builder {
    rules: Rules,
    open: Vec<Open>,
    /// What `&name` stands for, and how many values it is.
    anchors: HashMap<usize, (Node, usize)>,
    count: usize,
    root: Option<Node>,
    mistakes: Vec<Mistake>,
}

/// The tree, if there is one, and what is wrong with the text.
pub(super) fn parse(text: &str, rules: Rules) -> (Option<Node>, Vec<Mistake>) {
    let mut builder = Builder {
        rules,
        open: Vec::new(),
        anchors: HashMap::new(),
        count: 0,
        root: None,
        mistakes: Vec::new(),
    };
    let mut parser = Parser::new_from_str(text);
    while let Some(event) = parser.next_event() {
        let taken = match event {
            Ok((Event::StreamEnd, _)) => break,
            Ok((event, span)) => builder.take(event, span_of(span.start, span.end)),
            Err(error) => Err(not_yaml(&error)),
        };
        if let Err(mistake) = taken {
            builder.mistakes.push(mistake);
            break;
        }
    }
    let root = builder.root.unwrap_or(Node {
        span: Span::default(),
        value: Value::Scalar {
            text: String::new(),
            plain: true,
        },
        tag: None,
    });
    if rules == Rules::Python {
        return (Some(root), builder.mistakes);
    }
    // An empty file says nothing, which is a mapping without keys.
    let root = match root.is_null() {
        true => Node {
            value: Value::Map(Vec::new()),
            ..root
        },
        false => root,
    };
    (Some(root), builder.mistakes)
}

fn mark(marker: Marker) -> Mark {
    Mark {
        line: marker.line().max(1),
        column: marker.col() + 1,
    }
}

fn span_of(start: Marker, end: Marker) -> Span {
    Span {
        start: mark(start),
        end: mark(end),
    }
}

fn not_yaml(error: &ScanError) -> Mistake {
    let marker = *error.marker();
    (
        span_of(marker, marker),
        format!("this is no YAML: {}", in_plain_words(error.info())),
    )
}

/// What was probably not meant so, for those who do not know how a parser speaks.
fn in_plain_words(info: &str) -> &str {
    let words = [
        (
            "tab",
            "found a tab; indent with blanks, never with the tab key",
        ),
        (
            "mapping values are not allowed",
            "this ':' cannot stand here; the line before may lack a ':' at its end, or a text with ': ' in it lacks its quotes",
        ),
        (
            "did not find expected key",
            "this line begins in another column than those that it belongs to",
        ),
        (
            "trailing content after",
            "something stands behind the closing quote; within '…' write an apostrophe as ''",
        ),
        ("expected ',' or", "a ',' or the closing bracket is missing"),
        ("unknown anchor", "a text that begins with '*' needs quotes"),
    ];
    let found = words.into_iter().find(|(said, _)| info.contains(said));
    found.map_or(info, |(_, words)| words)
}

impl Builder {
    fn take(&mut self, event: Event<'_>, span: Span) -> Result<(), Mistake> {
        match event {
            Event::DocumentStart(_) if self.root.is_some() => {
                return Err((
                    span,
                    "a second document begins; use one file for each".to_owned(),
                ));
            }
            Event::Scalar(text, style, anchor, tag) => {
                let tag = self.tag(tag.as_deref(), span)?;
                let value = Value::Scalar {
                    text: text.into_owned(),
                    plain: style == ScalarStyle::Plain,
                };
                self.put(Node { span, value, tag }, anchor, 1)?;
            }
            Event::SequenceStart(anchor, tag) => {
                let tag = self.tag(tag.as_deref(), span)?;
                self.begin(span, anchor, tag, false)?;
            }
            Event::MappingStart(anchor, tag) => {
                let tag = self.tag(tag.as_deref(), span)?;
                self.begin(span, anchor, tag, true)?;
            }
            Event::SequenceEnd | Event::MappingEnd => self.end(span)?,
            Event::Alias(anchor) => {
                if let Some(text) = self.around(anchor) {
                    let text = text.to_owned();
                    let value = Value::Scalar { text, plain: false };
                    let tag = Some(LOOP.to_owned());
                    return self.put(Node { span, value, tag }, 0, 1);
                }
                let Some((node, count)) = self.anchors.get(&anchor).cloned() else {
                    return Err((
                        span,
                        "this stands for nothing that was written before".to_owned(),
                    ));
                };
                self.put(Node { span, ..node }, 0, count)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// What stands for the open collection with this anchor, if there is one and rules allow it.
    fn around(&self, anchor: usize) -> Option<&'static str> {
        let open = self.open.iter().find(|open| open.anchor == anchor)?;
        let text = if open.map { "{...}" } else { "[...]" };
        (self.rules == Rules::Python).then_some(text)
    }

    /// The tag to keep.
    fn tag(&self, tag: Option<&Tag>, span: Span) -> Result<Option<String>, Mistake> {
        match self.rules {
            Rules::Ours => check_tag(tag, span).map(|()| None),
            Rules::Python => Ok(tag.map(|tag| format!("{}{}", tag.handle, tag.suffix))),
        }
    }

    fn begin(
        &mut self,
        start: Span,
        anchor: usize,
        tag: Option<String>,
        map: bool,
    ) -> Result<(), Mistake> {
        if self.open.len() >= DEPTH {
            return Err((start, format!("nested deeper than {DEPTH}")));
        }
        let nodes = Vec::new();
        self.open.push(Open {
            start,
            anchor,
            map,
            tag,
            nodes,
        });
        Ok(())
    }

    fn end(&mut self, end: Span) -> Result<(), Mistake> {
        let Some(open) = self.open.pop() else {
            return Ok(());
        };
        let value = if open.map {
            let mut nodes = open.nodes.into_iter();
            let mut pairs = Vec::new();
            while let (Some(key), Some(value)) = (nodes.next(), nodes.next()) {
                pairs.push((key, value));
            }
            if self.rules == Rules::Ours {
                self.refuse_repeated(&pairs);
            }
            Value::Map(pairs)
        } else {
            Value::List(open.nodes)
        };
        let span = Span {
            start: open.start.start,
            end: end.end,
        };
        let node = Node {
            span,
            value,
            tag: open.tag,
        };
        let count = count(&node);
        // Its parts were counted when they were put.
        self.count -= (count - 1).min(self.count);
        self.put(node, open.anchor, count)
    }

    /// Puts a value where one is expected.
    fn put(&mut self, node: Node, anchor: usize, count: usize) -> Result<(), Mistake> {
        self.count += count;
        if self.count > NODES {
            return Err((node.span, format!("more than {NODES} values")));
        }
        if anchor != 0 {
            self.anchors.insert(anchor, (node.clone(), count));
        }
        match self.open.last_mut() {
            Some(open) => open.nodes.push(node),
            None => self.root = Some(node),
        }
        Ok(())
    }

    fn refuse_repeated(&mut self, pairs: &[(Node, Node)]) {
        let mut seen = HashSet::new();
        for (key, _) in pairs {
            if let Value::Scalar { text, .. } = &key.value
                && !seen.insert(text)
            {
                let message = format!("'{text}' stands here for the second time");
                self.mistakes.push((key.span, message));
            }
        }
    }
}

/// How many values a value is.
fn count(node: &Node) -> usize {
    1 + match &node.value {
        Value::Scalar { .. } => 0,
        Value::List(nodes) => nodes.iter().map(count).sum(),
        Value::Map(pairs) => pairs
            .iter()
            .map(|(key, value)| count(key) + count(value))
            .sum(),
    }
}

/// YAML's own tags say what is seen anyway; others would be passed over in silence.
fn check_tag(tag: Option<&Tag>, span: Span) -> Result<(), Mistake> {
    match tag {
        Some(tag) if !tag.is_yaml_core_schema() => Err((
            span,
            format!("the tag '{tag}' is not known here; leave it out"),
        )),
        _ => Ok(()),
    }
}
