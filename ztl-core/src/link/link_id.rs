//! The ids of tasks on a link.

/// The id of a task on one link. Increases with each `Start` that a node executes since its boot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkId(pub u32);
