//! What it means that a pickle calls a name.

use crate::Error;
use crate::dtype::DType;
use crate::global::Global;
use crate::graph::{Chain, Graph, Node, Ref, Span};
use crate::input::{latin1, malformed};
use crate::limits::Account;
use crate::time;

/// The most dimensions of an array, as in numpy.
const MAX_DIMENSIONS: u32 = 64;

/// The value of a call with these arguments.
pub(crate) fn call(
    graph: &mut Graph,
    global: Global,
    args: &[Ref],
    account: &mut Account,
) -> Result<Ref, Error> {
    let node = match (global, args) {
        (Global::Encode, [text, encoding]) => {
            let Node::Str(encoding) = graph.node(*encoding) else {
                return Err(WRONG);
            };
            if !matches!(graph.bytes(encoding), b"latin1" | b"latin-1") {
                let name = graph.bytes(encoding);
                return Err(Error::refused(b"_codecs.encode", name));
            }
            return encoded(graph, *text, Node::Bytes, account);
        }
        (Global::Bytes, []) => Node::Bytes(graph.keep(b"", account)?),
        (Global::ByteArray, []) => Node::ByteArray(graph.keep(b"", account)?),
        (Global::ByteArray, [bytes]) => match graph.node(*bytes) {
            Node::Bytes(span) | Node::ByteArray(span) => Node::ByteArray(span),
            // Python 2's bytes.
            Node::Str(span) if graph.bytes(span).is_ascii() => Node::ByteArray(span),
            _ => return Err(WRONG),
        },
        (Global::ByteArray, [text, encoding]) => {
            let Node::Str(encoding) = graph.node(*encoding) else {
                return Err(WRONG);
            };
            if graph.bytes(encoding) != b"latin-1" {
                return Err(WRONG);
            }
            return encoded(graph, *text, Node::ByteArray, account);
        }
        (Global::Set, []) => Node::Set(Chain::EMPTY),
        (Global::FrozenSet, []) => Node::FrozenSet(Chain::EMPTY),
        (Global::Set | Global::FrozenSet, [items]) => match (global, graph.node(*items)) {
            (Global::Set, Node::List(chain) | Node::Tuple(chain)) => Node::Set(chain),
            (_, Node::List(chain) | Node::Tuple(chain)) => Node::FrozenSet(chain),
            _ => return Err(WRONG),
        },
        (Global::OrderedDict, []) => Node::OrderedDict(Chain::EMPTY),
        (Global::OrderedDict, [items]) => return ordered_dict(graph, *items, account),
        (Global::Date | Global::Time | Global::DateTime | Global::Delta | Global::Zone, args) => {
            time::call(graph, global, args)?
        }
        (Global::DType, [code, flags @ ..]) if flags.len() <= 2 => {
            let Node::Str(code) = graph.node(*code) else {
                return Err(WRONG);
            };
            let code = graph.bytes(code);
            let known = std::str::from_utf8(code).ok().and_then(DType::new);
            Node::DType(known.ok_or_else(|| Error::refused(b"numpy.dtype", code))?)
        }
        (Global::Reconstruct, [class, shape, code]) => {
            let is_array = matches!(graph.node(*class), Node::Global(Global::NdArray));
            let is_code = matches!(graph.node(*code), Node::Str(span) | Node::Bytes(span) if graph.bytes(span) == b"b");
            if !is_array || !is_code || elements(graph, *shape) != Some(0) {
                return Err(WRONG);
            }
            let data = graph.keep(b"", account)?;
            let data = graph.add(Node::Bytes(data), account)?;
            let code = DType::new("i1").ok_or(WRONG)?;
            let dtype = graph.add(Node::DType(code), account)?;
            array(graph, dtype, *shape, false, data)?
        }
        (Global::FromBuffer, [data, dtype, shape, order]) => {
            let fortran = match graph.node(*order) {
                Node::Str(span) if graph.bytes(span) == b"C" => false,
                Node::Str(span) if graph.bytes(span) == b"F" => true,
                _ => return Err(WRONG),
            };
            array(graph, *dtype, *shape, fortran, *data)?
        }
        (Global::Scalar, [dtype, data]) => {
            let (Node::DType(kind), Some(bytes)) = (graph.node(*dtype), data_of(graph, *data))
            else {
                return Err(WRONG);
            };
            if bytes.len() != kind.size() {
                return Err(WRONG);
            }
            let (dtype, data) = (*dtype, *data);
            Node::Scalar { dtype, data }
        }
        (Global::NdArray, _) => return Err(global.refused()),
        _ => return Err(WRONG),
    };
    graph.add(node, account)
}

const WRONG: Error = malformed("unexpected arguments of a call");

