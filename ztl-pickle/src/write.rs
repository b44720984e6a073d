//! Pickles of protocol 2, which Python 2 and 3 read. The same graph gives the same bytes.

mod leaf;

use std::collections::HashMap;

use crate::global::Global;
use crate::graph::{Chain, Graph, Node, Ref, Rest};

/// Entries of a list or dict that are written at once, as by Python: a reader's stack stays small.
const BATCH: u32 = 1000;

/// What was written before, and may be mentioned again.
#[derive(PartialEq, Eq, Hash)]
enum Known {
    Value(Ref),
    Global(Global),
    /// Bytes as text, by their place.
    Text(u32, u32),
    /// The name of the encoding.
    Latin1,
}

struct Frame {
    value: Ref,
    rest: Rest,
    /// How many items are written.
    index: u32,
}

struct Writer<'a> {
    graph: &'a Graph,
    out: Vec<u8>,
    /// For each node, whether it is remembered.
    shared: Vec<bool>,
    memo: HashMap<Known, u32>,
    frames: Vec<Frame>,
}

/// Writes a value.
pub(crate) fn write(graph: &Graph, root: Ref) -> Vec<u8> {
    let mut writer = Writer {
        graph,
        out: vec![0x80, 2],
        shared: shared(graph, root),
        memo: HashMap::new(),
        frames: Vec::new(),
    };
    writer.value(root);
    while let Some(frame) = writer.frames.last_mut() {
        let (value, index) = (frame.value, frame.index);
        let split = graph.split(frame.rest);
        if let Some((_, rest)) = split {
            (frame.rest, frame.index) = (rest, index + 1);
        }
        writer.between(value, index, split.is_none());
        match split {
            Some((item, _)) => writer.value(item),
            None => {
                writer.frames.pop();
                writer.close(value);
            }
        }
    }
    writer.out.push(b'.');
    writer.out
}

/// For each node, whether it is remembered: it is referred to more than once.
///
/// A tuple is not known before it is complete, so a list on the way from a tuple to itself must be.
fn shared(graph: &Graph, root: Ref) -> Vec<bool> {
    let mut counts = vec![0_u8; graph.len()];
    let mut lists = Vec::new();
    let mut has_tuple = false;
    let mut next = vec![root];
    while let Some(value) = next.pop() {
        let index = value.index().map(|index| index as usize);
        let Some(count) = index.and_then(|index| counts.get_mut(index)) else {
            continue;
        };
        *count = count.saturating_add(1);
        let node = graph.node(value);
        if *count > 1 {
            has_tuple |= matches!(node, Node::Tuple(_));
            continue;
        }
        if matches!(node, Node::List(_)) || node.is_mapping() {
            lists.extend(index);
        }
        next.extend(node.parts());
        next.extend(graph.iter(node.chain().unwrap_or(Chain::EMPTY)));
    }
    for list in lists.into_iter().filter(|_| has_tuple) {
        if let Some(count) = counts.get_mut(list) {
            *count = 2;
        }
    }
    counts.into_iter().map(|count| count > 1).collect()
}

impl Writer<'_> {
    /// Writes a value; of a collection only the beginning.
    fn value(&mut self, value: Ref) {
        if self.mention(&Known::Value(value)) {
            return;
        }
        let node = self.graph.node(value);
        if let Some(chain) = node.chain() {
            if chain.len == 0 && matches!(node, Node::Tuple(_)) {
                return self.out.push(b')');
            }
            self.open(value, node);
            let rest = self.graph.items(chain);
            self.frames.push(Frame {
                value,
                rest,
                index: 0,
            });
            return;
        }
        match node {
            Node::None | Node::Global(_) => self.out.push(b'N'),
            Node::Bool(value) => self.out.push(if value { 0x88 } else { 0x89 }),
            Node::Int(value) => self.int(value),
            Node::Float(value) => {
                self.out.push(b'G');
                self.out.extend(value.to_be_bytes());
            }
            _ => {
                self.leaf(node);
                self.keep(value);
            }
        }
    }

    /// The beginning of a collection. Lists and dicts are known from here on: they may contain themselves.
    fn open(&mut self, value: Ref, node: Node) {
        match node {
            Node::List(_) => self.out.push(b']'),
            Node::Dict(_) => self.out.push(b'}'),
            Node::OrderedDict(_) => {
                self.global(Global::OrderedDict);
                self.out.extend(b")R");
            }
            Node::Tuple(chain) => return self.out.extend((chain.len > 3).then_some(b'(')),
            Node::Set(_) | Node::FrozenSet(_) => {
                let is_set = matches!(node, Node::Set(_));
                self.global(if is_set {
                    Global::Set
                } else {
                    Global::FrozenSet
                });
                return self.out.push(b']');
            }
            _ => {}
        }
        self.keep(value);
    }

    /// Begins and ends batches, before item `index` or at the end.
    fn between(&mut self, value: Ref, index: u32, is_end: bool) {
        let (end, size) = match self.graph.node(value) {
            Node::Tuple(_) => return,
            node if node.is_mapping() => (b'u', 2 * BATCH),
            _ => (b'e', BATCH),
        };
        let is_start = index.is_multiple_of(size);
        if index > 0 && (is_start || is_end) {
            self.out.push(end);
        }
        if is_start && !is_end {
            self.out.push(b'(');
        }
    }

    /// The end of a collection.
    fn close(&mut self, value: Ref) {
        match self.graph.node(value) {
            Node::Set(_) | Node::FrozenSet(_) => self.out.extend([0x85, b'R']),
            Node::Tuple(chain) if self.memo.contains_key(&Known::Value(value)) => {
                // It was written within itself, in a list.
                match chain.len {
                    few @ 1..=3 => self.out.extend((0..few).map(|_| b'0')),
                    _ => self.out.push(b'1'),
                }
                self.mention(&Known::Value(value));
                return;
            }
            Node::Tuple(chain) => self.out.push(match chain.len {
                few @ 1..=3 => 0x84 + few as u8,
                _ => b't',
            }),
            _ => return,
        }
        self.keep(value);
    }

    /// Remembers what was written, if it may be mentioned again.
    fn keep(&mut self, value: Ref) {
        let shared = value
            .index()
            .and_then(|index| self.shared.get(index as usize));
        if shared == Some(&true) {
            self.put(Known::Value(value));
        }
    }

    fn put(&mut self, known: Known) {
        let index = self.memo.len() as u32;
        self.memo.insert(known, index);
        self.numbered(b'q', b'r', index);
    }

    /// Mentions it, if it is known.
    fn mention(&mut self, known: &Known) -> bool {
        let index = self.memo.get(known).copied();
        if let Some(index) = index {
            self.numbered(b'h', b'j', index);
        }
        index.is_some()
    }

    fn numbered(&mut self, short: u8, long: u8, index: u32) {
        match u8::try_from(index) {
            Ok(index) => self.out.extend([short, index]),
            Err(_) => {
                self.out.push(long);
                self.out.extend(index.to_le_bytes());
            }
        }
    }

    fn global(&mut self, global: Global) {
        if !self.mention(&Known::Global(global)) {
            let (module, name) = global.names();
            for part in ["c", module, "\n", name, "\n"] {
                self.out.extend(part.as_bytes());
            }
            self.put(Known::Global(global));
        }
    }
}
