//! Python pickles as plain data. [`Pickle::read`] runs nothing: what is not plain data is refused by its name.
//!
//! ```
//! use ztl_pickle::Pickle;
//!
//! // pickle.dumps({"x": 1.5, "moving": True})
//! let bytes = b"\x80\x04\x95\x1b\0\0\0\0\0\0\0}\x94(\x8c\x01x\x94G?\xf8\0\0\0\0\0\0\x8c\x06moving\x94\x88u.";
//! let pickle = Pickle::read(bytes)?;
//! assert_eq!(pickle.value().get("x").and_then(|x| x.as_f64()), Some(1.5));
//! assert_eq!(pickle.value().repr().to_string(), "{'x': 1.5, 'moving': True}");
//!
//! let error = Pickle::read(b"cos\nsystem\n(S'reboot'\ntR.").unwrap_err();
//! assert_eq!(error.to_string(), "refused: os.system");
//! # Ok::<(), ztl_pickle::Error>(())
//! ```
//!
//! `docs/streams.md` lists what is read, refused and written.
//!
//! Our own, since the crate `serde-pickle` 1.2 does not fit: 40 KB of nested lists overflow its stack and abort the
//! process; it refuses values that contain themselves, and takes some that share nested tuples for such. Here, values
//! are nodes of a graph: nothing recurses, and the memory that a pickle takes is counted.

mod array;
mod calls;
mod chunks;
mod deserialize;
mod dtype;
mod equal;
mod error;
mod finish;
mod global;
mod graph;
mod input;
mod integer;
mod json;
mod key;
mod limits;
mod make;
mod memo;
mod node;
mod read;
mod repr;
mod time;
mod value;
mod walk;
mod write;

pub use array::{Array, Scalar};
pub use dtype::{DType, Element, ElementKind};
pub use error::Error;
pub use json::JsonError;
pub use limits::Limits;
pub use repr::Repr;
pub use time::{Date, DateTime, Time, TimeDelta, TimeZone};
pub use value::{BigInt, Entries, Items, Kind, Value};

use graph::{Graph, Ref};

/// A Python value and all that it refers to. Shared parts are stored once; lists and dicts may contain themselves.
#[derive(Clone)]
pub struct Pickle {
    graph: Graph,
    root: Ref,
}

impl Pickle {
    /// Reads a pickle of protocol 0 to 5, with the default [`Limits`]. As in Python, what follows its end is ignored.
    ///
    /// # Errors
    /// [`Error::Refused`] if it is more than plain data; others if Python would not read it, or it is too large.
    pub fn read(bytes: &[u8]) -> Result<Self, Error> {
        Self::read_with(bytes, Limits::default())
    }

    /// As [`read`](Self::read), with other limits.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn read_with(bytes: &[u8], limits: Limits) -> Result<Self, Error> {
        let (graph, root) = read::read(bytes, &limits)?;
        Ok(Self { graph, root })
    }

    /// Its value.
    #[must_use]
    pub const fn value(&self) -> Value<'_> {
        let (graph, node) = (&self.graph, self.root);
        Value { graph, node }
    }

    /// Writes it in protocol 2, which Python 2.7 and 3 read. Equal pickles that were made in the same way give the same
    /// bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        write::write(&self.graph, self.root)
    }
}

#[cfg(test)]
mod tests;
