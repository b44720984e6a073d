//! The names under which this library logs.

/// Task servers and clients, as the original names them.
pub(crate) const TASKS: &str = "remote-task";
/// The gateway.
#[cfg(feature = "gateway")]
pub(crate) const GATEWAY: &str = "gateway";
/// Messages of a device's firmware.
#[cfg(feature = "defmt")]
pub(crate) const FIRMWARE: &str = "firmware";
