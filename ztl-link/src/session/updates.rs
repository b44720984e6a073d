//! Sends firmware updates to a device (`docs/link.md`, section 16).

use std::collections::VecDeque;

use ztl_core::Instant;
use ztl_core::link::update::UpdateMessage;
use ztl_core::link::{Body, NO_SESSION};

use super::{CommandKind, Session};
use crate::event::LinkEvent;
use crate::journal::SessionJournal;
use crate::updates::{UpdateAnswer, UpdateFailure, UpdateReply, UpdateRequest};

/// The requests of a session.
#[derive(Debug, Clone, Default)]
pub(crate) struct Updates {
    /// The one in flight, and those that wait, each with its number.
    asked: Option<(u64, UpdateRequest)>,
    waiting: VecDeque<(u64, UpdateRequest)>,
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
                if self.describe_again(now) {
                    self.updates.waiting.push_front((number, request));
                    return true;
                }
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
