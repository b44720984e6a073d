//! How tasks end, and what is known of those from before a restart.

use std::time::Duration;

use ztl_core::link::{LINK_TIMEOUT, LinkId};
use ztl_core::{Instant, State, TaskId};

use super::{Book, Event, Phase, Restored, START_LIMIT, Session, Stage, Task};

/// Pause before an end that could not be written is tried again.
const WRITE_AGAIN: Duration = Duration::from_millis(500);

impl<B: Book> Session<B> {
    /// Takes up a task from before a restart of the gateway; to be called before the line is open.
    /// It is ended by the device's word, or as one of a device that is not heard.
    pub fn restore(&mut self, now: Instant, task: Restored) {
        let Restored {
            id,
            component,
            goal,
            sent,
            accepted,
        } = task;
        // The gateway before may have heard it until just now.
        self.heard = now;
        let (stage, deadline) = if accepted {
            (Stage::Running(sent), now)
        } else {
            (Stage::Sent(sent), now + START_LIMIT)
        };
        let mut task = Task::new(&component, &goal, deadline, stage);
        task.restored = true;
        self.tasks.insert(id, task);
    }

    pub(super) fn find(&self, link: LinkId) -> Option<TaskId> {
        let boot = self.device.as_ref().map(|device| device.boot);
        let asked = |task: &Task| {
            let sent = task.stage.sent();
            sent.is_some_and(|sent| sent.link == link && Some(sent.boot) == boot)
        };
        let found = self.tasks.iter().find(|(_, task)| asked(task));
        found.map(|(id, _)| *id)
    }

    /// When a device that is not heard has brought the task to its end by itself.
    ///
    /// The last command that was answered restarted its link timer, at the latest when the answer
    /// was heard. The one after it came, if at all, before that timer fired, and restarted it once
    /// more; there was no third. A `Start` is taken at the latest at its deadline.
    pub(super) fn must_have_acted(&self, task: &Task) -> Instant {
        let sent = task.stage.sent();
        let timeout = sent.map_or(LINK_TIMEOUT, |sent| sent.link_timeout);
        (self.heard + timeout * 2).max(task.deadline + timeout)
    }

    /// Refuses what was never sent and has become too late.
    pub(super) fn give_up_waiting(&mut self, now: Instant) {
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
                "the device is not answering"
            };
            self.refuse(id, reason.to_owned());
        }
    }

    /// Ends what a device that is not heard must have ended by itself.
    pub(super) fn give_up_running(&mut self, now: Instant) {
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
        for id in over {
            self.end(now, id, State::Failed, "device is not answering");
        }
    }

    /// Refuses a task that was never sent. Nobody else knows of it, so nothing is written.
    pub(super) fn refuse(&mut self, id: TaskId, reason: String) {
        self.tasks.remove(&id);
        self.events.push_back(Event::Rejected(id, reason));
    }

    /// Ends a task, once that is written; says whether it is.
    pub(super) fn end(&mut self, now: Instant, id: TaskId, state: State, text: &str) -> bool {
        let Some(task) = self.tasks.get_mut(&id) else {
            return true;
        };
        if let Err(reason) = self.book.ended(&task.entry(id), state, text) {
            let first = task.unwritten.replace((state, text.to_owned())).is_none();
            if first {
                let text = format!(
                    "it has ended, and nobody is told how before that is written: {reason}"
                );
                self.events.push_back(Event::Progress(id, text));
            }
            self.write_again = Some(now + WRITE_AGAIN);
            return false;
        }
        let taken = matches!(task.stage, Stage::Sent(_));
        self.tasks.remove(&id);
        let text = text.to_owned();
        if state == State::Rejected {
            self.events.push_back(Event::Rejected(id, text));
            return true;
        }
        if taken {
            self.events.push_back(Event::Accepted(id));
        }
        self.events.push_back(Event::Ended(id, state, text));
        true
    }

    /// Tries again to write the ends that could not be written.
    pub(super) fn write_ends(&mut self, now: Instant) {
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
