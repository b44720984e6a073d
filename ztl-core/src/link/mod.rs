//! The link between a gateway and a microcontroller: frames and messages.
//!
//! Frames travel over a byte stream that may lose, corrupt, repeat and delay bytes. A frame that arrives intact is a
//! message; all others are dropped and counted. `docs/link.md` is the specification. The two ends are `ztl_mcu::Node` and
//! `ztl_link::Session`; this module has the parts that they share.

mod body;
mod bus;
mod codec;
mod decoder;
mod frame;
mod ids;
mod link_id;
pub mod parameter;
pub mod update;
mod wire;

pub use body::{Body, Busy, GoalShape, Hello, LinkCommand, Loss, Offer, OwnAnswer, Welcome};
pub use bus::{ADDR_ALL, ADDR_MOST, ADDR_NONE, BusMessage, Turn};
pub use decoder::{Decoder, Pushed};
pub use frame::{ADDR_ONLY_NODE, CommandFrame, Frame, FrameError, FrameWriter, encode};
pub use ids::Ids;
pub use link_id::LinkId;
pub use wire::BodyError;

use core::ops::RangeInclusive;
use core::time::Duration;

/// Version of the link protocol, sent in `Hello`, `Welcome` and `Awake`.
pub const VERSION: u8 = 1;

/// Default for how long a node goes without a new command before it considers the link lost.
pub const LINK_TIMEOUT: Duration = Duration::from_secs(1);

/// Link timeouts that a gateway accepts: a shorter one leaves no time for pings, a longer one delays the final states of
/// tasks for too long.
pub const LINK_TIMEOUTS: RangeInclusive<Duration> =
    Duration::from_millis(50)..=Duration::from_secs(60);

/// Longest decoded frame that a gateway accepts, in bytes: its body has at most 1094 (`docs/link.md` [2.3]).
pub const LONGEST_FRAME: usize = 1100;

/// Most bytes of a description in one message (`docs/link.md` [4.6]), so that no answer waits long for it.
pub const DESCRIPTION_PART: usize = 48;

/// The session of `Hello` and `Awake` in the checksum. That of `Welcome` is the number in the `Hello`; that of all other
/// messages is the [`session_key`].
pub const NO_SESSION: u32 = 0;

/// Sequence number of a `Hello`, and of every frame that is neither a command nor an answer.
pub const NO_SEQ: u8 = 0;

/// Replaces the numbers that a session cannot have: 0 is [`NO_SESSION`], and with all ones the CRC register becomes zero,
/// so that the checksum misses additional zeros at the start of a frame.
#[must_use]
pub const fn session_number(number: u32) -> u32 {
    match number {
        NO_SESSION => 1,
        u32::MAX => 2,
        number => number,
    }
}

/// The session of all messages but `Hello`, `Awake` and `Welcome` in the checksum: combines the number in the `Hello` and
/// the boot id in the `Welcome`, as a [`session_number`].
///
/// Without the boot id, a `Welcome` that was delayed while its node was reset could open a session with the new boot under
/// the identity of the old one.
#[must_use]
pub const fn session_key(hello: u32, boot: u32) -> u32 {
    session_number(hello ^ boot)
}

/// The sequence number of the next command; skips 0.
#[must_use]
pub const fn next_seq(seq: u8) -> u8 {
    match seq.wrapping_add(1) {
        NO_SEQ => 1,
        next => next,
    }
}

#[cfg(test)]
mod tests;
