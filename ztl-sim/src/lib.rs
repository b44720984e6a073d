//! Simulated devices and lines with faults, to try a gateway without hardware.

mod device;
mod disk;
pub mod line;
#[cfg(unix)]
mod pty;
mod random;

pub use device::kind::{Kind, UnknownKind};
pub use device::{BOARD, Bus, BusNode, Buttons, Device, Running, Switches, endpoint};
pub use disk::Disk;
