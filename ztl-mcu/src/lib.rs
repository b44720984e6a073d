//! Firmware of a smart actuator as a ZTL handler, without `std` and without an allocator.
//!
//! Implement [`Component`] for each thing that moves (servos, steppers and plain pins are ready in `components`,
//! with the feature of that name), give them to a [`Node`], feed it the bytes that arrive and send those
//! it returns. The gateway (`ztl gateway`) does the rest.
//!
//! ```
//! use ztl_mcu::{Component, Identity, Node, Refused, Report, Run};
//! use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
//! use ztl_mcu::Instant;
//!
//! /// A lamp that is switched at once.
//! struct Lamp { on: bool }
//!
//! impl Component for Lamp {
//!     fn offer(&self) -> Offer<'_> {
//!         let goal = GoalShape { range: None, unit: "", words: "on off" };
//!         Offer { name: "lamp", goal, busy: Busy::Refuse, loss: Loss::Abort, topics: "" }
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
//! // Another number at each boot: random, or counted in flash. At most 2 tasks, frames of at most
//! // 128 bytes.
//! let identity = Identity::new("desk", "1.0.0", boots());
//! let mut node = Node::<_, 2, 128>::new(identity, [Lamp { on: false }]);
//!
//! // The main loop: bytes in, time passes, bytes out.
//! let now = Instant::from_millis(0);
//! node.handle_bytes(now, &[0x00]);
//! node.handle_timeout(now);
//! let mut bytes = [0; 64];
//! let sent = node.poll_transmit(now, &mut bytes);
//! assert!(sent > 0, "it announces itself");
//! ```
//!
//! # What is where
//!
//! | for | look at | feature |
//! |---|---|---|
//! | what moves | [`Component`]; `components` has ready ones on `embedded-hal` | `components` |
//! | goals that are structs, enums, numbers | `Actuator`, `Typed` | `serde` (default) |
//! | readings that are published | [`Component::poll_reading`], [`Latest`], [`Queued`] | |
//! | the main loop on a serial port | [`pump::Pump`]; as a future, `Pump::run` | `async` for that |
//! | what interrupts share with it | `shared`: received bytes, emergency stop, limit switches, log | `critical-section` |
//! | defmt's log over the link | `defmt_logger!` | `defmt` |
//! | the protocol itself | [`link`], and `docs/link.md` | |
//! | clients without a gateway, over TCP or USB | `zmtp`, and `docs/zmtp.md` | `zmtp` |
#![no_std]

#[cfg(test)]
extern crate std;

mod component;
#[cfg(feature = "components")]
pub mod components;
pub mod log;
mod node;
pub mod pump;
mod reading;
#[cfg(feature = "critical-section")]
pub mod shared;
#[cfg(feature = "serde")]
mod typed;
#[cfg(feature = "zmtp")]
pub mod zmtp;

pub use component::{Component, Components, Reading, Refused, Report, Run};
pub use node::{Counters, Identity, Node, Reason};
pub use reading::{Latest, NotKept, Queued};
#[cfg(feature = "serde")]
pub use typed::{Actuator, Typed};
pub use ztl_core::{Instant, link};
