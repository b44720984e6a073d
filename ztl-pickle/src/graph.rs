//! Values as nodes of a graph: references are indices, so that shared and recursive values cost nothing special,
//! and nothing recurses when they are dropped.

use crate::Error;
use crate::chunks::Chunks;
use crate::limits::Account;
pub(crate) use crate::node::{Chain, END, Node, Ref, Span};

/// The most bytes: written as text, which takes twice as many, they have a length of 32 bits.
pub(crate) const MAX_BYTES: usize = 1 << 30;

#[derive(Debug, Clone, Copy)]
struct Cell {
    item: Ref,
    next: u32,
}

#[derive(Debug, Clone)]
pub(crate) struct Graph {
    nodes: Chunks<Node>,
    cells: Chunks<Cell>,
    bytes: Vec<u8>,
    most: usize,
}

impl Graph {
    /// An empty graph for at most `most` nodes.
    pub(crate) fn new(most: usize) -> Self {
        Self {
            nodes: Chunks::new(),
            cells: Chunks::new(),
            bytes: Vec::new(),
            most: most.min(Ref::CONSTANT as usize),
        }
    }

    pub(crate) const fn len(&self) -> usize {
        self.nodes.len()
    }

    pub(crate) fn node(&self, value: Ref) -> Node {
        match value {
            Ref::NONE => Node::None,
            Ref::FALSE => Node::Bool(false),
            Ref::TRUE => Node::Bool(true),
            Ref::EMPTY_TUPLE => Node::Tuple(Chain::EMPTY),
            Ref(small) if small & Ref::SMALL != 0 => Node::Int(i64::from((small << 1) as i32 >> 1)),
            // Each index comes from `add`.
            Ref(index) => self.nodes.get(index as usize).unwrap_or(Node::None),
        }
    }

    pub(crate) fn set(&mut self, value: Ref, node: Node) {
        let place = value
            .index()
            .and_then(|index| self.nodes.get_mut(index as usize));
        if let Some(place) = place {
            *place = node;
        }
    }

    pub(crate) fn add(&mut self, node: Node, account: &mut Account) -> Result<Ref, Error> {
        let index = self.nodes.len();
        if index >= self.most {
            let (limit, most) = ("nodes", self.most);
            return Err(Error::TooLarge { limit, most });
        }
        self.nodes.push(node, account)?;
        Ok(Ref(index as u32))
    }

    pub(crate) fn int(&mut self, value: i64, account: &mut Account) -> Result<Ref, Error> {
        match Ref::small(value) {
            Some(small) => Ok(small),
            None => self.add(Node::Int(value), account),
        }
    }

    /// A whole number in two's complement, the lowest byte first.
    pub(crate) fn long(&mut self, bytes: &[u8], account: &mut Account) -> Result<Ref, Error> {
        let bytes = crate::integer::shortest(bytes);
        match crate::integer::to_i64(bytes) {
            Some(value) => self.int(value, account),
            None => {
                let span = self.keep(bytes, account)?;
                self.add(Node::BigInt(span), account)
            }
        }
    }

    /// Stores bytes.
    pub(crate) fn keep(&mut self, bytes: &[u8], account: &mut Account) -> Result<Span, Error> {
        let (start, needed) = (self.bytes.len(), self.bytes.len() + bytes.len());
        if needed > MAX_BYTES {
            let (limit, most) = ("bytes", MAX_BYTES);
            return Err(Error::TooLarge { limit, most });
        }
        if needed > self.bytes.capacity() {
            self.reserve((needed + needed / 4).max(64), account)?;
        }
        self.bytes.extend_from_slice(bytes);
        Ok(Span {
            start: start as u32,
            len: bytes.len() as u32,
        })
    }

    /// Makes room for this many bytes in all.
    pub(crate) fn reserve(&mut self, total: usize, account: &mut Account) -> Result<(), Error> {
        let old = self.bytes.capacity();
        // Both exist while one is copied to the other.
        account.charge(total)?;
        self.bytes
            .reserve_exact(total.saturating_sub(self.bytes.len()));
        account.release(old);
        Ok(())
    }

    pub(crate) fn bytes(&self, span: Span) -> &[u8] {
        let start = span.start as usize;
        let range = start..start + span.len as usize;
        self.bytes.get(range).unwrap_or_default()
    }

