//! Sends firmware updates to a device (`docs/link.md`, section 16).

use std::collections::VecDeque;

use ztl_core::Instant;
use ztl_core::link::update::{Firmware, PIECE_UNIT, UpdateCommand, UpdateMessage, UpdatePhase};
use ztl_core::link::{Body, NO_SESSION};

use crate::device::DeviceInfo;
use crate::event::LinkEvent;
use crate::journal::SessionJournal;
use crate::state::{CommandKind, Session};

/// Longest piece for a node on a shared line: 16 nodes with tasks have their turn every 50 ms also while one is updated.
const SHARED_PIECE: usize = 2 * PIECE_UNIT;

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
        /// The bytes, at most [`longest_piece`](DeviceInfo::longest_piece).
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
    fn command(&self) -> UpdateCommand<'_> {
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

/// The requests of a session.
#[derive(Debug, Clone, Default)]
pub(crate) struct Updates {
    /// The one in flight, and those that wait, each with its number.
    asked: Option<(u64, UpdateRequest)>,
    waiting: VecDeque<(u64, UpdateRequest)>,
}

impl DeviceInfo {
    /// Most bytes of an image in one message; 0 if the device takes none.
    #[must_use]
    pub const fn longest_piece(&self) -> usize {
        // Tag, offset and length take at most 8 bytes.
        let room = self.max_body.saturating_sub(8);
        let whole = room - room % PIECE_UNIT;
        // A longer one would delay the turns of other nodes.
        if self.shared && whole > SHARED_PIECE {
            SHARED_PIECE
        } else {
            whole
        }
    }
}

impl<J: SessionJournal> Session<J> {
    /// Asks the device about its firmware, or sends a part of an update. The answer follows as [`LinkEvent::Update`] with this
    /// number. Aborts and starts go first.
    pub fn request_update(&mut self, now: Instant, number: u64, request: UpdateRequest) {
        if !self.answers() && self.ending == NO_SESSION {
            return self.answer_update(number, Err(UpdateFailure::Lost));
        }
        self.updates.waiting.push_back((number, request));
        self.next_command(now);
    }

    fn answer_update(&mut self, number: u64, answer: UpdateAnswer) {
        self.events.push_back(LinkEvent::Update(number, answer));
    }

    /// Sends the next request, if there is one. Returns whether a command is in flight now.
    pub(crate) fn send_update_request(&mut self, now: Instant) -> bool {
        while let Some((number, request)) = self.updates.waiting.pop_front() {
            let known = self.device.as_ref().filter(|device| device.updates);
            let Some(most) = known.map(|device| device.max_body) else {
                self.answer_update(number, Err(UpdateFailure::NoUpdates));
                continue;
            };
            let body = Body::Update(UpdateMessage::Command(request.command()));
            let mut len = 0;
            body.put(&mut |bytes: &[u8]| len += bytes.len());
            if len > most {
                self.answer_update(number, Err(UpdateFailure::TooLong));
                continue;
            }
            self.command(now, CommandKind::Update, body);
            self.updates.asked = Some((number, request));
            return true;
        }
        false
    }

    /// Handles the answer to the request in flight. Returns `false` if it is the answer to something else.
    pub(crate) fn on_update_answer(&mut self, body: &Body<'_>) -> bool {
        let Some((number, request)) = &self.updates.asked else {
            return false;
        };
        let answer = match (request, *body) {
            (UpdateRequest::Read, Body::Update(UpdateMessage::Firmware(firmware))) => {
                Ok(UpdateReply::Firmware(firmware.into()))
            }
            (UpdateRequest::Read, Body::Update(_)) => return false,
            (_, Body::Update(UpdateMessage::Phase(phase))) => Ok(UpdateReply::Phase(phase)),
            (_, Body::Refused { reason }) => Err(UpdateFailure::Refused(reason.to_owned())),
            _ => return false,
        };
        let number = *number;
        self.updates.asked = None;
        self.answer_update(number, answer);
        true
    }

    /// Fails all requests, because the session is lost or the device was reset.
    pub(crate) fn fail_update_requests(&mut self) {
        let Updates { asked, waiting } = std::mem::take(&mut self.updates);
        for (number, _) in asked.into_iter().chain(waiting) {
            self.answer_update(number, Err(UpdateFailure::Lost));
        }
    }
}
