//! ZTL for the firmware of smart actuators, without `std` and without an allocator.
//!
//! Implement [`Component`] for each moving part, or use the ready ones in `components` (feature `components`)
//! for servos, steppers and plain pins. Pass them to a [`Node`], feed it the bytes that arrive and send the
//! bytes it returns. The gateway (`ztl gateway`) does the rest.
//!
//! ```
//! use ztl_mcu::{Component, Identity, Node, Refused, Report, Run};
//! use ztl_mcu::link::Offer;
//! use ztl_mcu::Instant;
//!
//! /// A lamp that switches immediately.
//! struct Lamp { on: bool }
//!
//! impl Component for Lamp {
//!     fn offer(&self) -> Offer<'_> {
//!         Offer::new("lamp").with_words("on off")
//!     }
//!     fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
//!         if !["on", "off"].contains(&goal) {
//!             why.text("lamp takes on or off");
//!             return Err(Refused);
//!         }
//!         Ok(())
//!     }
//!     fn start(&mut self, _now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
//!         self.on = goal == "on";
//!         Ok(())
//!     }
//!     fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
//!         report.text(if self.on { "on" } else { "off" });
//!         Run::Completed
//!     }
//!     fn abort(&mut self, _now: Instant) {}
//!     fn make_safe(&mut self, _now: Instant) {
//!         self.on = false;
//!     }
//! }
//!
//! # fn boots() -> u32 { 4711 }
//! // A number that changes with each boot: random, or a counter in flash. At most 2 tasks and frames of
//! // 128 bytes.
//! let identity = Identity::new("desk", "1.0.0", boots());
//! let mut node = Node::<_, 2, 128>::new(identity, [Lamp { on: false }]);
//!
//! // The main loop: feed bytes, advance time, send bytes.
//! let now = Instant::from_millis(0);
//! node.handle_bytes(now, &[0x00]);
//! node.handle_timeout(now);
//! let mut bytes = [0; 64];
//! let sent = node.poll_transmit(now, &mut bytes);
//! assert!(sent > 0, "announces itself");
//! ```
//!
//! # Overview
//!
//! | to | use | feature |
//! |---|---|---|
//! | move a part | [`Component`]; ready ones for `embedded-hal` in `components` | `components` |
//! | work without a task: control loops, status lights | [`Component::next_tick`] | |
//! | move a part with an async driver (`embedded-hal-async`) | `driver` | `async`, `critical-section` |
//! | parse goals into structs, enums, numbers | `parse_goal` | `serde` (default) |
//! | say which goals it takes and what they do | [`describe`] | |
//! | have values that people set and save: calibrations, limits | [`parameters`](mod@parameters) | |
//! | learn whether a gateway is there | [`Node::link`] | |
//! | start tasks from a button, report events | [`Acting`], [`Node::start_here`], [`Node::report_event`] | |
//! | report results as structs | [`Report`]`::value` | `serde` (default) |
//! | report results longer than 48 bytes | [`Component::result`] | |
//! | publish readings | [`Component::poll_reading`], [`Latest`], [`Queued`] | |
//! | run the main loop on a serial port | [`pump::Pump`]; as a future, `Pump::run` | `async` for the future |
//! | use a port of a HAL on `embedded-io` 0.6 | `pump::Io06` | `embedded-io-06` |
//! | share data with interrupts | `shared`: received bytes (also by DMA), emergency stop, limit switches, log | `critical-section` |
//! | take firmware updates over the link | [`update::Updatable`]; with the bootloader `embassy-boot`, `update::Slots` | `embassy-boot` for the latter |
//! | share a half-duplex line with other nodes (RS-485) | [`bus`] | |
//! | send defmt's log over the link | `defmt_logger!` | `defmt` |
//! | use the protocol directly | [`link`], and `docs/link.md` | |
//! | serve clients without a gateway, over TCP or USB | `zmtp`, and `docs/zmtp.md` | `zmtp` |
#![no_std]

#[cfg(test)]
extern crate std;

mod acting;
pub mod bus;
mod component;
#[cfg(feature = "components")]
pub mod components;
pub mod describe;
#[cfg(all(feature = "async", feature = "critical-section"))]
pub mod driver;
#[cfg(feature = "serde")]
mod goal;
pub mod log;
mod node;
pub mod parameters;
#[cfg(feature = "critical-section")]
mod pieces;
pub mod pump;
mod reading;
#[cfg(feature = "critical-section")]
pub mod shared;
pub mod update;
#[cfg(feature = "zmtp")]
pub mod zmtp;

pub use acting::{Acting, OwnWork};
pub use component::{Component, Components, Reading, Refused, Report, Run};
#[cfg(feature = "serde")]
pub use goal::parse_goal;
pub use node::{Counters, Identity, LinkUp, Node, Reason};
pub use reading::{Latest, NotKept, Queued};
#[cfg(feature = "serde")]
pub use ztl_core::goal::WriteError;
pub use ztl_core::{Instant, description, goal_fields, link};
