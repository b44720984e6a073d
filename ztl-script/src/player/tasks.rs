//! Started tasks: asking for their state, and their time limits.

use std::time::Duration;

use ztl_core::Instant;

use super::state::{PATIENCE, POLL, Phase, Player, RunTask};
use crate::event::{
    DecidedBy, RequestNumber, RunCommand, RunEvent, TaskNumber, TaskState, WaitReason,
};
use crate::server::ServerRequest;

/// How long a server of this project is asked to hold an answer.
const HELD: Duration = Duration::from_millis(1000);
/// The same while somebody watches the progress.
const HELD_FOR_PROGRESS: Duration = POLL;

impl Player {
    /// Sends each STATUS and ABORT that is due, and enforces time limits.
    pub(super) fn watch(&mut self, now: Instant) {
        let live: Vec<TaskNumber> = self.live.iter().copied().collect();
        for number in live {
            if self.task_wake(number).is_none_or(|wake| now < wake) {
                continue;
            }
            self.limit(now, number);
            if self.ask_wake(number).is_some_and(|wake| now >= wake) {
                self.ask_about(now, number, false);
            }
            if self.abort_wake(number).is_some_and(|wake| now >= wake) {
                self.abort(now, number);
            }
        }
    }

    /// When a task needs attention.
    pub(super) fn task_wake(&self, number: TaskNumber) -> Option<Instant> {
        let task = self.tasks.get(&number)?;
        let wakes = [
            self.ask_wake(number),
            self.abort_wake(number),
            self.limit_wake(task),
            self.patience_wake(task),
        ];
        wakes.into_iter().flatten().min()
    }

    fn ask_wake(&self, number: TaskNumber) -> Option<Instant> {
        let task = self.tasks.get(&number)?;
        let ends = matches!(
            self.phase,
            Phase::Settling(_) | Phase::Stopping(_) | Phase::Over
        );
        let can = task.asked.is_none() && task.can_be_asked() && !ends;
        let background = !task.awaited || task.excused;
        let may = task.ours || (self.options.watch && background) || self.is_turn_of(number);
        (can && may).then_some(task.next)
    }

    /// Towards the original's server, a step's tasks are asked about one after the other once all are
    /// started, as the original does.
    fn is_turn_of(&self, number: TaskNumber) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let Some(step) = play.step.as_ref().filter(|step| step.todo.is_empty()) else {
            return false;
        };
        let together = self.options.watch
            || self
                .script
                .step(play.scene, step.step)
                .is_some_and(|step| step.parallel);
        let open = step.tasks.iter().filter_map(|number| {
            let task = self.tasks.get(number)?;
            (task.is_open() && !task.ours).then_some((*number, task))
        });
        for (open, task) in open {
            if open == number {
                return true;
            }
            // One that hangs does not block the others.
            if !together && task.unknown.is_none() {
                return false;
            }
        }
        false
    }

    /// When the next ABORT is due.
    fn abort_wake(&self, number: TaskNumber) -> Option<Instant> {
        let task = self.tasks.get(&number)?;
        let again = self.is_stopping(number) && !task.stop_told;
        (again && task.id.is_some() && !task.aborting).then_some(task.next)
    }

    fn limit_wake(&self, task: &RunTask) -> Option<Instant> {
        let stopping = matches!(self.phase, Phase::Stopping(_));
        task.deadline
            .filter(|_| !task.late && task.id.is_some() && !stopping)
    }

    /// When an unattended run stops waiting for a silent server.
    fn patience_wake(&self, task: &RunTask) -> Option<Instant> {
        let since = task.unknown.as_ref().map(|(_, since)| *since);
        let since = since.or(task.deadline.filter(|_| task.late))?;
        let waits = self.options.unattended && matches!(self.phase, Phase::Playing(_));
        (waits && task.is_open()).then_some(since + PATIENCE)
    }

    /// Asks for the state of a task; `at_once`: the server is not to hold the answer.
    pub(super) fn ask_about(
        &mut self,
        now: Instant,
        number: TaskNumber,
        at_once: bool,
    ) -> Option<RequestNumber> {
        let task = self.tasks.get(&number)?;
        // A silent server is to answer at once, to show that it is back.
        let hold = match task.ours && task.unknown.is_none() && !at_once {
            false => Duration::ZERO,
            true if self.options.watch => HELD_FOR_PROGRESS,
            true => HELD,
        };
        let id = task.id.clone()?;
        let text = format!("{id}:{}", task.status_text);
        let ask = ServerRequest::Status { id, text, hold };
        let sent = self.send(now, number, ask);
        self.tasks.get_mut(&number)?.asked = sent;
        sent
    }

    /// Stops a task that exceeds its time limit.
    fn limit(&mut self, now: Instant, number: TaskNumber) {
        let Some(task) = self.tasks.get(&number) else {
            return;
        };
        if self.patience_wake(task).is_some_and(|wake| now >= wake) {
            let (remote, patience) = (&task.remote, PATIENCE.as_secs());
            let text = format!(
                "'{remote}' has reported no final state for {patience} s, and there is no operator to decide"
            );
            self.emit(RunEvent::Note { text });
            return self.obey(now, RunCommand::Stop, DecidedBy::Script);
        }
        if self.limit_wake(task).is_none_or(|limit| now < limit) {
            return;
        }
        if let Some(task) = self.tasks.get_mut(&number) {
            task.late = true;
        }
        self.abort(now, number);
    }

    /// Sends an ABORT.
    pub(super) fn abort(&mut self, now: Instant, number: TaskNumber) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        let Some(id) = task.id.clone().filter(|_| !task.aborting) else {
            return;
        };
        task.aborts += 1;
        task.aborting = true;
        self.send(now, number, ServerRequest::Abort { id });
    }

    /// Updates the state and text of a task.
    pub(super) fn set_state(&mut self, number: TaskNumber, state: TaskState, text: &str) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        if task.state == state && task.text == text {
            return;
        }
        task.state = state;
        text.clone_into(&mut task.text);
        if state != TaskState::Unknown {
            task.unknown = None;
        }
        let id = task.id.clone();
        let no_server =
            state == TaskState::NotStarted && !self.options.remotes.contains(&task.remote);
        self.events.push_back(RunEvent::TaskState {
            task: number,
            state,
            id,
            text: text.to_owned(),
            no_server,
        });
        if state.is_over() {
            self.live.remove(&number);
        }
        match state {
            TaskState::Completed => self.unresolved.remove(&number),
            state if state.is_failure() && (task.place.is_some() || task.cue.is_some()) => {
                self.unresolved.insert(number)
            }
            _ => false,
        };
    }

    /// The state of a task is unknown.
    pub(super) fn set_unknown(
        &mut self,
        now: Instant,
        number: TaskNumber,
        why: WaitReason,
        text: &str,
    ) {
        self.set_state(number, TaskState::Unknown, text);
        if let Some(task) = self.tasks.get_mut(&number) {
            let since = task.unknown.as_ref().map_or(now, |(_, since)| *since);
            task.unknown = Some((why, since));
        }
    }
}
