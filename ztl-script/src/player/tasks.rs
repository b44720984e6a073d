//! What was started: asking how it is, and noticing that it takes too long.

use std::time::Duration;

use ztl_core::Instant;

use super::super::event::{By, Command, Event, RequestNumber, TaskNumber, TaskState, Why};
use super::{Ask, PATIENCE, POLL, Phase, Player};
use ztl_std::RemoteId;

/// Longest time that a server of ours is asked to hold an answer.
const HELD: Duration = Duration::from_millis(1000);
/// The same when somebody looks at the progress.
const HELD_FOR_PROGRESS: Duration = POLL;

/// A task that was started, or tried to.
#[derive(Debug)]
pub(super) struct Live {
    /// Its scene, step and part; `None` where another run or client has started it.
    pub(super) place: Option<(usize, usize, usize)>,
    pub(super) remote: String,
    /// Its step waits for it.
    pub(super) awaited: bool,
    pub(super) state: TaskState,
    pub(super) text: String,
    pub(super) id: Option<RemoteId>,
    /// Its server holds answers.
    pub(super) ours: bool,
    /// Which start of its server has it, where that is known.
    pub(super) boot: Option<u32>,
    /// The payload of its STATUS where it does not, after its id.
    pub(super) status_text: String,
    /// A STATUS that is under way.
    pub(super) asked: Option<RequestNumber>,
    /// When it may be asked, or told to stop, the next time.
    pub(super) next: Instant,
    /// When it has taken too long.
    pub(super) deadline: Option<Instant>,
    pub(super) late: bool,
    /// Why it is unknown, and since when.
    pub(super) unknown: Option<(Why, Instant)>,
    /// The operator has decided to go on without it.
    pub(super) excused: bool,
    /// ABORTs sent.
    pub(super) aborts: u32,
    /// An ABORT is under way.
    pub(super) aborting: bool,
    /// It was not started since its server is not there.
    pub(super) absent: bool,
    /// It was told what became of stopping it.
    pub(super) stop_told: bool,
}

impl Live {
    /// A task that is about to be sent.
    pub(super) fn new(now: Instant, remote: &str) -> Self {
        Self {
            place: None,
            remote: remote.to_owned(),
            awaited: false,
            state: TaskState::Asked,
            text: String::new(),
            id: None,
            ours: false,
            boot: None,
            status_text: String::new(),
            asked: None,
            next: now,
            deadline: None,
            late: false,
            unknown: None,
            excused: false,
            aborts: 0,
            aborting: false,
            absent: false,
            stop_told: false,
        }
    }

    /// Asking may tell how it is.
    pub(super) const fn can_be_asked(&self) -> bool {
        let hopeless = matches!(
            self.unknown,
            Some((
                Why::ServerRestarted { .. }
                    | Why::TaskUnknown
                    | Why::AnswerUnclear { .. }
                    | Why::StartUnknown,
                _
            ))
        );
        self.id.is_some() && !hopeless
    }

    /// It is known not to have reached its goal, and its step is to care: nothing notices how one in the
    /// background ends.
    pub(super) const fn is_failure(&self) -> bool {
        let never_began = matches!(self.state, TaskState::NotStarted | TaskState::Refused);
        never_began || (self.awaited && self.state.is_failure())
    }

    /// It was taken by an earlier start of its server than this one, as far as can be told.
    pub(super) fn is_of_an_older(&self, boot: Option<u32>) -> bool {
        let silent = matches!(
            self.unknown,
            Some((Why::ServerSilent { .. } | Why::NotTold { .. }, _))
        );
        silent || matches!((self.boot, boot), (Some(own), Some(boot)) if own != boot)
    }

    /// Its step waits for it still.
    pub(super) const fn is_open(&self) -> bool {
        self.awaited && !self.state.is_over() && !self.excused
    }
}

impl Player {
    /// Asks about tasks whose turn it is, and notices those that take too long.
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

