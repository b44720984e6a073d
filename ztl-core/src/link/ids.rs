//! Lists of task ids.

use super::link_id::LinkId;
use super::wire::Reader;

/// A list of link ids: a slice to send, or a view of received bytes.
#[derive(Debug, Clone, Copy)]
pub struct Ids<'a>(pub(super) IdList<'a>);

#[derive(Debug, Clone, Copy)]
pub(super) enum IdList<'a> {
    Slice(&'a [LinkId]),
    /// Encoded ids, already checked.
    Encoded {
        count: usize,
        bytes: &'a [u8],
    },
}

impl<'a> Ids<'a> {
    /// The ids of a slice.
    #[must_use]
    pub const fn new(ids: &'a [LinkId]) -> Self {
        Self(IdList::Slice(ids))
    }

    /// Number of ids.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self.0 {
            IdList::Slice(ids) => ids.len(),
            IdList::Encoded { count, .. } => count,
        }
    }

    /// Whether the list is empty.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Iterates over the ids.
    pub fn iter(&self) -> impl Iterator<Item = LinkId> + use<'a> {
        let (slice, bytes): (&'a [LinkId], &'a [u8]) = match self.0 {
            IdList::Slice(ids) => (ids, &[]),
            IdList::Encoded { bytes, .. } => (&[], bytes),
        };
        let mut reader = Reader::new(bytes);
        slice.iter().copied().chain(core::iter::from_fn(move || {
            (!reader.is_at_end()).then(|| reader.task())
        }))
    }
}

#[cfg(feature = "defmt")]
impl defmt::Format for Ids<'_> {
    fn format(&self, f: defmt::Formatter<'_>) {
        for id in self.iter() {
            defmt::write!(f, "{} ", id);
        }
    }
}

impl PartialEq for Ids<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.iter().eq(other.iter())
    }
}