    /// Python's bytes of a date or time.
    pub(crate) fn state<const N: usize>(&self, start: u32) -> [u8; N] {
        let bytes = self.bytes.get(start as usize..).unwrap_or_default();
        bytes.first_chunk().copied().unwrap_or([0; N])
    }

    /// Appends to a list, set or dict, or to a tuple that nobody has seen.
    pub(crate) fn append(
        &mut self,
        to: Ref,
        item: Ref,
        account: &mut Account,
    ) -> Result<(), Error> {
        if let Some(mut chain) = self.node(to).chain() {
            self.link(&mut chain, item, account)?;
            self.set_chain(to, chain);
        }
        Ok(())
    }

    pub(crate) fn link(
        &mut self,
        chain: &mut Chain,
        item: Ref,
        account: &mut Account,
    ) -> Result<(), Error> {
        let taken = |cell: Cell| cell.next != END;
        if self.cells.get(chain.last as usize).is_some_and(taken) {
            // Another chain goes on after the shared cells.
            let mut own = Chain::EMPTY;
            let mut items = self.items(*chain);
            while let Some((item, rest)) = self.split(items) {
                self.link(&mut own, item, account)?;
                items = rest;
            }
            *chain = own;
        }
        let next = self.cells.len();
        if next >= END as usize {
            let most = END as usize;
            return Err(Error::TooLarge {
                limit: "items",
                most,
            });
        }
        let next = next as u32;
        self.cells.push(Cell { item, next: END }, account)?;
        match self.cells.get_mut(chain.last as usize) {
            Some(last) => last.next = next,
            None => chain.first = next,
        }
        chain.last = next;
        chain.len += 1;
        Ok(())
    }

    /// Where the items of a chain begin.
    pub(crate) const fn items(&self, chain: Chain) -> Rest {
        Rest {
            cell: chain.first,
            left: chain.len,
        }
    }

    /// The next item, and the others.
    pub(crate) fn split(&self, rest: Rest) -> Option<(Ref, Rest)> {
        let left = rest.left.checked_sub(1)?;
        let Cell { item, next } = self.cells.get(rest.cell as usize)?;
        Some((item, Rest { cell: next, left }))
    }

    /// The items in order.
    pub(crate) fn iter(&self, chain: Chain) -> impl Iterator<Item = Ref> {
        let mut rest = self.items(chain);
        std::iter::from_fn(move || {
            let (item, others) = self.split(rest)?;
            rest = others;
            Some(item)
        })
    }

    /// Replaces the items of a list, set or dict.
    pub(crate) fn set_chain(&mut self, value: Ref, chain: Chain) {
        let mut node = self.node(value);
        if let Some(place) = node.chain_mut() {
            *place = chain;
            self.set(value, node);
        }
    }

    /// Takes over all nodes of another graph; returns its `root` as it is called here.
    pub(crate) fn adopt(&mut self, other: &Self, root: Ref) -> Result<Ref, Error> {
        let account = &mut Account::unlimited();
        let (nodes, cells) = (self.nodes.len() as u32, self.cells.len() as u32);
        let bytes = self.keep(&other.bytes, account)?.start;
        let moved = |at: u32| if at == END { END } else { at + cells };
        for mut node in other.nodes.iter() {
            if let Some(Chain { first, last, .. }) = node.chain_mut() {
                (*first, *last) = (moved(*first), moved(*last));
            }
            match &mut node {
                Node::BigInt(span) | Node::Str(span) => span.start += bytes,
                Node::Bytes(span) | Node::ByteArray(span) => span.start += bytes,
                Node::Array {
                    dtype, shape, data, ..
                } => {
                    for part in [dtype, shape, data] {
                        *part = part.shifted(nodes);
                    }
                }
                Node::Date { state } => *state += bytes,
                Node::Time { state, zone } | Node::DateTime { state, zone } => {
                    *state += bytes;
                    *zone = zone.shifted(nodes);
                }
                Node::Scalar {
                    dtype: one,
                    data: two,
                }
                | Node::Zone {
                    delta: one,
                    name: two,
                } => {
                    (*one, *two) = (one.shifted(nodes), two.shifted(nodes));
                }
                _ => {}
            }
            self.add(node, account)?;
        }
        for Cell { item, next } in other.cells.iter() {
            let (item, next) = (item.shifted(nodes), moved(next));
            self.cells.push(Cell { item, next }, account)?;
        }
        Ok(root.shifted(nodes))
    }
}

/// A place in a chain.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rest {
    pub(crate) cell: u32,
    pub(crate) left: u32,
}
