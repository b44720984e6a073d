//! A line with faults between any two ends, to test how a gateway and its devices behave on a bad cable.
//!
//! [`FaultyLine`] is one direction, without I/O. [`Cable`] joins two real ends with two of them. [`HalfDuplex`] and
//! [`SharedCable`] are the same for a shared line.

mod cable;
mod dice;
mod end;
mod faults;
mod half_duplex;

pub use cable::{Cable, CableError, SharedCable};
pub use dice::Dice;
pub use end::{End, EndError};
pub use faults::{Counts, Faults, FaultyLine};
pub use half_duplex::{HalfDuplex, Heard};

/// A random seed.
#[must_use]
pub fn random_seed() -> u64 {
    // 32 bits only, so that it is short enough to type.
    u64::from(crate::random::random())
}
