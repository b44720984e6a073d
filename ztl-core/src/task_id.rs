//! The ids of tasks.

/// The number that a server assigns to an accepted task, from 1 to `u32::MAX`; never reused while the server
/// runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TaskId(core::num::NonZeroU32);

impl TaskId {
    /// The id with this number, or `None` for 0, which means "not accepted" on the wire.
    #[must_use]
    pub const fn new(number: u32) -> Option<Self> {
        match core::num::NonZeroU32::new(number) {
            Some(number) => Some(Self(number)),
            None => None,
        }
    }

    /// The highest id.
    pub const MAX: Self = Self(core::num::NonZeroU32::MAX);

    /// The number as sent on the wire.
    #[must_use]
    pub const fn get(self) -> u32 {
        self.0.get()
    }

    /// The next id, or `None` after the last one: ids are never reused.
    #[must_use]
    pub fn next(self) -> Option<Self> {
        self.0.checked_add(1).map(Self)
    }
}

impl core::fmt::Display for TaskId {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.get().fmt(f)
    }
}
