//! Handles frames of the device.

use std::time::Duration;

use ztl_core::link::parameter::NO_COMPONENT;
use ztl_core::link::update::TAKES_UPDATES;
use ztl_core::link::{
    Body, DESCRIPTION_PART, Frame, FrameError, LINK_TIMEOUTS, LinkId, NO_SEQ, NO_SESSION, VERSION,
    Welcome, session_key,
};
use ztl_core::{Instant, State, TaskId};

use super::doubt::of_other;
use super::send::frame_bytes;
use super::{CommandKind, Phase, Session};
use crate::device::{ComponentInfo, DeviceInfo};
use crate::event::LinkEvent;
use crate::journal::SessionJournal;
use crate::task::{Stage, Task};

/// Pause before a new session with a device that answered nonsense.
const BAD_ANSWER: Duration = Duration::from_secs(1);

impl<J: SessionJournal> Session<J> {
    pub(crate) fn on_frame(&mut self, now: Instant, frame: Result<(usize, Frame<'_>), FrameError>) {
        let (session_index, frame) = match frame {
            Ok(frame) => frame,
            Err(error) => return self.counters.count(error),
        };
        self.counters.frames += 1;
        match (session_index, frame.seq, frame.body) {
            (1, NO_SEQ, Body::Awake { boot, .. }) => self.on_awake(now, boot),
            (0, NO_SEQ, Body::Welcome(welcome)) => self.on_welcome(now, &welcome),
            (0, NO_SEQ, Body::Refused { reason }) if self.phase == Phase::Greeting => {
                self.events
                    .push_back(LinkEvent::DeviceUnusable(reason.to_owned()));
            }
            (
                0,
                NO_SEQ,
                Body::Ended {
                    task,
                    state,
                    result,
                },
            ) => {
                // The checksum covers the session, so the id is of this boot.
                match self.find(task) {
                    Some(id) if !self.end(now, id, state, result) => return,
                    Some(_) => {}
                    // Its clients have no id for it yet: it must be taken up first [14.4].
                    None if task.is_local() && !self.was_taken_up(task) => return,
                    None => self.counters.duplicates += 1,
                }
                let ack = frame_bytes(self.address, self.session, NO_SEQ, Body::Ack { task });
                self.out.extend_from_slice(&ack);
            }
            (0, NO_SEQ, Body::Progress { task, text }) => {
                if let Some(id) = self.find(task) {
                    self.on_own_heard(now, task);
                    self.events
                        .push_back(LinkEvent::Progress(id, text.to_owned()));
                }
            }
            (
                0,
                NO_SEQ,
                Body::Begun {
                    task,
                    component,
                    goal,
                },
            ) => self.on_begun(now, task, component, goal),
            (0, NO_SEQ, Body::Event { number, text }) => self.on_event(number, text),
            (0 | 2, NO_SEQ, Body::Publish { topic, bytes }) => {
                self.events
                    .push_back(LinkEvent::Reading(topic, bytes.to_vec()));
            }
            (0 | 2, NO_SEQ, Body::Log { lost, bytes }) => {
                let bytes = bytes.to_vec();
                self.events.push_back(LinkEvent::Log { lost, bytes });
            }
            (0, seq, body) if seq != NO_SEQ => self.on_answer(now, seq, &body),
            // An echo of an own frame.
            _ => {}
        }
    }

    /// Handles the announcement of a reset device: greets it at once.
    pub(crate) fn on_awake(&mut self, now: Instant, boot: u32) {
        let known = self.device.as_ref().map(|device| device.boot);
        match self.phase {
            Phase::Greeting => {
                let pause = self.repeat_pause();
                if let Some(in_flight) = &mut self.in_flight {
                    self.out.extend_from_slice(&in_flight.bytes);
                    in_flight.repeat = now + pause;
                }
            }
            // A late announcement of the current boot changes nothing.
            Phase::Describing | Phase::Up if known != Some(boot) => {
                if self.doubts_announcement(now, boot) {
                    return;
                }
                self.lose();
                self.greet(now);
            }
            _ => {}
        }
    }

    pub(crate) fn on_welcome(&mut self, now: Instant, welcome: &Welcome<'_>) {
        if self.phase != Phase::Greeting {
            return;
        }
        if welcome.version != VERSION {
            let reason = format!("it speaks version {} of the link", welcome.version);
            self.events.push_back(LinkEvent::DeviceUnusable(reason));
            return;
        }
        let link_timeout = Duration::from_millis(u64::from(welcome.link_timeout_ms));
        if !LINK_TIMEOUTS.contains(&link_timeout) {
            let reason = format!(
                "link timeout {link_timeout:?} is out of range ({:?} to {:?})",
                LINK_TIMEOUTS.start(),
                LINK_TIMEOUTS.end()
            );
            self.events.push_back(LinkEvent::DeviceUnusable(reason));
            return;
        }
        if self.doubts_welcome(now, welcome) {
            return;
        }
        self.session = session_key(self.session, welcome.boot);
        self.ending = NO_SESSION;
        self.clock = Some((welcome.clock_ms, now));
        // The link timer of the device still runs from an earlier command.
        self.heard = now;
        let before = self.device.take();
        let was_known = before.is_some();
        // A device that replaces no session was reset, even if its firmware uses the same boot id again.
        let same_boot = |device: &DeviceInfo| device.boot == welcome.boot && welcome.replaces != 0;
        let known = before.filter(same_boot);
        self.counters.resets += u64::from(was_known && known.is_none());
        self.highest = welcome.highest;
        if known.is_none() {
            self.next_part = Some(welcome.components);
            (self.lost_part, self.asked_again) = (None, false);
            self.own.on_boot(welcome.replaces);
        }
        self.on_reset(now, welcome);
        let is_known = known.is_some();
        let (components, parameters, known_parameters, updates) = match known {
            Some(it) => (
                it.components,
                it.parameters,
                it.known_parameters,
                it.updates,
            ),
            None => {
                // Their numbers are those of another boot [13.9].
                self.fail_parameter_requests();
                self.fail_update_requests();
                Default::default()
            }
        };
        self.device = Some(DeviceInfo {
            name: welcome.name.to_owned(),
            firmware: welcome.firmware.to_owned(),
            boot: welcome.boot,
            max_body: usize::from(welcome.max_body),
            link_timeout,
            count: welcome.components,
            components,
            parameters,
            known_parameters,
            shared: self.is_shared(),
            updates,
        });
        self.compare_held(now, welcome);
        self.ask_about_own_soon(now);
        self.in_flight = None;
        self.phase = Phase::Describing;
        self.leave_astray(is_known);
        // The first command restarts the link timer of the device.
        self.describe_next(now);
    }

    /// Fails the tasks of an earlier boot.
    pub(crate) fn on_reset(&mut self, now: Instant, welcome: &Welcome<'_>) {
        let gone = |task: &Task| {
            let sent = task.stage.sent();
            sent.is_some_and(|sent| of_other(sent, welcome)) && !self.stays(task, welcome)
        };
        let held: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run() && gone(task))
            .map(|(id, _)| *id)
            .collect();
        if !held.is_empty() {
            self.events.push_back(LinkEvent::Reset);
        }
        for id in held {
            self.end(now, id, State::Failed, "device was reset");
        }
    }

