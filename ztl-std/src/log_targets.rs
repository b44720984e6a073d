//! The names under which this library logs.

/// Task servers and clients, as the original names them.
pub(crate) const TASKS: &str = "remote-task";
/// Publishers and subscribers, as the original names them.
#[cfg(feature = "publish")]
pub(crate) const PUBLISHER: &str = "object-publisher";
#[cfg(feature = "publish")]
pub(crate) const SUBSCRIBER: &str = "object-subscriber";
/// The gateway.
#[cfg(feature = "gateway")]
pub(crate) const GATEWAY: &str = "gateway";
/// Messages of a device's firmware.
#[cfg(feature = "defmt")]
pub(crate) const FIRMWARE: &str = "firmware";
