//! The ids of tasks on a link.

/// The number of a task on one link. Rises with each `Start` that a node takes since its boot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkId(pub u32);
