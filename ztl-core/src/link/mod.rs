//! The link between a gateway and a microcontroller: frames and messages.
//!
//! A byte stream that may lose, corrupt, repeat and hold back bytes carries frames; a frame that
//! arrives whole and unaltered is a message, every other is dropped and counted. `docs/link.md` is
//! the numbered specification. The two ends are `ztl_mcu::Node` and the gateway's session; what
//! both need stands here.

mod body;
mod codec;
mod frame;
mod ids;
mod link_id;
mod wire;

pub use body::{Body, Busy, Command, GoalShape, Hello, Loss, Offer, Welcome};
pub use frame::{
    ADDR_ONLY_NODE, CommandFrame, Decoder, Frame, FrameError, FrameWriter, OVERHEAD, Pushed, encode,
};
pub use ids::Ids;
pub use link_id::LinkId;
pub use wire::BodyError;

use core::ops::RangeInclusive;
use core::time::Duration;

/// Version of the link protocol, told in `Hello`, `Welcome` and `Awake`.
pub const VERSION: u8 = 1;

/// Longest time a node goes without a new command before it acts by itself, unless its firmware
/// says otherwise.
pub const LINK_TIMEOUT: Duration = Duration::from_secs(1);

/// Link timeouts that a gateway takes: a shorter one leaves no time for its pings, a longer one
/// leaves tasks without an end for too long.
pub const LINK_TIMEOUTS: RangeInclusive<Duration> =
    Duration::from_millis(50)..=Duration::from_secs(60);

/// The session under which `Hello` and `Awake` are checked; `Welcome` is checked under the number
/// that the `Hello` brought, everything else under [`session_key`].
pub const NO_SESSION: u32 = 0;

/// The `seq` of a `Hello` and of every frame that answers no command.
pub const NO_SEQ: u8 = 0;

/// This number, or another where it cannot be a session's: 0 is [`NO_SESSION`], and all ones leave the
/// register of the check at zero, so that a zero before or at the start of a frame goes unnoticed.
#[must_use]
pub const fn session_number(number: u32) -> u32 {
    match number {
        NO_SESSION => 1,
        u32::MAX => 2,
        number => number,
    }
}

/// The session under which all but `Hello`, `Awake` and `Welcome` is checked: the number of the
/// `Hello` and the boot id of the `Welcome` together, as a [`session_number`].
///
/// Without the boot id, a `Welcome` that a line held back while its node was reset could open a
/// session with the reborn node under the old one's name.
#[must_use]
pub const fn session_key(hello: u32, boot: u32) -> u32 {
    session_number(hello ^ boot)
}

/// The `seq` of the command after the one with this `seq`; 0 is left out.
#[must_use]
pub const fn next_seq(seq: u8) -> u8 {
    match seq.wrapping_add(1) {
        NO_SEQ => 1,
        next => next,
    }
}

#[cfg(test)]
mod tests;
