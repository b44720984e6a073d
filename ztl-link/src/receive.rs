//! What the device says, and what follows from it.

use std::time::Duration;

use ztl_core::link::{
    Body, Frame, FrameError, LINK_TIMEOUTS, LinkId, NO_SEQ, VERSION, Welcome, session_key,
};
use ztl_core::{Instant, State, TaskId};

use super::send::frame_bytes;
use super::{Book, Command, ComponentInfo, DeviceInfo, Event, Phase, Sent, Session, Stage, Task};

/// Pause before a device that answers nonsense is greeted again.
const BAD_ANSWER: Duration = Duration::from_secs(1);

impl<B: Book> Session<B> {
    pub(super) fn on_frame(&mut self, now: Instant, frame: Result<(usize, Frame<'_>), FrameError>) {
        let (place, frame) = match frame {
            Ok(frame) => frame,
            Err(error) => return self.counters.count(error),
        };
        self.counters.frames += 1;
        match (place, frame.seq, frame.body) {
            (1, NO_SEQ, Body::Awake { boot, .. }) => self.on_awake(now, boot),
            (0, NO_SEQ, Body::Welcome(welcome)) => self.on_welcome(now, &welcome),
            (0, NO_SEQ, Body::Refused { reason }) if self.phase == Phase::Greeting => {
                self.events.push_back(Event::Refused(reason.to_owned()));
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
                // The frame's check covers the session, so it speaks of this device's tasks.
                match self.find(task) {
                    Some(id) if !self.end(now, id, state, result) => return,
                    Some(_) => {}
                    None => self.counters.duplicates += 1,
                }
                let ack = frame_bytes(self.session, NO_SEQ, Body::Ack { task });
                self.out.extend_from_slice(&ack);
            }
            (0, NO_SEQ, Body::Progress { task, text }) => {
                if let Some(id) = self.find(task) {
                    self.events.push_back(Event::Progress(id, text.to_owned()));
                }
            }
            (0, NO_SEQ, Body::Publish { topic, bytes }) => {
                self.events.push_back(Event::Reading(topic, bytes.to_vec()));
            }
            (0, NO_SEQ, Body::Log { lost, bytes }) => {
                let bytes = bytes.to_vec();
                self.events.push_back(Event::Log { lost, bytes });
            }
            (0, seq, body) if seq != NO_SEQ => self.on_answer(now, seq, &body),
            // Echoes of one's own frames.
            _ => {}
        }
    }

    /// A device has started anew: greet it at once.
    pub(super) fn on_awake(&mut self, now: Instant, boot: u32) {
        let known = self.device.as_ref().map(|device| device.boot);
        match self.phase {
            Phase::Greeting => {
                let pause = self.repeat_pause();
                if let Some(in_flight) = &mut self.in_flight {
                    self.out.extend_from_slice(&in_flight.bytes);
                    in_flight.repeat = now + pause;
                }
            }
            // A late announcement of the boot that is greeted already changes nothing.
            Phase::Describing | Phase::Up if known != Some(boot) => {
                self.lose();
                self.greet(now);
            }
            _ => {}
        }
    }

    pub(super) fn on_welcome(&mut self, now: Instant, welcome: &Welcome<'_>) {
        if self.phase != Phase::Greeting {
            return;
        }
        if welcome.version != VERSION {
            let reason = format!("it speaks version {} of the link", welcome.version);
            self.events.push_back(Event::Refused(reason));
            return;
        }
        let link_timeout = Duration::from_millis(u64::from(welcome.link_timeout_ms));
        if !LINK_TIMEOUTS.contains(&link_timeout) {
            let reason = format!(
                "its link timeout of {link_timeout:?} is none: it takes {:?} to {:?}",
                LINK_TIMEOUTS.start(),
                LINK_TIMEOUTS.end()
            );
            self.events.push_back(Event::Refused(reason));
            return;
        }
        self.session = session_key(self.session, welcome.boot);
        self.clock = Some((welcome.clock_ms, now));
        // It lives, and its link timer runs from an earlier command; the next one is still to come.
        self.heard = now;
        let before = self.device.take();
        let was_known = before.is_some();
        // Without a session before this one it has been reset, also where its firmware gives each
        // boot the same id.
        let same_boot = |device: &DeviceInfo| device.boot == welcome.boot && welcome.replaces != 0;
        let known = before.filter(same_boot);
        self.counters.resets += u64::from(was_known && known.is_none());
        self.highest = welcome.highest;
        self.on_reset(now, welcome);
        let components = known.map(|device| device.components).unwrap_or_default();
        self.device = Some(DeviceInfo {
            name: welcome.name.to_owned(),
            firmware: welcome.firmware.to_owned(),
            boot: welcome.boot,
            max_body: usize::from(welcome.max_body),
            link_timeout,
            count: welcome.components,
            components,
        });
        self.compare_held(now, welcome);
        self.in_flight = None;
        self.phase = Phase::Describing;
        // The first command starts the device's link timer anew.
        self.describe_next(now);
    }

    /// What the device held in another boot is gone.
    pub(super) fn on_reset(&mut self, now: Instant, welcome: &Welcome<'_>) {
        let other = |sent: Sent| sent.boot != welcome.boot || welcome.replaces == 0;
        let gone = |task: &Task| task.stage.sent().is_some_and(other);
        let held: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run() && gone(task))
            .map(|(id, _)| *id)
            .collect();
        if !held.is_empty() {
            self.events.push_back(Event::Reset);
        }
        for id in held {
            self.end(now, id, State::Failed, "device was reset");
        }
    }

