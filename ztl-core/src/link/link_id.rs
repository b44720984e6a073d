//! The ids of tasks on a link.

/// The id of a task on one link. Increases with each `Start` that a node executes since its boot. Tasks that a node starts
/// [itself](LinkId::is_local) have numbers of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkId(pub u32);

/// The highest bit: set in the ids of tasks that a node starts itself.
const LOCAL: u32 = 1 << 31;

impl LinkId {
    /// The id of the `count`th task that a node starts itself since its boot (`docs/link.md` [14.1]).
    #[must_use]
    pub const fn local(count: u32) -> Self {
        Self(LOCAL | count)
    }

    /// Whether the node started the task itself.
    #[must_use]
    pub const fn is_local(self) -> bool {
        self.0 >= LOCAL
    }
}