    /// Compares the tasks that the device holds with the known ones.
    pub(crate) fn compare_held(&mut self, now: Instant, welcome: &Welcome<'_>) {
        let held: Vec<LinkId> = welcome.held.iter().collect();
        let ours: Vec<(TaskId, Stage, bool)> = self
            .tasks
            .iter()
            // The device lists no own ones [14.2].
            .filter(|(_, task)| task.may_run() && !task.is_own() && !self.stays(task, welcome))
            .map(|(id, task)| (*id, task.stage, task.restored))
            .collect();
        for (id, stage, restored) in ours {
            match stage {
                Stage::Waiting => {}
                Stage::Sent(sent) if held.contains(&sent.link) => self.on_started(id),
                // Sent in an earlier session and never executed, so it never will be. The client of a
                // restored task may have been told ACCEPTED.
                Stage::Sent(sent) if sent.link.0 > welcome.highest => {
                    let (state, reason) = if restored {
                        let never = "never started: the device had not received it when the gateway restarted";
                        (State::Failed, never)
                    } else {
                        let never = "the device did not take it before the link was lost";
                        (State::Rejected, never)
                    };
                    self.end(now, id, state, reason);
                }
                Stage::Running(sent) if held.contains(&sent.link) => {}
                Stage::Sent(_) | Stage::Running(_) => {
                    let gone = "the device no longer holds the task";
                    self.end(now, id, State::Failed, gone);
                }
            }
        }
        self.strangers = held
            .into_iter()
            .filter(|link| self.find(*link).is_none())
            .collect();
    }

    pub(crate) fn on_started(&mut self, id: TaskId) {
        if let Some(task) = self.tasks.get_mut(&id)
            && let Stage::Sent(sent) = task.stage
            && task.unwritten.is_none()
        {
            task.stage = Stage::Running(sent);
            self.journal.accepted(&task.entry(id));
            self.events.push_back(LinkEvent::Accepted(id));
        }
    }