    /// What the device holds against what is known here.
    pub(super) fn compare_held(&mut self, now: Instant, welcome: &Welcome<'_>) {
        let held: Vec<LinkId> = welcome.held.iter().collect();
        let ours: Vec<(TaskId, Stage, bool)> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run())
            .map(|(id, task)| (*id, task.stage, task.restored))
            .collect();
        for (id, stage, restored) in ours {
            match stage {
                Stage::Waiting => {}
                Stage::Sent(sent) if held.contains(&sent.link) => self.on_started(id),
                // Sent in a session that is over, and never taken: now it never will be. Of one from
                // before a restart the client may have been told that it is ACCEPTED.
                Stage::Sent(sent) if sent.link.0 > welcome.highest => {
                    let (state, reason) = if restored {
                        let never = "never started: the device did not take it before the gateway was started anew";
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

    pub(super) fn on_started(&mut self, id: TaskId) {
        if let Some(task) = self.tasks.get_mut(&id)
            && let Stage::Sent(sent) = task.stage
            && task.unwritten.is_none()
        {
            task.stage = Stage::Running(sent);
            self.book.accepted(&task.entry(id));
            self.events.push_back(Event::Accepted(id));
        }
    }

    pub(super) fn describe_next(&mut self, now: Instant) {
        let Some(device) = &self.device else { return };
        match u8::try_from(device.components.len()) {
            Ok(index) if index < device.count => {
                self.command(now, Command::Describe(index), Body::Describe { index });
            }
            _ => {
                self.phase = Phase::Up;
                self.events.push_back(Event::Up);
                self.command(now, Command::Ping, Body::Ping);
            }
        }
    }

    pub(super) fn on_answer(&mut self, now: Instant, seq: u8, body: &Body<'_>) {
        let Some(in_flight) = self.in_flight.take_if(|in_flight| in_flight.seq == seq) else {
            self.counters.duplicates += 1;
            return;
        };
        self.heard = now;
        if !in_flight.repeated {
            let measured = now.since(in_flight.sent);
            self.round_trips.add(measured);
            // A running mean over some eight answers.
            self.turnaround = Some(
                self.turnaround
                    .map_or(measured, |mean| (mean * 7 + measured) / 8),
            );
        }
        match (in_flight.command, *body) {
            (Command::Describe(asked), Body::Component { index, offer }) if asked == index => {
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
                    });
                }
                self.describe_next(now);
            }
            (Command::Describe(index), Body::Refused { reason }) => {
                self.lose();
                let reason = format!("component {index}: {reason}");
                self.events.push_back(Event::Refused(reason));
                return self.greet_after(now, BAD_ANSWER);
            }
            (Command::Start(id), Body::Started { .. }) => {
                self.highest = self.highest.saturating_add(1);
                self.on_started(id);
            }
            (Command::Start(id), Body::Refused { reason }) => {
                self.end(now, id, State::Rejected, reason);
            }
            (Command::Ping, Body::Pong { clock_ms, .. }) => self.clock = Some((clock_ms, now)),
            // The end will be told, or has been.
            (Command::Abort(link), Body::Aborting { .. } | Body::Refused { .. }) => {
                if let Some(task) = self.find(link).and_then(|id| self.tasks.get_mut(&id)) {
                    task.abort = false;
                }
            }
            // No answer to what was asked, though the check was right. What the device did nobody
            // knows; a new session finds out.
            _ => {
                self.counters.not_understood += 1;
                self.lose();
                return self.greet_after(now, BAD_ANSWER);
            }
        }
        self.next_command(now);
    }
}
