//! Ends tasks, and restores those from before a restart.

use std::time::Duration;

use ztl_core::link::{LINK_TIMEOUT, LinkId};
use ztl_core::{Instant, State, TaskId};

use super::{Phase, START_LIMIT, Session};
use crate::event::LinkEvent;
use crate::journal::{Restored, SessionJournal};
use crate::task::{Stage, Task};

/// Pause before an outcome that could not be written is retried.
const RETRY_PAUSE: Duration = Duration::from_millis(500);

impl<J: SessionJournal> Session<J> {
    /// Restores a task from before a restart of the gateway. Call this before the line is opened. The device decides
    /// how the task ends; if it does not answer, the task fails like any other of an unreachable device.
    pub fn restore(&mut self, now: Instant, task: Restored) {
        let Restored {
            id,
            component,
            goal,
            sent,
            accepted,
        } = task;
        // The previous gateway may have been connected until just now.
        self.heard = now;
        let (stage, deadline) = if accepted || sent.link.is_local() {
            (Stage::Running(sent), now)
        } else {
            (Stage::Sent(sent), now + START_LIMIT)
        };
        let mut task = Task::new(&component, &goal, deadline, stage);
        task.restored = true;
        self.tasks.insert(id, task);
    }

    pub(crate) fn find(&self, link: LinkId) -> Option<TaskId> {
        let boot = self.device.as_ref().map(|device| device.boot);
        let asked = |task: &Task| {
            let sent = task.stage.sent();
            sent.is_some_and(|sent| sent.link == link && Some(sent.boot) == boot)
        };
        let found = self.tasks.iter().find(|(_, task)| asked(task));
        found.map(|(id, _)| *id)
    }

    /// When an unreachable device has certainly ended the task by itself.
    ///
    /// The last answered command restarted the link timer of the device before its answer arrived. At most one more
    /// command can have arrived before that timer expired, and restarted it again. A `Start` is executed at its
    /// deadline or before.
    pub(crate) fn must_have_acted(&self, task: &Task) -> Instant {
        let sent = task.stage.sent();
        let timeout = sent.map_or(LINK_TIMEOUT, |sent| sent.link_timeout);
        (self.heard + timeout * 2).max(task.deadline + timeout)
    }

    /// Rejects tasks that were not sent in time.
    pub(crate) fn reject_late(&mut self, now: Instant) {
        let late: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.waits() && now >= task.deadline)
            .map(|(id, _)| *id)
            .collect();
        for id in late {
            let reason = if self.phase == Phase::Up {
                "the device is busy with other commands"
            } else {
                "device is not answering"
            };
            self.reject(id, reason.to_owned());
        }
    }

    /// Fails tasks that an unreachable device has certainly ended.
    pub(crate) fn fail_unreachable(&mut self, now: Instant) {
        if self.answers() {
            return;
        }
        let over: Vec<TaskId> = self
            .tasks
            .iter()
            .filter(|(_, task)| task.may_run() && !task.carries_on())
            .filter(|(_, task)| now >= self.must_have_acted(task))
            .map(|(id, _)| *id)
            .collect();
        let why = self.why_unreachable();
        for id in over {
            self.end(now, id, State::Failed, why);
        }
    }

    /// Rejects a task that was never sent. Nothing is journaled, because neither client nor device knows the task.
    pub(crate) fn reject(&mut self, id: TaskId, reason: String) {
        self.tasks.remove(&id);
        self.events.push_back(LinkEvent::TaskRejected(id, reason));
    }

    /// Writes the outcome of a task and ends it. Returns `false` if the outcome could not be written.
    pub(crate) fn end(&mut self, now: Instant, id: TaskId, state: State, text: &str) -> bool {
        let Some(task) = self.tasks.get_mut(&id) else {
            return true;
        };
        if let Err(reason) = self.journal.ended(&task.entry(id), state, text) {
            let first = task.unwritten.replace((state, text.to_owned())).is_none();
            if first {
                let text = format!("task ended; result withheld until journaled: {reason}");
                self.events.push_back(LinkEvent::Progress(id, text));
            }
            self.write_again = Some(now + RETRY_PAUSE);
            return false;
        }
        let undecided = matches!(task.stage, Stage::Sent(_));
        self.tasks.remove(&id);
        let text = text.to_owned();
        if state == State::Rejected {
            self.events.push_back(LinkEvent::TaskRejected(id, text));
            return true;
        }
        if undecided {
            self.events.push_back(LinkEvent::Accepted(id));
        }
        self.events.push_back(LinkEvent::Ended(id, state, text));
        true
    }

    /// Retries to write outcomes.
    pub(crate) fn retry_outcomes(&mut self, now: Instant) {
        if self.write_again.is_none_or(|again| now < again) {
            return;
        }
        self.write_again = None;
        let unwritten: Vec<(TaskId, State, String)> = self
            .tasks
            .iter()
            .filter_map(|(id, task)| {
                let (state, text) = task.unwritten.clone()?;
                Some((*id, state, text))
            })
            .collect();
        for (id, state, text) in unwritten {
            if !self.end(now, id, state, &text) {
                break;
            }
        }
    }
}
