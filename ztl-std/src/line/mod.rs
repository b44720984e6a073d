//! A line with faults between any two ends: for trying what a gateway and its devices do on a bad
//! cable.
//!
//! [`FaultyLine`] is one direction of it, without I/O; [`Cable`] joins two real ends by two of
//! them.

mod cable;
mod dice;
mod end;
mod faults;

pub use cable::{Cable, CableError};
#[cfg(test)]
pub(crate) use dice::Dice;
pub use end::{End, EndError};
pub use faults::{Counts, Faults, FaultyLine};

/// A seed from the operating system.
#[must_use]
pub fn random_seed() -> u64 {
    // Short enough to be typed again.
    u64::from(crate::random::nonzero())
}
