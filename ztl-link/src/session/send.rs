//! Sends commands: one in flight at a time, repeated until it is answered.

use std::time::Duration;

use ztl_core::link::{
    Body, Frame, Hello, LinkId, Loss, NO_SEQ, NO_SESSION, VERSION, encode, next_seq, session_number,
};
use ztl_core::{Instant, TaskId};

use super::{CommandKind, InFlight, Phase, Session};
use crate::journal::{Entry, Sent, SessionJournal};
use crate::task::{Stage, Task};

/// Minimum pause before a command is repeated.
const REPEAT_LEAST: Duration = Duration::from_millis(25);
/// Pause before a command is repeated while the turnaround is unknown.
const REPEAT_FIRST: Duration = Duration::from_millis(100);
/// A command is repeated after this multiple of the mean turnaround.
const REPEAT_FACTOR: u32 = 2;

impl<J: SessionJournal> Session<J> {
    /// Opens a new session after a pause.
    pub(crate) fn greet_after(&mut self, now: Instant, pause: Duration) {
        let before = self.out.len();
        self.greet(now);
        // The first copy is sent when the repetition is due.
        self.out.truncate(before);
        if let Some(in_flight) = &mut self.in_flight {
            in_flight.sent = now + pause;
            in_flight.repeat = now + pause;
        }
    }

    /// Opens a new session.
    pub(crate) fn greet(&mut self, now: Instant) {
        self.phase = Phase::Greeting;
        // A device that does not even refuse is not asked again, unless a client needs the answer [4.7].
        let lost = self.in_flight.as_ref().map(|it| it.command);
        if let Some(CommandKind::DescribePart(index)) = lost {
            self.next_part = None;
            self.lost_part = Some(index).filter(|_| !self.asked_again);
        }
        self.session = session_number((self.random)());
        self.ending = NO_SESSION;
        self.seq = NO_SEQ;
        self.strangers.clear();
        self.counters.sessions += 1;
        let hello = Body::Hello(Hello {
            version: VERSION,
            session: self.session,
            gateway: self.gateway,
        });
        let bytes = frame_bytes(self.address, NO_SESSION, NO_SEQ, hello);
        self.send(now, CommandKind::Hello, NO_SEQ, bytes);
    }

    pub(crate) fn send(&mut self, now: Instant, command: CommandKind, seq: u8, bytes: Vec<u8>) {
        self.out.extend_from_slice(&bytes);
        self.in_flight = Some(InFlight {
            command,
            seq,
            bytes,
            sent: now,
            repeat: now + self.repeat_pause(),
            repeated: false,
        });
    }

    pub(crate) fn command(&mut self, now: Instant, command: CommandKind, body: Body<'_>) {
        self.seq = next_seq(self.seq);
        self.commanded = now;
        let bytes = frame_bytes(self.address, self.session, self.seq, body);
        self.send(now, command, self.seq, bytes);
    }

    pub(crate) fn repeat_pause(&self) -> Duration {
        let measured = self
            .turnaround
            .map_or(REPEAT_FIRST, |time| time * REPEAT_FACTOR);
        // A slow line needs this long for a command and its answer: 64 bytes of 10 bits.
        let line = self.baud.map_or(Duration::ZERO, |baud| {
            Duration::from_micros(640_000_000 / u64::from(baud.max(1)))
        });
        measured.max(line).max(REPEAT_LEAST)
    }

    /// Sends the most urgent command if none is in flight: aborts, starts, questions for descriptions, requests
    /// about parameters and updates, pings.
    pub(crate) fn next_command(&mut self, now: Instant) {
        if self.in_flight.is_some() || self.phase != Phase::Up {
            return;
        }
        if let Some(link) = self.next_abort() {
            return self.command(now, CommandKind::Abort(link), Body::Abort { task: link });
        }
        while let Some(id) = self.next_waiting() {
            if self.send_start(now, id) {
                return;
            }
        }
        if let Some(index) = self.next_part {
            let command = CommandKind::DescribePart(index);
            self.command(now, command, Body::Describe { index });
        } else if self.send_parameter_request(now) || self.send_update_request(now) {
            // It is in flight.
        } else if now >= self.ping_due() {
            self.command(now, CommandKind::Ping, Body::Ping);
        }
    }

