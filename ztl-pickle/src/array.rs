//! Arrays and scalars of numpy.

use std::fmt;

use crate::dtype::{DType, Element};
use crate::graph::{Chain, Graph, Node};

/// An array of numpy.
#[derive(Clone, Copy)]
pub struct Array<'a> {
    pub(crate) graph: &'a Graph,
    pub(crate) dtype: DType,
    pub(crate) shape: Chain,
    pub(crate) fortran: bool,
    pub(crate) data: &'a [u8],
}

impl<'a> Array<'a> {
    /// The type of its elements.
    #[must_use]
    pub const fn dtype(self) -> DType {
        self.dtype
    }

    /// Its length in each dimension.
    #[must_use]
    pub fn shape(self) -> Vec<usize> {
        let lengths = self.graph.iter(self.shape);
        let length = |length| match self.graph.node(length) {
            Node::Int(length) => usize::try_from(length).ok(),
            _ => None,
        };
        lengths.filter_map(length).collect()
    }

    /// Whether the first index changes fastest in [`data`](Self::data), instead of the last one.
    #[must_use]
    pub const fn is_fortran(self) -> bool {
        self.fortran
    }

    /// The bytes of its elements.
    #[must_use]
    pub const fn data(self) -> &'a [u8] {
        self.data
    }

    /// Its elements; the last index changes fastest.
    pub fn elements(self) -> impl Iterator<Item = Element<'a>> {
        let shape = self.shape();
        let count: usize = shape.iter().product();
        let shape = if self.fortran { shape } else { Vec::new() };
        (0..count).filter_map(move |mut index| {
            let mut place = index;
            if self.fortran {
                // The index in the last dimension has the longest way.
                let mut stride = count;
                place = 0;
                for length in shape.iter().rev() {
                    stride /= length;
                    place += index % length * stride;
                    index /= length;
                }
            }
            let start = place.checked_mul(self.dtype.size())?;
            self.dtype.element(self.data.get(start..)?)
        })
    }
}

impl fmt::Debug for Array<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "array of {}, {:?}", self.dtype, self.shape())
    }
}

/// A value with a type of numpy.
#[derive(Debug, Clone, Copy)]
pub struct Scalar<'a> {
    pub(crate) dtype: DType,
    pub(crate) data: &'a [u8],
}

impl<'a> Scalar<'a> {
    /// Its type.
    #[must_use]
    pub const fn dtype(self) -> DType {
        self.dtype
    }

    /// Its bytes.
    #[must_use]
    pub const fn data(self) -> &'a [u8] {
        self.data
    }

    /// What it is.
    #[must_use]
    pub fn element(self) -> Option<Element<'a>> {
        self.dtype.element(self.data)
    }
}
