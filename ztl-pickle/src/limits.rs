//! Bounds on what a pickle may take, and the account of memory.

use crate::Error;

/// What a pickle may take for each of its bytes, besides [`BASE`].
const EXPANSION: usize = 16;
/// What any pickle may take.
const BASE: usize = 1 << 20;

/// Bounds on what [`Pickle::read_with`](crate::Pickle::read_with) accepts.
///
/// In addition, a pickle may take 16 times its length and 1 MiB of memory. What Python writes takes less; a bomb
/// takes more, and is an error.
///
/// ```
/// use ztl_pickle::{Limits, Pickle};
///
/// let limits = Limits { depth: 1, ..Limits::default() };
/// assert!(Pickle::read_with(b"].", limits).is_ok());
/// let error = Pickle::read_with(b"]]a.", limits).unwrap_err();
/// assert_eq!(error.to_string(), "the pickle exceeds the limit on depth, 1");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The longest pickle, in bytes. Default 64 MiB; above 1 GiB, 1 GiB.
    pub bytes: usize,
    /// The most memory while reading, in bytes. Default 256 MiB.
    pub memory: usize,
    /// The most values, without `None`, `bool` and integers of 31 bits, which take no place of their own.
    /// Default 4 Mi.
    pub nodes: usize,
    /// How deep lists, tuples, dicts and sets may be nested; a cycle counts once. Default 1000, where Python's own
    /// pickler stops, too.
    pub depth: usize,
    /// The most values that the pickle may remember for later use. Default 4 Mi.
    pub memo: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            bytes: 64 << 20,
            memory: 256 << 20,
            nodes: 4 << 20,
            depth: 1000,
            memo: 4 << 20,
        }
    }
}

/// The memory that is in use while a pickle is read.
#[derive(Debug)]
pub(crate) struct Account {
    most: usize,
    left: usize,
}

impl Account {
    pub(crate) fn new(limits: &Limits, input: usize) -> Self {
        let most = input.saturating_mul(EXPANSION).saturating_add(BASE);
        let most = most.min(limits.memory);
        Self { most, left: most }
    }

    /// For values from this program.
    pub(crate) const fn unlimited() -> Self {
        Self {
            most: usize::MAX,
            left: usize::MAX,
        }
    }

    /// Call before memory is allocated.
    pub(crate) fn charge(&mut self, bytes: usize) -> Result<(), Error> {
        let too_large = Error::TooLarge {
            limit: "memory",
            most: self.most,
        };
        self.left = self.left.checked_sub(bytes).ok_or(too_large)?;
        Ok(())
    }

    /// Call after memory is freed.
    pub(crate) fn release(&mut self, bytes: usize) {
        self.left = self.left.saturating_add(bytes).min(self.most);
    }
}
