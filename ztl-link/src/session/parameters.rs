//! Reads, sets and saves the parameters of a device (`docs/link.md`, section 13).

use ztl_core::Instant;
use ztl_core::link::parameter::{ParameterCommand, ParameterMessage};
use ztl_core::link::{Body, NO_SESSION};

use super::{CommandKind, Session};
use crate::event::LinkEvent;
use crate::journal::SessionJournal;
use crate::parameters::{ParameterAnswer, ParameterFailure, ParameterInfo, ParameterRequest};

impl<J: SessionJournal> Session<J> {
    /// Asks the device about its parameters. The answer follows as [`LinkEvent::Parameter`] with this number. Aborts and
    /// starts go first. A request is never repeated in another session, so it is carried out at most once.
    pub fn request_parameter(&mut self, now: Instant, number: u64, request: ParameterRequest) {
        if !self.answers() && self.ending == NO_SESSION {
            let reason = "the device is not answering";
            return self.answer(number, Err(ParameterFailure::NotSent(reason)));
        }
        self.parameter_requests.push_back((number, request));
        self.next_command(now);
    }

    fn answer(&mut self, number: u64, answer: ParameterAnswer) {
        self.events.push_back(LinkEvent::Parameter(number, answer));
    }

    /// Sends the next request, if there is one. Returns whether a command is in flight now.
    pub(crate) fn send_parameter_request(&mut self, now: Instant) -> bool {
        while let Some((number, request)) = self.parameter_requests.pop_front() {
            let known = self.device.as_ref().filter(|it| it.parameters > 0);
            let Some(most) = known.map(|device| device.max_body) else {
                if self.describe_again(now) {
                    self.parameter_requests.push_front((number, request));
                    return true;
                }
                self.answer(number, Err(ParameterFailure::NoParameters));
                continue;
            };
            let command = match &request {
                ParameterRequest::Read(index) => ParameterCommand::Read { index: *index },
                ParameterRequest::Set(index, value) => ParameterCommand::Set {
                    index: *index,
                    value: value.as_value(),
                },
                ParameterRequest::Save => ParameterCommand::Save,
            };
            let body = Body::Parameter(ParameterMessage::Command(command));
            let mut len = 0;
            body.put(&mut |bytes: &[u8]| len += bytes.len());
            if len > most {
                let reason = "the value is longer than the device takes";
                self.answer(number, Err(ParameterFailure::NotSent(reason)));
                continue;
            }
            self.command(now, CommandKind::Parameter, body);
            self.parameter_asked = Some((number, request));
            return true;
        }
        false
    }

    /// Handles the answer to the request in flight. Returns `false` if it is the answer to something else.
    pub(crate) fn on_parameter_answer(&mut self, body: &Body<'_>) -> bool {
        let Some((number, request)) = &self.parameter_asked else {
            return false;
        };
        let answer = match (request, *body) {
            (
                ParameterRequest::Read(asked) | ParameterRequest::Set(asked, _),
                Body::Parameter(ParameterMessage::Is(parameter)),
            ) if parameter.index == *asked => {
                let info = ParameterInfo::from(parameter);
                if let Some(device) = &mut self.device {
                    device.note_parameter((*asked).into(), &info);
                }
                Ok(Some(info))
            }
            (ParameterRequest::Save, Body::Parameter(ParameterMessage::Saved)) => Ok(None),
            (_, Body::Refused { reason }) => Err(ParameterFailure::Refused(reason.to_owned())),
            _ => return false,
        };
        let number = *number;
        self.parameter_asked = None;
        self.answer(number, answer);
        true
    }

    /// Fails all requests, because the session is lost.
    pub(crate) fn fail_parameter_requests(&mut self) {
        if let Some((number, _)) = self.parameter_asked.take() {
            self.answer(number, Err(ParameterFailure::Unknown));
        }
        for (number, _) in std::mem::take(&mut self.parameter_requests) {
            let reason = "the link was lost before";
            self.answer(number, Err(ParameterFailure::NotSent(reason)));
        }
    }
}
