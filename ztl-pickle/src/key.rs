//! Which keys of dicts and sets are equal to Python: `1`, `1.0` and `True`, for example.

use std::hash::{BuildHasher, DefaultHasher, Hasher, RandomState};
use std::sync::LazyLock;

use crate::calls::data_of;
use crate::chunks::Chunks;
use crate::dtype::{DType, Element};
use crate::graph::{Graph, Node, Ref, Rest};
use crate::limits::Account;
use crate::{Error, integer, time};

/// Keys that nobody outside knows, so that nobody can make different values look equal.
static SECRETS: LazyLock<[RandomState; 2]> = LazyLock::new(Default::default);

/// What takes one unit of work, in bytes.
const UNIT: usize = 64;

/// Equal fingerprints mean equal keys: they are hashes of 128 bits.
pub(crate) struct Keys {
    /// The fingerprints of the frozensets that were visited. Each has its number in place of its last cell, which nobody
    /// needs any more: a frozenset does not grow.
    sets: Chunks<u128>,
    /// How much may be hashed: a tuple may contain one tuple twice, which contains one twice, and so on.
    most: usize,
    work: usize,
}

struct Hash([DefaultHasher; 2]);

impl Hash {
    fn new() -> Self {
        Self(SECRETS.each_ref().map(BuildHasher::build_hasher))
    }

    fn put(&mut self, tag: u8, bytes: &[u8]) {
        for hasher in &mut self.0 {
            hasher.write_u8(tag);
            hasher.write_u64(bytes.len() as u64);
            hasher.write(bytes);
        }
    }

    fn finish(self) -> u128 {
        let [high, low] = self.0.map(|hasher| hasher.finish());
        u128::from(high) << 64 | u128::from(low)
    }
}

impl Keys {
    /// For a pickle of so many bytes.
    pub(crate) fn new(input: usize) -> Self {
        let most = input.saturating_mul(8).saturating_add(1 << 20);
        Self {
            sets: Chunks::new(),
            most,
            work: 0,
        }
    }

    /// Keeps the fingerprint of a frozenset with this sum of the fingerprints of its elements; returns its number.
    pub(crate) fn put_set(
        &mut self,
        sum: u128,
        len: usize,
        account: &mut Account,
    ) -> Result<u32, Error> {
        let mut hash = Hash::new();
        hash.put(0, &sum.to_le_bytes());
        hash.put(0, &len.to_le_bytes());
        let number = self.sets.len() as u32;
        self.sets.push(hash.finish(), account)?;
        Ok(number)
    }

    /// The fingerprint of a key.
    pub(crate) fn fingerprint(
        &mut self,
        graph: &Graph,
        key: Ref,
        account: &mut Account,
    ) -> Result<u128, Error> {
        let mut hash = Hash::new();
        // The tuples around the current value.
        let mut open: Chunks<Rest> = Chunks::new();
        let mut next = Some(key);
        loop {
            if let Some(value) = next.take()
                && let Some(items) = self.put(graph, value, &mut hash)?
            {
                open.push(items, account)?;
            }
            let Some(rest) = open.last_mut() else {
                break;
            };
            match graph.split(*rest) {
                Some((item, after)) => (*rest, next) = (after, Some(item)),
                None => drop(open.pop()),
            }
        }
        account.release(open.allocated());
        Ok(hash.finish())
    }

