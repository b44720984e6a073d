//! Visits a value and all below it in order, without recursion.

use std::collections::HashSet;
use std::fmt;

use crate::Value;
use crate::graph::{Ref, Rest};

/// What to do with the parts of a value.
pub(crate) trait Visitor {
    /// A value without items, or with items that it handles itself.
    fn leaf(&mut self, value: Value<'_>) -> fmt::Result;
    /// Before the items of a collection.
    fn open(&mut self, value: Value<'_>) -> fmt::Result;
    /// Before an item; those of a dict are keys (even) and values.
    fn before(&mut self, value: Value<'_>, index: u32) -> fmt::Result;
    /// After the items.
    fn close(&mut self, value: Value<'_>) -> fmt::Result;
    /// A collection within itself.
    fn recursive(&mut self, value: Value<'_>) -> fmt::Result;
    /// A key of a dict: whether it is handled, so that its parts are not visited.
    fn key(&mut self, value: Value<'_>) -> Result<bool, fmt::Error>;
}

struct Frame {
    value: Ref,
    rest: Rest,
    index: u32,
}

/// Visits `root`.
pub(crate) fn walk(root: Value<'_>, visitor: &mut impl Visitor) -> fmt::Result {
    let graph = root.graph;
    let mut frames: Vec<Frame> = Vec::new();
    let mut open: HashSet<Ref> = HashSet::new();
    let mut next = Some(root.node);
    loop {
        if let Some(node) = next.take() {
            let value = Value { graph, node };
            match graph.node(node).chain() {
                None => visitor.leaf(value)?,
                Some(chain) if open.insert(node) => {
                    visitor.open(value)?;
                    frames.push(Frame {
                        value: node,
                        rest: graph.items(chain),
                        index: 0,
                    });
                }
                Some(_) => visitor.recursive(value)?,
            }
        }
        let Some(frame) = frames.last_mut() else {
            return Ok(());
        };
        let value = Value {
            graph,
            node: frame.value,
        };
        let Some((item, rest)) = graph.split(frame.rest) else {
            visitor.close(value)?;
            open.remove(&value.node);
            frames.pop();
            continue;
        };
        visitor.before(value, frame.index)?;
        let is_key = graph.node(frame.value).is_mapping() && frame.index.is_multiple_of(2);
        if !is_key || !visitor.key(Value { graph, node: item })? {
            next = Some(item);
        }
        (frame.rest, frame.index) = (rest, frame.index + 1);
    }
}

/// Text of at most `left` bytes.
pub(crate) struct Limited<'a, W: fmt::Write + ?Sized> {
    pub(crate) out: &'a mut W,
    pub(crate) left: usize,
    /// Whether there would be more.
    pub(crate) is_cut: bool,
}

impl<W: fmt::Write + ?Sized> fmt::Write for Limited<'_, W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        match self.left.checked_sub(text.len()) {
            Some(left) => {
                self.left = left;
                self.out.write_str(text)
            }
            None => {
                self.is_cut = true;
                let end = text.floor_char_boundary(self.left);
                self.out.write_str(text.get(..end).unwrap_or_default())?;
                Err(fmt::Error)
            }
        }
    }
}
