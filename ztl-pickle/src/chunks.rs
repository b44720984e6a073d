//! A vector that never moves its items: growing takes no second copy, so that memory follows the input closely.

use crate::Error;
use crate::limits::Account;

/// Items of a chunk.
const CHUNK: usize = 256;

/// A growing sequence. Full chunks stay where they are; only the first one grows like a `Vec`.
#[derive(Debug, Clone)]
pub(crate) struct Chunks<T> {
    chunks: Vec<Vec<T>>,
    len: usize,
}

impl<T: Copy> Chunks<T> {
    /// A chunk, and its entry in the outer vector, which doubles.
    const CHUNK_BYTES: usize = CHUNK * size_of::<T>() + 4 * size_of::<Vec<T>>();

    pub(crate) const fn new() -> Self {
        let chunks = Vec::new();
        Self { chunks, len: 0 }
    }

    pub(crate) const fn len(&self) -> usize {
        self.len
    }

    /// What was charged.
    pub(crate) const fn allocated(&self) -> usize {
        self.chunks.len() * Self::CHUNK_BYTES
    }

    pub(crate) fn push(&mut self, item: T, account: &mut Account) -> Result<(), Error> {
        let place = self.len / CHUNK;
        if place == self.chunks.len() {
            account.charge(Self::CHUNK_BYTES)?;
            let capacity = if place == 0 { 0 } else { CHUNK };
            self.chunks.push(Vec::with_capacity(capacity));
        }
        if let Some(chunk) = self.chunks.get_mut(place) {
            chunk.push(item);
            self.len += 1;
        }
        Ok(())
    }

    pub(crate) fn pop(&mut self) -> Option<T> {
        let last = self.len.checked_sub(1)?;
        self.len = last;
        self.chunks.get_mut(last / CHUNK)?.pop()
    }

    pub(crate) fn truncate(&mut self, len: usize) {
        while self.len > len {
            self.pop();
        }
    }

    pub(crate) fn last(&self) -> Option<T> {
        self.get(self.len.checked_sub(1)?)
    }

    pub(crate) fn last_mut(&mut self) -> Option<&mut T> {
        self.get_mut(self.len.checked_sub(1)?)
    }

    pub(crate) fn get(&self, index: usize) -> Option<T> {
        let chunk = self.chunks.get(index / CHUNK)?;
        chunk.get(index % CHUNK).copied()
    }

    pub(crate) fn get_mut(&mut self, index: usize) -> Option<&mut T> {
        let chunk = self.chunks.get_mut(index / CHUNK)?;
        chunk.get_mut(index % CHUNK)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = T> {
        self.chunks.iter().flatten().copied()
    }
}
