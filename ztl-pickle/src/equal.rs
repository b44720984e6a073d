//! Whether two values have the same structure.

use crate::graph::{Chain, Graph, Node, Ref, Rest};
use crate::{Pickle, Value};

impl PartialEq for Pickle {
    fn eq(&self, other: &Self) -> bool {
        self.value() == other.value()
    }
}

impl Eq for Pickle {}

impl PartialEq for Value<'_> {
    /// Takes time in proportion to both sizes, however often parts are shared.
    fn eq(&self, other: &Self) -> bool {
        let mut classes = Classes {
            parents: (0..self.graph.len() + other.graph.len()).collect(),
        };
        let mut lists: Vec<(Rest, Rest)> = Vec::new();
        let mut next = Some((self.node, other.node));
        loop {
            if let Some((one, two)) = next.take() {
                match chains(self.graph, one, other.graph, two) {
                    None => return false,
                    Some((one_chain, two_chain)) if one_chain.len > 0 => {
                        // Assumed to be equal from here on; a difference is found elsewhere.
                        if classes.unite(one, two, self.graph.len()) {
                            lists.push((self.graph.items(one_chain), other.graph.items(two_chain)));
                        }
                    }
                    Some(_) => {}
                }
            }
            let Some((one, two)) = lists.last_mut() else {
                return true;
            };
            match (self.graph.split(*one), other.graph.split(*two)) {
                (Some((item, rest)), Some((other, after))) => {
                    (*one, *two) = (rest, after);
                    next = Some((item, other));
                }
                _ => drop(lists.pop()),
            }
        }
    }
}

impl Eq for Value<'_> {}

/// Nodes of both graphs that are equal so far.
struct Classes {
    parents: Vec<usize>,
}

impl Classes {
    fn class(&mut self, mut node: usize) -> usize {
        while let Some(parent) = self
            .parents
            .get(node)
            .copied()
            .filter(|parent| *parent != node)
        {
            // Halves the way for the next time.
            let above = self.parents.get(parent).copied().unwrap_or(parent);
            if let Some(place) = self.parents.get_mut(node) {
                *place = above;
            }
            node = above;
        }
        node
    }

    /// Whether they were not known to be equal.
    fn unite(&mut self, one: Ref, two: Ref, offset: usize) -> bool {
        let (Some(one), Some(two)) = (one.index(), two.index()) else {
            return true;
        };
        let (one, two) = (self.class(one as usize), self.class(offset + two as usize));
        if let Some(place) = self.parents.get_mut(one) {
            *place = two;
        }
        one != two
    }
}

/// The items of two values, which are equal but for them; `None` if they differ.
fn chains(a: &Graph, one: Ref, b: &Graph, two: Ref) -> Option<(Chain, Chain)> {
    let same = |parts: [(Ref, Ref); 2]| {
        // Parts are leaves.
        parts
            .iter()
            .all(|(one, two)| chains(a, *one, b, *two).is_some())
    };
    let is_equal = match (a.node(one), b.node(two)) {
        (Node::List(one), Node::List(two))
        | (Node::Tuple(one), Node::Tuple(two))
        | (Node::Set(one), Node::Set(two))
        | (Node::FrozenSet(one), Node::FrozenSet(two))
        | (Node::Dict(one), Node::Dict(two))
        | (Node::OrderedDict(one), Node::OrderedDict(two)) => {
            return (one.len == two.len).then_some((one, two));
        }
        (Node::None, Node::None) => true,
        (Node::Bool(one), Node::Bool(two)) => one == two,
        (Node::Int(one), Node::Int(two)) => one == two,
        (Node::Float(one), Node::Float(two)) => one.to_bits() == two.to_bits(),
        (Node::BigInt(one), Node::BigInt(two))
        | (Node::Str(one), Node::Str(two))
        | (Node::Bytes(one), Node::Bytes(two))
        | (Node::ByteArray(one), Node::ByteArray(two)) => a.bytes(one) == b.bytes(two),
        (Node::DType(one), Node::DType(two)) => one == two,
        (Node::Array { .. }, Node::Array { .. }) => {
            let array = |graph, node| match (Value { graph, node }).kind() {
                crate::Kind::Array(array) => Some(array),
                _ => None,
            };
            let (one, two) = (array(a, one)?, array(b, two)?);
            let head = |array: crate::Array<'_>| (array.dtype(), array.is_fortran(), array.shape());
            head(one) == head(two) && one.data() == two.data()
        }
        (
            Node::Scalar {
                dtype: dtype1,
                data: data1,
            },
            Node::Scalar {
                dtype: dtype2,
                data: data2,
            },
        ) => {
            let data = |graph, data| crate::calls::data_of(graph, data).map(<[u8]>::to_vec);
            same([(dtype1, dtype2), (Ref::NONE, Ref::NONE)]) && data(a, data1) == data(b, data2)
        }
        (Node::Date { state: one }, Node::Date { state: two }) => a.state::<4>(one) == b.state(two),
        (
            Node::Time { state: one, zone },
            Node::Time {
                state: two,
                zone: other,
            },
        ) => a.state::<6>(one) == b.state(two) && same([(zone, other), (Ref::NONE, Ref::NONE)]),
        (
            Node::DateTime { state: one, zone },
            Node::DateTime {
                state: two,
                zone: other,
            },
        ) => a.state::<10>(one) == b.state(two) && same([(zone, other), (Ref::NONE, Ref::NONE)]),
        (Node::Delta { .. }, Node::Delta { .. }) => {
            crate::time::delta(a, one) == crate::time::delta(b, two)
        }
        (
            Node::Zone {
                delta: delta1,
                name: name1,
            },
            Node::Zone {
                delta: delta2,
                name: name2,
            },
        ) => same([(delta1, delta2), (name1, name2)]),
        _ => false,
    };
    is_equal.then_some((Chain::EMPTY, Chain::EMPTY))
}