    /// Hashes a value; of a tuple only the length: its items are to follow.
    fn put(&mut self, graph: &Graph, value: Ref, hash: &mut Hash) -> Result<Option<Rest>, Error> {
        self.work(1)?;
        match graph.node(value) {
            Node::None => hash.put(1, b""),
            Node::Bool(value) => put_int(value.into(), hash),
            Node::Int(value) => put_int(value, hash),
            Node::BigInt(span) => self.put_bytes(2, graph.bytes(span), hash)?,
            Node::Float(float) => put_float(float, value, hash),
            Node::Str(span) => self.put_bytes(3, graph.bytes(span), hash)?,
            Node::Bytes(span) => self.put_bytes(4, graph.bytes(span), hash)?,
            Node::Tuple(chain) => {
                hash.put(5, &chain.len.to_le_bytes());
                return Ok(Some(graph.items(chain)));
            }
            Node::FrozenSet(chain) => {
                let known = self.sets.get(chain.last as usize);
                let known = known.ok_or(Error::Unhashable("frozenset"))?;
                hash.put(6, &known.to_le_bytes());
            }
            Node::Scalar { dtype, data } => {
                let (Node::DType(dtype), Some(data)) = (graph.node(dtype), data_of(graph, data))
                else {
                    return Ok(None);
                };
                self.work(data.len() / UNIT)?;
                put_scalar(dtype, data, value, hash);
            }
            Node::Date { state } => hash.put(7, &graph.state::<4>(state)),
            Node::Time { state, zone } => {
                let micros = time::time(graph, state, zone).map_or(0, |time| time.micros());
                hash.put(tag_of(8, zone), &micros.to_le_bytes());
            }
            Node::DateTime { state, zone } => {
                let time = time::datetime(graph, state, zone);
                let micros = time.map_or(0, |time| time.micros());
                hash.put(tag_of(10, zone), &micros.to_le_bytes());
            }
            Node::Delta {
                days,
                seconds,
                micros,
            } => {
                let parts = [i64::from(days), seconds.into(), micros.into()];
                hash.put(12, parts.map(i64::to_le_bytes).as_flattened());
            }
            Node::Zone { delta, .. } => {
                let micros = time::delta(graph, delta).map_or(0, |delta| delta.total_micros());
                hash.put(13, &micros.to_le_bytes());
            }
            node => return Err(Error::Unhashable(name(node))),
        }
        Ok(None)
    }

    fn put_bytes(&mut self, tag: u8, bytes: &[u8], hash: &mut Hash) -> Result<(), Error> {
        self.work(bytes.len() / UNIT)?;
        hash.put(tag, bytes);
        Ok(())
    }

    fn work(&mut self, units: usize) -> Result<(), Error> {
        self.work = self.work.saturating_add(units);
        if self.work > self.most {
            let (limit, most) = ("parts of keys", self.most);
            return Err(Error::TooLarge { limit, most });
        }
        Ok(())
    }
}

/// A time with a zone never equals one without.
fn tag_of(tag: u8, zone: Ref) -> u8 {
    tag + u8::from(zone != Ref::NONE)
}

fn put_int(value: i64, hash: &mut Hash) {
    hash.put(2, integer::shortest(&value.to_le_bytes()));
}

fn put_float(value: f64, place: Ref, hash: &mut Hash) {
    if value.is_nan() {
        // Equal only to itself.
        hash.put(14, &place.index().unwrap_or(0).to_le_bytes());
    } else if value.is_finite() && value.fract() == 0.0 {
        hash.put(2, &integer::from_whole_float(value));
    } else {
        hash.put(15, &value.to_le_bytes());
    }
}

/// Numbers, texts and bytes of numpy equal Python's.
fn put_scalar(dtype: DType, data: &[u8], place: Ref, hash: &mut Hash) {
    match dtype.element(data) {
        Some(Element::Bool(value)) => put_int(value.into(), hash),
        Some(Element::Int(value)) => put_int(value, hash),
        Some(Element::UInt(value)) => {
            let wide = i128::from(value).to_le_bytes();
            hash.put(2, integer::shortest(&wide));
        }
        Some(Element::Float(value)) => put_float(value, place, hash),
        Some(Element::Complex(real, 0.0)) => put_float(real, place, hash),
        Some(Element::Complex(real, imaginary)) => {
            // Both zeros are equal.
            let parts = [real + 0.0, imaginary + 0.0];
            hash.put(16, parts.map(f64::to_le_bytes).as_flattened());
        }
        Some(Element::Bytes(bytes)) => hash.put(4, bytes),
        Some(Element::Text(text)) => hash.put(3, text.as_bytes()),
        None => {}
    }
}

/// Python's name of a type that cannot be a key, or of one that is not supported as key.
const fn name(node: Node) -> &'static str {
    match node {
        Node::ByteArray(_) => "bytearray",
        Node::List(_) => "list",
        Node::Set(_) => "set",
        Node::Dict(_) => "dict",
        Node::OrderedDict(_) => "collections.OrderedDict",
        Node::Array { .. } => "numpy.ndarray",
        Node::DType(_) => "numpy.dtype",
        _ => "object",
    }
}
