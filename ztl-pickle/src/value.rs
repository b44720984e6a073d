//! Values of a pickle, as a program looks at them.

use std::fmt;

use crate::array::{Array, Scalar};
use crate::calls::data_of;
use crate::dtype::{DType, Element};
use crate::graph::{Chain, Graph, Node, Ref, Rest};
use crate::integer;
use crate::time::{self, Date, DateTime, Time, TimeDelta, TimeZone};

/// A value of a [`Pickle`](crate::Pickle). Values are compared by their structure: `1`, `1.0` and `True` differ, and so do dicts and
/// sets in another order; `nan` equals itself; sharing makes no difference.
#[derive(Clone, Copy)]
pub struct Value<'a> {
    pub(crate) graph: &'a Graph,
    pub(crate) node: Ref,
}

/// What a value is.
///
/// A list or dict may contain itself: whoever follows the items of collections must notice that, by [`Value::id`].
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub enum Kind<'a> {
    /// `None`
    None,
    /// `True`, `False`
    Bool(bool),
    /// An `int` of 64 bits.
    Int(i64),
    /// A larger `int`.
    BigInt(BigInt<'a>),
    /// `float`
    Float(f64),
    /// `str`
    Str(&'a str),
    /// A `str` with surrogates, which is not Unicode: its UTF-8 with surrogates of three bytes. Python makes them of
    /// file names in other encodings.
    BrokenStr(&'a [u8]),
    /// `bytes`, and a string of Python 2 that is not ASCII.
    Bytes(&'a [u8]),
    /// `bytearray`
    ByteArray(&'a [u8]),
    /// `list`
    List(Items<'a>),
    /// `tuple`
    Tuple(Items<'a>),
    /// `set`
    Set(Items<'a>),
    /// `frozenset`
    FrozenSet(Items<'a>),
    /// `dict`
    Dict(Entries<'a>),
    /// `collections.OrderedDict`
    OrderedDict(Entries<'a>),
    /// `numpy.ndarray`
    Array(Array<'a>),
    /// A number, text or bytes of numpy, such as `numpy.float64`.
    Scalar(Scalar<'a>),
    /// `numpy.dtype`
    DType(DType),
    /// `datetime.date`
    Date(Date),
    /// `datetime.time`
    Time(Time<'a>),
    /// `datetime.datetime`
    DateTime(DateTime<'a>),
    /// `datetime.timedelta`
    TimeDelta(TimeDelta),
    /// `datetime.timezone`
    TimeZone(TimeZone<'a>),
}

impl<'a> Value<'a> {
    /// What it is, with its content.
    #[must_use]
    pub fn kind(self) -> Kind<'a> {
        let Self { graph, node } = self;
        let items = |chain| Items(self.entries(chain));
        match graph.node(node) {
            Node::None | Node::Global(_) => Kind::None,
            Node::Bool(value) => Kind::Bool(value),
            Node::Int(value) => Kind::Int(value),
            Node::BigInt(span) => Kind::BigInt(BigInt(graph.bytes(span))),
            Node::Float(value) => Kind::Float(value),
            Node::Str(span) => {
                let bytes = graph.bytes(span);
                std::str::from_utf8(bytes).map_or(Kind::BrokenStr(bytes), Kind::Str)
            }
            Node::Bytes(span) => Kind::Bytes(graph.bytes(span)),
            Node::ByteArray(span) => Kind::ByteArray(graph.bytes(span)),
            Node::List(chain) => Kind::List(items(chain)),
            Node::Tuple(chain) => Kind::Tuple(items(chain)),
            Node::Set(chain) => Kind::Set(items(chain)),
            Node::FrozenSet(chain) => Kind::FrozenSet(items(chain)),
            Node::Dict(chain) => Kind::Dict(self.entries(chain)),
            Node::OrderedDict(chain) => Kind::OrderedDict(self.entries(chain)),
            Node::DType(dtype) => Kind::DType(dtype),
            Node::Array {
                fortran,
                dtype,
                shape,
                data,
            } => Kind::Array(Array {
                graph,
                dtype: self.dtype(dtype),
                shape: graph.node(shape).chain().unwrap_or(Chain::EMPTY),
                fortran,
                data: data_of(graph, data).unwrap_or_default(),
            }),
            Node::Scalar { dtype, data } => Kind::Scalar(Scalar {
                dtype: self.dtype(dtype),
                data: data_of(graph, data).unwrap_or_default(),
            }),
            Node::Date { state } => time::date(graph, state).map_or(Kind::None, Kind::Date),
            Node::Time { state, zone } => {
                time::time(graph, state, zone).map_or(Kind::None, Kind::Time)
            }
            Node::DateTime { state, zone } => {
                time::datetime(graph, state, zone).map_or(Kind::None, Kind::DateTime)
            }
            Node::Delta {
                days,
                seconds,
                micros,
            } => Kind::TimeDelta(TimeDelta {
                days,
                seconds,
                micros,
            }),
            Node::Zone { .. } => time::zone(graph, node).map_or(Kind::None, Kind::TimeZone),
        }
    }

    fn dtype(self, dtype: Ref) -> DType {
        match self.graph.node(dtype) {
            Node::DType(dtype) => dtype,
            _ => DType::UINT8,
        }
    }

    const fn entries(self, chain: Chain) -> Entries<'a> {
        let rest = self.graph.items(chain);
        Entries {
            graph: self.graph,
            rest,
        }
    }

    /// A number that only the same object has: two lists of this pickle with one id are one list. Small values that
    /// cannot change have none.
    #[must_use]
    pub const fn id(self) -> Option<u32> {
        self.node.index()
    }

    /// Its text, if it is a `str`.
    #[must_use]
    pub fn as_str(self) -> Option<&'a str> {
        match self.kind() {
            Kind::Str(text) => Some(text),
            _ => None,
        }
    }

    /// Its number, if it is a `float`, an `int`, or a number of numpy. A large `int` is rounded.
    #[must_use]
    pub fn as_f64(self) -> Option<f64> {
        match self.kind() {
            Kind::Float(value) => Some(value),
            Kind::Int(value) => Some(value as f64),
            Kind::BigInt(value) => value.to_string().parse().ok(),
            Kind::Scalar(scalar) => match scalar.element()? {
                Element::Int(value) => Some(value as f64),
                Element::UInt(value) => Some(value as f64),
                Element::Float(value) => Some(value),
                _ => None,
            },
            _ => None,
        }
    }

    /// The value of a dict at this key.
    ///
    /// ```
    /// # use ztl_pickle::Pickle;
    /// let pickle = Pickle::read(b"}X\x01\0\0\0xK\x07s.")?;
    /// assert_eq!(pickle.value().get("x").unwrap().as_f64(), Some(7.0));
    /// # Ok::<(), ztl_pickle::Error>(())
    /// ```
    #[must_use]
    pub fn get(self, key: &str) -> Option<Self> {
        match self.kind() {
            Kind::Dict(mut entries) | Kind::OrderedDict(mut entries) => {
                let is_key = |entry: &(Self, Self)| entry.0.as_str() == Some(key);
                entries.find(is_key).map(|(_, value)| value)
            }
            _ => None,
        }
    }
}

/// An `int` of more than 64 bits.
#[derive(Clone, Copy)]
pub struct BigInt<'a>(pub(crate) &'a [u8]);

impl<'a> BigInt<'a> {
    /// Two's complement, the lowest byte first.
    #[must_use]
    pub const fn to_le_bytes(self) -> &'a [u8] {
        self.0
    }
}

impl fmt::Display for BigInt<'_> {
    /// Decimal; above 4300 digits, which Python does not print, hexadecimal.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        integer::put_text(self.0, f)
    }
}

impl fmt::Debug for BigInt<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The items of a list, tuple or set.
#[derive(Clone, Copy)]
pub struct Items<'a>(Entries<'a>);

impl<'a> Iterator for Items<'a> {
    type Item = Value<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        self.0.item()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.0.rest.left as usize;
        (left, Some(left))
    }
}

impl ExactSizeIterator for Items<'_> {}

impl fmt::Debug for Items<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} items", self.len())
    }
}

/// The keys of a dict with their values, in their order.
#[derive(Clone, Copy)]
pub struct Entries<'a> {
    graph: &'a Graph,
    rest: Rest,
}

impl<'a> Entries<'a> {
    fn item(&mut self) -> Option<Value<'a>> {
        let graph = self.graph;
        let (node, rest) = graph.split(self.rest)?;
        self.rest = rest;
        Some(Value { graph, node })
    }
}

impl<'a> Iterator for Entries<'a> {
    type Item = (Value<'a>, Value<'a>);

    fn next(&mut self) -> Option<Self::Item> {
        self.item().zip(self.item())
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.rest.left as usize / 2;
        (left, Some(left))
    }
}

impl ExactSizeIterator for Entries<'_> {}

impl fmt::Debug for Entries<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} entries", self.len())
    }
}
