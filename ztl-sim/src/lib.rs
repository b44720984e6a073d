//! Simulated devices and lines with faults, to try a gateway without hardware.

mod device;
pub mod line;
#[cfg(unix)]
mod pty;

pub use device::{Device, Kind, Running, UnknownKind, endpoint};

/// A random number that is not 0; 1 where the system has none. Not for secrets.
fn random() -> u32 {
    getrandom::u32().map_or(1, |number| number.max(1))
}