/// The state of an array or its type, which Python sets after the call.
pub(crate) fn build(graph: &mut Graph, object: Ref, state: Ref) -> Result<(), Error> {
    if !matches!(graph.node(object), Node::Array { .. } | Node::DType(_)) {
        return Err(Error::refused(b"", b"the state of an object"));
    }
    let parts = arguments(graph, state)?;
    let node = match (graph.node(object), parts.as_slice()) {
        (Node::Array { .. }, [version, shape, dtype, fortran, data]) => {
            let fortran = match (graph.node(*version), graph.node(*fortran)) {
                (Node::Int(1), Node::Bool(fortran)) => fortran,
                // Python 2 writes it as a number.
                (Node::Int(1), Node::Int(fortran @ 0..=1)) => fortran == 1,
                _ => return Err(STATE),
            };
            array(graph, *dtype, *shape, fortran, *data)?
        }
        (Node::DType(dtype), [version, order, Ref::NONE, Ref::NONE, Ref::NONE, ..]) => {
            let (Node::Int(3), Node::Str(order), 8) =
                (graph.node(*version), graph.node(*order), parts.len())
            else {
                return Err(STATE);
            };
            let order = match graph.bytes(order) {
                [order] => dtype.ordered(*order),
                _ => None,
            };
            Node::DType(order.ok_or(STATE)?)
        }
        _ => return Err(STATE),
    };
    graph.set(object, node);
    Ok(())
}

const STATE: Error = malformed("unexpected state of an array");

/// The items of a tuple of few.
pub(crate) fn arguments(graph: &Graph, tuple: Ref) -> Result<Vec<Ref>, Error> {
    match graph.node(tuple) {
        Node::Tuple(chain) if chain.len <= 8 => Ok(graph.iter(chain).collect()),
        _ => Err(WRONG),
    }
}

/// Bytes that old protocols store as text.
fn encoded(
    graph: &mut Graph,
    text: Ref,
    make: fn(Span) -> Node,
    account: &mut Account,
) -> Result<Ref, Error> {
    let Node::Str(span) = graph.node(text) else {
        return Err(WRONG);
    };
    if graph.bytes(span).is_ascii() {
        return graph.add(make(span), account);
    }
    let len = graph.bytes(span).len();
    account.charge(len)?;
    let bytes = latin1(graph.bytes(span)).ok_or(WRONG)?;
    let span = graph.keep(&bytes, account)?;
    account.release(len);
    graph.add(make(span), account)
}

/// Python 2 gives the pairs as a list of lists.
fn ordered_dict(graph: &mut Graph, items: Ref, account: &mut Account) -> Result<Ref, Error> {
    let Node::List(pairs) = graph.node(items) else {
        return Err(WRONG);
    };
    let dict = graph.add(Node::OrderedDict(Chain::EMPTY), account)?;
    let mut rest = graph.items(pairs);
    while let Some((pair, others)) = graph.split(rest) {
        let (Node::List(chain) | Node::Tuple(chain)) = graph.node(pair) else {
            return Err(WRONG);
        };
        let mut parts = graph.iter(chain);
        let (Some(key), Some(value), 2) = (parts.next(), parts.next(), chain.len) else {
            return Err(WRONG);
        };
        drop(parts);
        graph.append(dict, key, account)?;
        graph.append(dict, value, account)?;
        rest = others;
    }
    Ok(dict)
}

/// An array whose parts agree.
pub(crate) fn array(
    graph: &Graph,
    dtype: Ref,
    shape: Ref,
    fortran: bool,
    data: Ref,
) -> Result<Node, Error> {
    let Node::DType(kind) = graph.node(dtype) else {
        return Err(STATE);
    };
    let needed = elements(graph, shape).and_then(|count| count.checked_mul(kind.size()));
    let found = data_of(graph, data).map(<[u8]>::len);
    match needed.is_some() && needed == found {
        true => Ok(Node::Array {
            fortran,
            dtype,
            shape,
            data,
        }),
        false => Err(STATE),
    }
}

/// The number of elements, if it is a shape.
fn elements(graph: &Graph, shape: Ref) -> Option<usize> {
    let Node::Tuple(chain) = graph.node(shape) else {
        return None;
    };
    if chain.len > MAX_DIMENSIONS {
        return None;
    }
    graph
        .iter(chain)
        .try_fold(1_usize, |count, length| match graph.node(length) {
            Node::Int(length) => count.checked_mul(usize::try_from(length).ok()?),
            _ => None,
        })
}

/// The bytes of elements; Python 2's are text if they are ASCII.
pub(crate) fn data_of(graph: &Graph, data: Ref) -> Option<&[u8]> {
    match graph.node(data) {
        Node::Bytes(span) | Node::ByteArray(span) => Some(graph.bytes(span)),
        Node::Str(span) => Some(graph.bytes(span)).filter(|bytes| bytes.is_ascii()),
        _ => None,
    }
}
