//! The nodes of a graph, and references to them.

use crate::dtype::DType;
use crate::global::Global;

/// The end of a chain.
pub(crate) const END: u32 = u32::MAX;

/// A value: a node, or a small one that needs none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Ref(pub(crate) u32);

impl Ref {
    /// Set for a whole number in the other 31 bits.
    pub(crate) const SMALL: u32 = 1 << 31;
    /// Set for one of the constants below.
    pub(crate) const CONSTANT: u32 = 1 << 30;
    pub(crate) const NONE: Self = Self(Self::CONSTANT);
    pub(crate) const FALSE: Self = Self(Self::CONSTANT + 1);
    pub(crate) const TRUE: Self = Self(Self::CONSTANT + 2);
    pub(crate) const EMPTY_TUPLE: Self = Self(Self::CONSTANT + 3);
    /// No value.
    pub(crate) const VACANT: Self = Self(Self::CONSTANT + 4);

    pub(crate) const fn bool(value: bool) -> Self {
        if value { Self::TRUE } else { Self::FALSE }
    }

    pub(crate) fn small(value: i64) -> Option<Self> {
        let fits = (-(1 << 30)..1 << 30).contains(&value);
        fits.then_some(Self(value as u32 | Self::SMALL))
    }

    /// The index of its node, if it has one.
    pub(crate) const fn index(self) -> Option<u32> {
        match self.0 < Self::CONSTANT {
            true => Some(self.0),
            false => None,
        }
    }

    pub(crate) const fn shifted(self, by: u32) -> Self {
        match self.index() {
            Some(index) => Self(index + by),
            None => self,
        }
    }
}

/// A part of the graph's bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    pub(crate) start: u32,
    pub(crate) len: u32,
}

/// Items in their order. Their cells have growing indices. Two chains may share cells at their start.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Chain {
    pub(crate) first: u32,
    pub(crate) last: u32,
    pub(crate) len: u32,
}

impl Chain {
    pub(crate) const EMPTY: Self = Self {
        first: END,
        last: END,
        len: 0,
    };
}

/// A node takes 16 bytes: limits rely on that.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Node {
    None,
    Bool(bool),
    Int(i64),
    /// Two's complement, the lowest byte first, as short as possible, and of more than 64 bits.
    BigInt(Span),
    Float(f64),
    /// UTF-8 that may have surrogates.
    Str(Span),
    Bytes(Span),
    ByteArray(Span),
    List(Chain),
    Tuple(Chain),
    Set(Chain),
    FrozenSet(Chain),
    /// Keys and values in turn.
    Dict(Chain),
    OrderedDict(Chain),
    DType(DType),
    /// `shape` is a tuple of lengths; `data` is `Bytes`, `ByteArray` or ASCII `Str` of the right length.
    Array {
        fortran: bool,
        dtype: Ref,
        shape: Ref,
        data: Ref,
    },
    Scalar {
        dtype: Ref,
        data: Ref,
    },
    /// `state` is the start of Python's own 4, 6 or 10 bytes, which are valid; `zone` is `NONE` or a `Zone`.
    Date {
        state: u32,
    },
    Time {
        state: u32,
        zone: Ref,
    },
    DateTime {
        state: u32,
        zone: Ref,
    },
    Delta {
        days: i32,
        seconds: u32,
        micros: u32,
    },
    /// A `Delta` of less than a day, and `NONE` or a `Str`.
    Zone {
        delta: Ref,
        name: Ref,
    },
    /// What may be called; never in a result.
    Global(Global),
}

const _: () = assert!(size_of::<Node>() == 16);

impl Node {
    /// Its items, if it contains other values.
    pub(crate) const fn chain(self) -> Option<Chain> {
        match self {
            Self::List(chain) | Self::Tuple(chain) | Self::Set(chain) => Some(chain),
            Self::FrozenSet(chain) | Self::Dict(chain) | Self::OrderedDict(chain) => Some(chain),
            _ => None,
        }
    }

    /// The values that it has besides its items.
    pub(crate) const fn parts(self) -> [Ref; 3] {
        match self {
            Self::Array {
                dtype, shape, data, ..
            } => [dtype, shape, data],
            Self::Scalar { dtype, data } => [dtype, data, Ref::NONE],
            Self::Time { zone, .. } | Self::DateTime { zone, .. } => [zone, Ref::NONE, Ref::NONE],
            Self::Zone { delta, name } => [delta, name, Ref::NONE],
            _ => [Ref::NONE; 3],
        }
    }

    pub(crate) const fn chain_mut(&mut self) -> Option<&mut Chain> {
        match self {
            Self::List(chain) | Self::Tuple(chain) | Self::Set(chain) => Some(chain),
            Self::FrozenSet(chain) | Self::Dict(chain) | Self::OrderedDict(chain) => Some(chain),
            _ => None,
        }
    }

    pub(crate) const fn is_mapping(self) -> bool {
        matches!(self, Self::Dict(_) | Self::OrderedDict(_))
    }
}
