//! A firmware update that the next gateway goes on with: from the restart of its device on, the journal has what is needed.

use tracing::info;
use ztl_core::TaskId;
use ztl_link::Entry;

use super::Worker;
use super::update_job::UpdateJob;
use super::updates::Running;
use crate::gateway::journal::UnendedUpdate;
use crate::gateway::updates::{Note, UPDATES};
use crate::log_targets::GATEWAY;
use crate::server::TaskReporter;
use crate::terminal::quoted;
use crate::time::now;

/// The progress of an update whose gateway has stopped.
const STOPPED: &str = "the gateway has stopped; the update goes on when it is started again";

impl Worker {
    /// Goes on with an update whose gateway has ended after the restart of the device.
    pub(super) fn resume_update(&mut self, task: TaskReporter, unended: UnendedUpdate) {
        let UnendedUpdate {
            goal, note, tested, ..
        } = unended;
        let name = &self.name;
        info!(target: GATEWAY, device = name, "Device '{name}': its update to {} goes on.", quoted(&note.image));
        let job = UpdateJob::resume(now(), &note, tested);
        let mut running = Running::new(task, goal, job);
        running.test = note.test.and_then(TaskId::new);
        running.stopped = note.stopped;
        running.board.clone_from(&note.board);
        running.noted = Some(note);
        self.updates.running = Some(Box::new(running));
    }

    /// Writes into the journal what the next gateway needs, if that has changed. Returns whether the journal has it.
    pub(super) fn note_update(&mut self) -> bool {
        let Some(running) = &mut self.updates.running else {
            return false;
        };
        let Some(note) = running.job.note() else {
            return false;
        };
        let note = Note {
            test: running.test.map(TaskId::get),
            stopped: running.stopped,
            board: running.board.clone(),
            ..note
        };
        if running.noted.as_ref() == Some(&note) {
            return true;
        }
        let Some(journal) = self.session.journal_mut() else {
            return false;
        };
        let Ok(text) = serde_json::to_string(&note) else {
            return false;
        };
        let entry = Entry {
            id: running.task.id(),
            component: UPDATES,
            goal: &running.goal,
            sent: None,
        };
        // If it cannot be written, the device goes back when this gateway ends.
        let written = journal.going_on(&entry, &text).is_ok();
        if written {
            running.noted = Some(note);
        }
        written
    }

    /// The gateway stops. The next one goes on with an update whose device was restarted; an earlier one ends.
    pub(super) fn hand_over_update(&mut self) {
        let Some(running) = &mut self.updates.running else {
            return;
        };
        running.next_test = None;
        let tests = running.test.is_some_and(|id| self.tasks.contains_key(&id));
        running.stopped |= tests && !running.test_refused;
        if !self.note_update() {
            return self.stop_update("the gateway stops");
        }
        if let Some(running) = &self.updates.running {
            running.task.progress(STOPPED);
        }
    }

    /// Leaves an update to the next gateway, unless the task that tests it is still being aborted.
    pub(super) fn leave_update(&mut self) {
        let tasks = &self.tasks;
        let left = self.updates.running.take_if(|running| {
            let test = running.test;
            test.is_none_or(|id| !tasks.contains_key(&id))
        });
        if let Some(running) = left {
            let name = &self.name;
            info!(target: GATEWAY, device = name, "Device '{name}': its update goes on when the gateway is started again.");
            running.task.leave();
        }
    }
}
