//! Firmware updates over the link (`docs/link.md`, section 16).

mod codec;
#[cfg(test)]
mod tests;

pub(super) use codec::{FIRST, LAST};

/// Length of a piece of an image: each piece but the last has a multiple of this many bytes, so that a node can write it to
/// its flash as it is.
pub const PIECE_UNIT: usize = 32;

/// Longest body of a [`Firmware`], in bytes: it fits the shortest frame of a node.
pub const LONGEST_FIRMWARE: usize = 120;

/// The flag in [`Description`](super::Body::Description) of [`NO_COMPONENT`](super::parameter::NO_COMPONENT), after the number
/// of parameters, with which a node announces that it takes updates ([16.1]).
pub const TAKES_UPDATES: u8 = 1;

/// Why a node does not take an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdateError {
    /// The manifest is damaged, or of a format that the node does not know.
    Manifest,
    /// The image is for another board.
    Board,
    /// The image is older than the firmware that runs, and a downgrade was not allowed.
    Older,
    /// The image is longer than the room for it.
    TooLong,
    /// The signature does not fit the image and the node's key.
    Signature,
    /// The flash could not be written or read.
    Storage,
    /// The firmware that runs is on trial: it must be confirmed first.
    OnTrial,
    /// An error with this number that this end does not know.
    Unknown(u8),
}

impl UpdateError {
    /// The error with this number on the link.
    #[must_use]
    pub const fn from_code(code: u8) -> Self {
        match code {
            0 => Self::Manifest,
            1 => Self::Board,
            2 => Self::Older,
            3 => Self::TooLong,
            4 => Self::Signature,
            5 => Self::Storage,
            6 => Self::OnTrial,
            _ => Self::Unknown(code),
        }
    }

    /// Its number on the link.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Manifest => 0,
            Self::Board => 1,
            Self::Older => 2,
            Self::TooLong => 3,
            Self::Signature => 4,
            Self::Storage => 5,
            Self::OnTrial => 6,
            Self::Unknown(code) => code,
        }
    }
}

impl core::fmt::Display for UpdateError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Unknown(code) => {
                return write!(
                    f,
                    "the device reports error {code}, which the gateway does not know"
                );
            }
            Self::Manifest => "the manifest is damaged, or of an unknown format",
            Self::Board => "the image is for another board",
            Self::Older => "the image is older than the firmware that runs",
            Self::TooLong => "the image is longer than the room for it",
            Self::Signature => "the signature does not fit the image and the device's key",
            Self::Storage => "the flash cannot be written or read",
            Self::OnTrial => "the firmware that runs is on trial and is not confirmed yet",
        })
    }
}

impl core::error::Error for UpdateError {}

/// How far a node is with an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdatePhase {
    /// It receives nothing: there was no `Begin`, it was cancelled, or the gateway has paused for too long.
    Idle,
    /// Its components go to their safe state; ask again.
    Stopping,
    /// It receives the image: it has all bytes before `offset`.
    Receiving {
        /// The offset of the next piece.
        offset: u32,
    },
    /// It verifies the signature; ask again.
    Verifying,
    /// The image is complete and verified; the next restart runs it.
    Ready,
    /// It restarts soon.
    Restarting,
    /// It does not take the image. Only a new `Begin` leads on.
    Failed(UpdateError),
}

/// A task with which the firmware tests itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SelfTest<'a> {
    /// Index of the component.
    pub component: u8,
    /// The goal.
    pub goal: &'a str,
}

/// The firmware that a node runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Firmware<'a> {
    /// The board that images must be for.
    pub board: &'a str,
    /// Its version.
    pub version: &'a str,
    /// Whether it was confirmed. If not, it is on trial, and the node goes back to the image before at its next restart.
    pub confirmed: bool,
    /// How long it stays on trial after its start, in milliseconds; then the node restarts.
    pub trial_ms: u32,
    /// The task that tests it, if there is one.
    pub self_test: Option<SelfTest<'a>>,
}

/// A command of a gateway about updates, as a node parses it. Each may be repeated in any session without harm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdateCommand<'a> {
    /// Asks what runs; answered by [`UpdateMessage::Firmware`]. All others are answered by [`UpdateMessage::Phase`].
    Read,
    /// Begins to send an image, or goes on after a break.
    Begin {
        /// Whether to end the tasks that run; otherwise the node refuses while there are any.
        now: bool,
        /// Whether the image may be older than what runs.
        downgrade: bool,
        /// The signed manifest.
        manifest: &'a [u8],
    },
    /// The next piece of the image.
    Write {
        /// Where it belongs.
        offset: u32,
        /// The bytes.
        bytes: &'a [u8],
    },
    /// Asks for the phase.
    Ask,
    /// The image is complete: verify it.
    Finish,
    /// Restart, to run the new image.
    Restart,
    /// Keep the firmware that runs.
    Confirm,
    /// Stop receiving.
    Cancel,
}

/// A message about updates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum UpdateMessage<'a> {
    /// Gateway: a command.
    Command(UpdateCommand<'a>),
    /// Node: what runs.
    Firmware(Firmware<'a>),
    /// Node: how far the update is.
    Phase(UpdatePhase),
}
