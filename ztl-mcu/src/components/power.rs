//! Whether a motor keeps its power.

use ztl_core::link::Loss;

/// Whether a motor at rest stays under power.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Power {
    /// It holds its position.
    Hold,
    /// It lets go; a hand or a weight can turn it.
    Release,
}

impl Power {
    /// The policy on a lost link of a component with this safe state.
    pub(super) const fn loss(self) -> Loss {
        match self {
            Self::Hold => Loss::Hold,
            Self::Release => Loss::Abort,
        }
    }
}