    /// When something is to be done about a task.
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
            Phase::Settling(_) | Phase::Stopping(_) | Phase::Over(_)
        );
        let can = task.asked.is_none() && task.can_be_asked() && !ends;
        let background = !task.awaited || task.excused;
        let may = task.ours || (self.options.watch && background) || self.is_turn_of(number);
        (can && may).then_some(task.next)
    }

    /// Towards a server of the original's, the tasks of a step are asked about when all were started, and
    /// one after the other, as the original does.
    fn is_turn_of(&self, number: TaskNumber) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let Some(step) = play.step.as_ref().filter(|step| step.all_started()) else {
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
            // One that hangs does not keep the others from being seen.
            if !together && task.unknown.is_none() {
                return false;
            }
        }
        false
    }

    /// When a task is told to stop once more.
    fn abort_wake(&self, number: TaskNumber) -> Option<Instant> {
        let task = self.tasks.get(&number)?;
        let again = self.is_stopping(number) && !task.stop_told;
        (again && task.id.is_some() && !task.aborting).then_some(task.next)
    }

    fn limit_wake(&self, task: &Live) -> Option<Instant> {
        let stopping = matches!(self.phase, Phase::Stopping(_));
        task.deadline
            .filter(|_| !task.late && task.id.is_some() && !stopping)
    }

    /// When an unattended run gives up to wait for a server that is silent.
    fn patience_wake(&self, task: &Live) -> Option<Instant> {
        let since = task.unknown.as_ref().map(|(_, since)| *since);
        let since = since.or(task.deadline.filter(|_| task.late))?;
        let waits = self.options.unattended && matches!(self.phase, Phase::Playing(_));
        (waits && task.is_open()).then_some(since + PATIENCE)
    }

    /// Asks how a task is; `at_once`: no server is to hold the answer.
    pub(super) fn ask_about(
        &mut self,
        now: Instant,
        number: TaskNumber,
        at_once: bool,
    ) -> Option<RequestNumber> {
        let task = self.tasks.get(&number)?;
        // A server that was silent is asked whether it is there.
        let hold = match task.ours && task.unknown.is_none() && !at_once {
            false => Duration::ZERO,
            true if self.options.watch => HELD_FOR_PROGRESS,
            true => HELD,
        };
        let id = task.id.clone()?;
        let text = format!("{id}:{}", task.status_text);
        let ask = Ask::Status { id, text, hold };
        let sent = self.send(now, number, ask);
        self.tasks.get_mut(&number)?.asked = sent;
        sent
    }

    /// A task that takes longer than its limit is stopped.
    fn limit(&mut self, now: Instant, number: TaskNumber) {
        let Some(task) = self.tasks.get(&number) else {
            return;
        };
        if self.patience_wake(task).is_some_and(|wake| now >= wake) {
            let (remote, patience) = (&task.remote, PATIENCE.as_secs());
            let text = format!(
                "'{remote}' has not told an end for {patience} s, and nobody is there to decide"
            );
            self.events.push_back(Event::Note { text });
            return self.stop(now, Command::Stop, By::Script);
        }
        if self.limit_wake(task).is_none_or(|limit| now < limit) {
            return;
        }
        if let Some(task) = self.tasks.get_mut(&number) {
            task.late = true;
        }
        self.abort(now, number);
    }

    /// Tells a task to stop.
    pub(super) fn abort(&mut self, now: Instant, number: TaskNumber) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        let Some(id) = task.id.clone().filter(|_| !task.aborting) else {
            return;
        };
        task.aborts += 1;
        task.aborting = true;
        self.send(now, number, Ask::Abort { id });
    }

    /// A task is in another state, or says something new.
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
        self.events.push_back(Event::TaskState {
            task: number,
            state,
            id,
            text: text.to_owned(),
        });
        if state.is_over() {
            self.live.remove(&number);
        }
        match state {
            TaskState::Completed => self.unresolved.remove(&number),
            state if state.is_failure() && task.place.is_some() => self.unresolved.insert(number),
            _ => false,
        };
    }

    /// Nobody knows how it is with a task.
    pub(super) fn set_unknown(&mut self, now: Instant, number: TaskNumber, why: Why, text: &str) {
        self.set_state(number, TaskState::Unknown, text);
        if let Some(task) = self.tasks.get_mut(&number) {
            let since = task.unknown.as_ref().map_or(now, |(_, since)| *since);
            task.unknown = Some((why, since));
        }
    }
}
