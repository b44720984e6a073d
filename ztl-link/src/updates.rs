//! Firmware of a device, and requests about it.

use ztl_core::link::update::{Firmware, UpdateCommand, UpdatePhase};

/// The firmware that a device runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FirmwareInfo {
    /// The board that images must be for.
    pub board: String,
    /// Its version.
    pub version: String,
    /// Whether it was confirmed; if not, it is on trial.
    pub confirmed: bool,
    /// The index of the component and the goal of the task that tests it, if there is one.
    pub self_test: Option<(u8, String)>,
}

impl From<Firmware<'_>> for FirmwareInfo {
    fn from(firmware: Firmware<'_>) -> Self {
        let test = firmware.self_test;
        Self {
            board: firmware.board.to_owned(),
            version: firmware.version.to_owned(),
            confirmed: firmware.confirmed,
            self_test: test.map(|test| (test.component, test.goal.to_owned())),
        }
    }
}

/// What to do with the firmware of a device. Each request may be repeated.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum UpdateRequest {
    /// Ask what runs.
    Read,
    /// Begin to send an image, or go on after a break.
    Begin {
        /// Whether to end the tasks that run.
        now: bool,
        /// Whether the image may be older than what runs.
        downgrade: bool,
        /// The signed manifest.
        manifest: Vec<u8>,
    },
    /// Send the next piece.
    Write {
        /// Where it belongs.
        offset: u32,
        /// The bytes, at most [`longest_piece`](crate::DeviceInfo::longest_piece).
        bytes: Vec<u8>,
    },
    /// Ask how far the device is.
    Ask,
    /// The image is complete.
    Finish,
    /// Run it.
    Restart,
    /// Keep what runs.
    Confirm,
    /// Stop receiving.
    Cancel,
}

impl UpdateRequest {
    pub(crate) fn command(&self) -> UpdateCommand<'_> {
        match self {
            Self::Read => UpdateCommand::Read,
            Self::Begin {
                now,
                downgrade,
                manifest,
            } => UpdateCommand::Begin {
                now: *now,
                downgrade: *downgrade,
                manifest,
            },
            Self::Write { offset, bytes } => UpdateCommand::Write {
                offset: *offset,
                bytes,
            },
            Self::Ask => UpdateCommand::Ask,
            Self::Finish => UpdateCommand::Finish,
            Self::Restart => UpdateCommand::Restart,
            Self::Confirm => UpdateCommand::Confirm,
            Self::Cancel => UpdateCommand::Cancel,
        }
    }
}

/// The answer of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum UpdateReply {
    /// What runs.
    Firmware(FirmwareInfo),
    /// How far the update is.
    Phase(UpdatePhase),
}

/// Why a request about updates has failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum UpdateFailure {
    /// The firmware takes no updates, or is older than updates.
    NoUpdates,
    /// The manifest is longer than the device takes.
    TooLong,
    /// The link was lost before the answer, or is down.
    Lost,
    /// The device refuses it, for this reason.
    Refused(String),
}

/// The answer to a request.
pub type UpdateAnswer = Result<UpdateReply, UpdateFailure>;
