//! Pickles of a program's own values.

use crate::dtype::DType;
use crate::finish::finish;
use crate::graph::{Chain, Graph, Node, Ref, Span};
use crate::limits::Account;
use crate::{Error, Limits, Pickle, calls};

/// Nothing is limited but by the indices.
const LIMITS: Limits = Limits {
    bytes: usize::MAX,
    memory: usize::MAX,
    nodes: usize::MAX,
    depth: usize::MAX,
    memo: usize::MAX,
};

/// Makes values. A pickle takes at most 1 GiB of texts and bytes, and 2^30 values.
///
/// ```
/// use ztl_pickle::{DType, Pickle};
///
/// let pose = Pickle::array(DType::FLOAT64, &[2], [1.0_f64, 2.0].map(f64::to_le_bytes).as_flattened())?;
/// let message = Pickle::dict([("id", 7.into()), ("name", "arm".into()), ("pose", pose)])?;
/// assert_eq!(
///     message.value().repr().to_string(),
///     "{'id': 7, 'name': 'arm', 'pose': array([1.0, 2.0], dtype=float64)}"
/// );
/// assert_eq!(Pickle::read(&message.to_bytes())?, message);
/// # Ok::<(), ztl_pickle::Error>(())
/// ```
impl Pickle {
    /// `None`
    #[must_use]
    pub fn none() -> Self {
        Self::of(Ref::NONE)
    }

    /// A `str`.
    ///
    /// # Errors
    /// [`Error::TooLarge`]
    pub fn text(text: &str) -> Result<Self, Error> {
        Self::kept(text.as_bytes(), Node::Str)
    }

    /// `bytes`; in Python 2, a `str`.
    ///
    /// # Errors
    /// [`Error::TooLarge`]
    pub fn bytes(bytes: &[u8]) -> Result<Self, Error> {
        Self::kept(bytes, Node::Bytes)
    }

    /// A `list`.
    ///
    /// # Errors
    /// [`Error::TooLarge`]
    pub fn list<T: Into<Self>>(items: impl IntoIterator<Item = T>) -> Result<Self, Error> {
        Self::collection(items.into_iter().map(Into::into), Node::List)
    }

    /// A `tuple`.
    ///
    /// # Errors
    /// [`Error::TooLarge`]
    pub fn tuple<T: Into<Self>>(items: impl IntoIterator<Item = T>) -> Result<Self, Error> {
        Self::collection(items.into_iter().map(Into::into), Node::Tuple)
    }

    /// A `dict`. Of equal keys, the last value stays.
    ///
    /// # Errors
    /// [`Error::Unhashable`] if Python could not use a key; [`Error::TooLarge`].
    pub fn dict<K: Into<Self>, V: Into<Self>>(
        entries: impl IntoIterator<Item = (K, V)>,
    ) -> Result<Self, Error> {
        let entries = entries
            .into_iter()
            .flat_map(|(key, value)| [key.into(), value.into()]);
        Self::collection(entries, Node::Dict)?.checked()
    }

    /// A `set`.
    ///
    /// # Errors
    /// [`Error::Unhashable`] if Python could not use an element; [`Error::TooLarge`].
    pub fn set<T: Into<Self>>(items: impl IntoIterator<Item = T>) -> Result<Self, Error> {
        Self::collection(items.into_iter().map(Into::into), Node::Set)?.checked()
    }

    /// An array of numpy: the bytes of its elements, of which the last index changes fastest.
    ///
    /// # Errors
    /// [`Error::Malformed`] if there are not as many bytes as the shape and type need; [`Error::TooLarge`].
    pub fn array(dtype: DType, shape: &[usize], data: &[u8]) -> Result<Self, Error> {
        let account = &mut Account::unlimited();
        let mut graph = Graph::new(LIMITS.nodes);
        let mut lengths = Chain::EMPTY;
        for length in shape {
            let length = i64::try_from(*length).unwrap_or(i64::MAX);
            let length = graph.int(length, account)?;
            graph.link(&mut lengths, length, account)?;
        }
        let shape = graph.add(Node::Tuple(lengths), account)?;
        let dtype = graph.add(Node::DType(dtype), account)?;
        let data = graph.keep(data, account)?;
        let data = graph.add(Node::Bytes(data), account)?;
        let array = calls::array(&graph, dtype, shape, false, data)?;
        let root = graph.add(array, account)?;
        Ok(Self { graph, root })
    }

    /// A value that needs no node.
    fn of(root: Ref) -> Self {
        let graph = Graph::new(LIMITS.nodes);
        Self { graph, root }
    }

    fn kept(bytes: &[u8], make: fn(Span) -> Node) -> Result<Self, Error> {
        let account = &mut Account::unlimited();
        let mut graph = Graph::new(LIMITS.nodes);
        let span = graph.keep(bytes, account)?;
        let root = graph.add(make(span), account)?;
        Ok(Self { graph, root })
    }

    fn collection(
        items: impl Iterator<Item = Self>,
        make: fn(Chain) -> Node,
    ) -> Result<Self, Error> {
        let account = &mut Account::unlimited();
        let mut graph = Graph::new(LIMITS.nodes);
        let mut chain = Chain::EMPTY;
        for item in items {
            let item = graph.adopt(&item.graph, item.root)?;
            graph.link(&mut chain, item, account)?;
        }
        let root = graph.add(make(chain), account)?;
        Ok(Self { graph, root })
    }

    /// With equal keys united.
    pub(crate) fn checked(mut self) -> Result<Self, Error> {
        let account = &mut Account::unlimited();
        finish(&mut self.graph, self.root, &LIMITS, usize::MAX, account)?;
        Ok(self)
    }

    /// A value with one node.
    fn node(make: impl FnOnce(&mut Graph, &mut Account) -> Result<Ref, Error>) -> Self {
        let mut graph = Graph::new(LIMITS.nodes);
        // There is room for one.
        let root = make(&mut graph, &mut Account::unlimited()).unwrap_or(Ref::NONE);
        Self { graph, root }
    }
}

impl From<bool> for Pickle {
    fn from(value: bool) -> Self {
        Self::of(Ref::bool(value))
    }
}

impl From<i64> for Pickle {
    fn from(value: i64) -> Self {
        Self::node(|graph, account| graph.int(value, account))
    }
}

impl From<i32> for Pickle {
    fn from(value: i32) -> Self {
        i64::from(value).into()
    }
}

impl From<u32> for Pickle {
    fn from(value: u32) -> Self {
        i64::from(value).into()
    }
}

impl From<u64> for Pickle {
    fn from(value: u64) -> Self {
        let bytes = i128::from(value).to_le_bytes();
        Self::node(|graph, account| graph.long(&bytes, account))
    }
}

impl From<f64> for Pickle {
    fn from(value: f64) -> Self {
        Self::node(|graph, account| graph.add(Node::Float(value), account))
    }
}

impl From<&str> for Pickle {
    /// # Panics
    /// If it is longer than 1 GiB: [`text`](Pickle::text) returns an error instead.
    fn from(text: &str) -> Self {
        assert!(
            text.len() <= crate::graph::MAX_BYTES,
            "a text of more than 1 GiB"
        );
        Self::node(|graph, account| {
            let span = graph.keep(text.as_bytes(), account)?;
            graph.add(Node::Str(span), account)
        })
    }
}

impl From<()> for Pickle {
    fn from((): ()) -> Self {
        Self::none()
    }
}