    pub(crate) fn describe_next(&mut self, now: Instant) {
        let Some(device) = &self.device else { return };
        match u8::try_from(device.components.len()) {
            Ok(index) if index < device.count => {
                self.command(now, CommandKind::Describe(index), Body::Describe { index });
            }
            _ => {
                self.phase = Phase::Up;
                self.events.push_back(LinkEvent::Up);
                self.command(now, CommandKind::Ping, Body::Ping);
            }
        }
    }

    pub(crate) fn on_answer(&mut self, now: Instant, seq: u8, body: &Body<'_>) {
        let Some(in_flight) = self.in_flight.take_if(|in_flight| in_flight.seq == seq) else {
            self.counters.duplicates += 1;
            return;
        };
        self.heard = now;
        self.on_board_answered(now);
        if !in_flight.repeated {
            let measured = now.since(in_flight.sent);
            self.round_trips.add(measured);
            // A moving average over about eight answers.
            self.turnaround = Some(
                self.turnaround
                    .map_or(measured, |mean| (mean * 7 + measured) / 8),
            );
        }
        match (in_flight.command, *body) {
            (CommandKind::Describe(asked), Body::Component { index, offer }) if asked == index => {
                if let Some(device) = &mut self.device {
                    device.components.push(ComponentInfo {
                        name: offer.name.to_owned(),
                        range: offer.goal.range,
                        unit: offer.goal.unit.to_owned(),
                        words: offer
                            .goal
                            .words
                            .split_whitespace()
                            .map(str::to_owned)
                            .collect(),
                        busy: offer.busy,
                        loss: offer.loss,
                        topics: offer.topics.split_whitespace().map(str::to_owned).collect(),
                        description: Vec::new(),
                    });
                }
            }
            (CommandKind::Describe(index), Body::Refused { reason }) => {
                self.lose();
                let reason = format!("component {index}: {reason}");
                self.events.push_back(LinkEvent::DeviceUnusable(reason));
                return self.greet_after(now, BAD_ANSWER);
            }
            (
                CommandKind::DescribePart(asked),
                Body::Description {
                    index,
                    component,
                    bytes,
                },
            ) if asked == index && bytes.len() <= DESCRIPTION_PART => {
                if let Some(device) = &mut self.device {
                    if component == NO_COMPONENT {
                        device.parameters = bytes.first().copied().unwrap_or_default();
                        device.updates = bytes.get(1) == Some(&TAKES_UPDATES);
                    } else if let Some(known) = device.components.get_mut(usize::from(component)) {
                        known.description.extend_from_slice(bytes);
                    }
                }
                self.next_part = index.checked_add(1);
            }
            // Refused: there are no more. Anything else changes nothing either.
            (CommandKind::DescribePart(_), _) => self.next_part = None,
            (CommandKind::Start(id), Body::Started { task })
                if task.0 == self.highest.saturating_add(1) =>
            {
                self.highest = task.0;
                self.on_started(id);
            }
            (CommandKind::Start(id), Body::Refused { reason }) => {
                self.end(now, id, State::Rejected, reason);
            }
            (CommandKind::Ping, Body::Pong { clock_ms, .. }) => self.clock = Some((clock_ms, now)),
            (CommandKind::Parameter, body) if self.on_parameter_answer(&body) => {}
            (CommandKind::Update, body) if self.on_update_answer(&body) => {}
            // The outcome will be reported, or was reported already.
            (CommandKind::Abort(link), Body::Aborting { task }) if task == link => {
                self.on_abort_answered(link);
            }
            (CommandKind::Abort(link), Body::Refused { .. }) => self.on_abort_answered(link),
            // Valid, but not an answer to the command. It is unknown what the device did; a new session
            // finds out.
            _ => {
                self.counters.not_understood += 1;
                self.lose();
                return self.greet_after(now, BAD_ANSWER);
            }
        }
        if self.seq == u8::MAX {
            // The next command would get a number of this session again, and a delayed or repeated frame could fit it [3.1].
            let ending = self.session;
            self.greet(now);
            self.ending = ending;
        } else if self.phase == Phase::Describing {
            self.describe_next(now);
        } else {
            self.next_command(now);
        }
    }

    fn on_abort_answered(&mut self, link: LinkId) {
        if let Some(task) = self.find(link).and_then(|id| self.tasks.get_mut(&id)) {
            task.abort = false;
        }
    }
}