    /// Asks once more for the part whose question was lost with its session, unless a task would end if that happened again.
    /// Returns whether it does.
    pub(crate) fn describe_again(&mut self, now: Instant) -> bool {
        let is_busy = self.tasks.values().any(Task::may_run);
        let Some(index) = self.lost_part.take_if(|_| !is_busy) else {
            return false;
        };
        self.asked_again = true;
        self.next_part = Some(index);
        let command = CommandKind::DescribePart(index);
        self.command(now, command, Body::Describe { index });
        true
    }

    /// The next task to abort. An abort is pending until it is answered, so a new session sends it again.
    pub(crate) fn next_abort(&mut self) -> Option<LinkId> {
        let mut tasks = self.tasks.values();
        let wanted = tasks.find(|task| task.abort && task.may_run() && !self.is_astray(task));
        match wanted.and_then(|task| task.stage.sent()) {
            Some(sent) => Some(sent.link),
            None => self.strangers.pop_front(),
        }
    }

    pub(crate) fn next_waiting(&self) -> Option<TaskId> {
        let waiting = self.tasks.iter().find(|(_, task)| task.waits());
        waiting.map(|(id, _)| *id)
    }

    /// Sends a `Start`, or rejects the task. Returns whether a command is in flight now.
    pub(crate) fn send_start(&mut self, now: Instant, id: TaskId) -> bool {
        // A task that was not executed frees its link id, so its outcome must be written before the next `Start`.
        if self.write_again.is_some() {
            self.write_again = Some(now);
            self.retry_outcomes(now);
        }
        if self.write_again.is_some() {
            let reason = "the journal cannot be written, and an earlier outcome waits for it";
            self.reject(id, reason.to_owned());
            return false;
        }
        let (Some(task), Some(device)) = (self.tasks.get_mut(&id), &self.device) else {
            return false;
        };
        let place = device
            .components
            .iter()
            .position(|component| component.name == task.component);
        let Some((Ok(component), (clock, heard))) = place.map(u8::try_from).zip(self.clock) else {
            let names: Vec<&str> = device.components.iter().map(|c| c.name.as_str()).collect();
            let reason = format!(
                "no component '{}'; it has: {}",
                task.component,
                names.join(", ")
            );
            self.reject(id, reason);
            return false;
        };
        let left = task.deadline.since(heard).as_millis();
        let link = LinkId(self.highest.saturating_add(1));
        let goal = task.goal.clone();
        let body = Body::Start {
            task: link,
            component,
            goal: &goal,
            before_ms: clock.saturating_add(u64::try_from(left).unwrap_or(u64::MAX)),
        };
        let mut len = 0;
        body.put(&mut |bytes: &[u8]| len += bytes.len());
        if len > device.max_body {
            let most = goal.len().saturating_sub(len - device.max_body);
            let reason = format!(
                "the goal is {} bytes long, the device takes {most}",
                goal.len()
            );
            self.reject(id, reason);
            return false;
        }
        let offered = device.components.get(usize::from(component));
        let loss = offered.map_or(Loss::Abort, |component| component.loss);
        let sent = Sent {
            link,
            boot: device.boot,
            loss,
            link_timeout: device.link_timeout,
        };
        let entry = Entry {
            sent: Some(sent),
            ..task.entry(id)
        };
        if let Err(reason) = self.journal.starting(&entry) {
            self.reject(id, reason);
            return false;
        }
        task.stage = Stage::Sent(sent);
        self.command(now, CommandKind::Start(id), body);
        true
    }
}

/// Encodes a frame.
pub(crate) fn frame_bytes(addr: u8, session: u32, seq: u8, body: Body<'_>) -> Vec<u8> {
    let frame = Frame { addr, seq, body };
    let needed = match encode(session, &frame, &mut []) {
        Ok(len) => len,
        Err(error) => error.needed,
    };
    let mut bytes = vec![0; needed];
    // Cannot fail: the length was measured.
    let _ = encode(session, &frame, &mut bytes);
    bytes
}
