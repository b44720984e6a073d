//! Stopping tasks, and ending the run.

use std::collections::BTreeSet;

use ztl_core::{Instant, State};
use ztl_std::RemoteId;

use super::state::{POLL, Phase, Player, RunTask, Stopping};
use crate::event::{
    DecidedBy, Question, RequestNumber, RunCommand, RunEvent, RunOutcome, TaskNumber, TaskState,
};
use crate::server::{ServerAnswer, ServerRequest};

/// How many ABORTs a task gets before the player gives up.
const TRIES: u32 = 3;

/// Said about a task whose INIT was not answered.
pub(super) const UNNAMED: &str =
    "whether it was started is unknown, and without an id it cannot be aborted";

impl Player {
    /// Whether a task is being stopped.
    pub(super) fn is_stopping(&self, number: TaskNumber) -> bool {
        matches!(&self.phase, Phase::Stopping(stopping) if stopping.tasks.contains(&number))
    }

    /// Whether the request is about a task that is being stopped.
    pub(crate) fn is_about_stopping(&self, request: RequestNumber) -> bool {
        let pending = self.under_way.get(&request);
        let task = pending.and_then(|pending| pending.task);
        task.is_some_and(|task| self.is_stopping(task))
    }

    /// The scene that is shown when everything under way is stopped.
    fn before(&self) -> usize {
        match (&self.phase, self.question) {
            (Phase::Playing(play), _) => play.before,
            (
                Phase::Stopping(Stopping {
                    then: Some(scene), ..
                }),
                _,
            ) => *scene,
            (_, Some(Question::Scene { scene })) => scene,
            _ => self.script.scenes.len(),
        }
    }

    /// Stops the tasks of `scene`, or all tasks, as the command says.
    pub(super) fn stop(&mut self, now: Instant, command: RunCommand, scene: Option<usize>) {
        let all = command != RunCommand::StopScene;
        let then = (command != RunCommand::Stop).then(|| self.before());
        let here = |number: &TaskNumber| {
            let place = self.tasks.get(number).and_then(|task| task.place);
            place.is_some_and(|(of, ..)| Some(of) == scene)
        };
        let tasks = self.live.iter().copied();
        let tasks: BTreeSet<TaskNumber> = tasks.filter(|number| all || here(number)).collect();
        self.leave_play();
        self.question = None;
        let remotes = match command {
            RunCommand::StopAll => self.options.remotes.clone(),
            _ => BTreeSet::new(),
        };
        let ask = |remote: &String| self.send_to(now, remote.clone(), None, ServerRequest::Tasks);
        let listings = remotes.iter().map(ask).collect();
        self.phase = Phase::Stopping(Stopping {
            tasks: tasks.clone(),
            listings,
            all,
            then,
        });
        self.emit(RunEvent::Stopping {
            tasks: tasks.iter().copied().collect(),
            remotes: remotes.into_iter().collect(),
        });
        for number in tasks {
            let Some(task) = self.tasks.get_mut(&number) else {
                continue;
            };
            task.aborts = 0;
            task.stop_told = false;
            // A task whose INIT is not answered yet is stopped once its id is known.
            if task.id.is_some() {
                self.abort(now, number);
            } else if task.state == TaskState::Unknown {
                self.tell_stop(number, false, UNNAMED);
            }
        }
        self.settle();
    }

    pub(super) fn tell_stop(&mut self, task: TaskNumber, confirmed: bool, text: &str) {
        let Some(stopped) = self.tasks.get_mut(&task) else {
            return;
        };
        if !std::mem::replace(&mut stopped.stop_told, true) {
            let text = text.to_owned();
            self.emit(RunEvent::StopAnswered {
                task,
                confirmed,
                text,
            });
        }
    }

    /// Applies the answer to an ABORT.
    pub(super) fn on_abort(&mut self, now: Instant, number: TaskNumber, answer: ServerAnswer) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        task.aborting = false;
        task.abort_lost = matches!(answer, ServerAnswer::Nothing { .. });
        task.next = now + POLL;
        let gives_up = task.aborts >= TRIES;
        let stopping = self.is_stopping(number);
        let unstoppable = matches!(answer, ServerAnswer::CannotStop { .. });
        let unconfirmed = match &answer {
            ServerAnswer::Task { state, .. } if state.is_final() => None,
            ServerAnswer::CannotStop { text, .. } => {
                Some(format!("it cannot be stopped, and continues ({text})"))
            }
            ServerAnswer::Task { text, .. } => Some(format!("it has not ended yet ({text})")),
            ServerAnswer::TaskUnknown { text, .. }
            | ServerAnswer::NotTold { text }
            | ServerAnswer::Unclear { text }
            | ServerAnswer::Nothing { text, .. } => Some(text.clone()),
            _ => None,
        };
        // Asking again would not help.
        let hopeless = matches!(
            answer,
            ServerAnswer::TaskUnknown { .. } | ServerAnswer::Unclear { .. }
        );
        // The text of an ABORT's answer is not the task's progress.
        let running = matches!(
            answer,
            ServerAnswer::CannotStop { .. }
                | ServerAnswer::Task {
                    state: State::Initiated | State::Accepted,
                    ..
                }
        );
        if !running {
            self.on_known(now, number, answer);
        }
        match unconfirmed.filter(|_| stopping) {
            Some(text) if unstoppable || hopeless || gives_up => {
                self.tell_stop(number, false, &text);
            }
            Some(_) => {}
            None => {
                // Its time limit cannot end the step, and there is no operator to decide.
                let stuck = self.options.unattended && unstoppable && !stopping;
                if stuck && matches!(self.phase, Phase::Playing(_)) {
                    self.obey(now, RunCommand::Stop, DecidedBy::Script);
                }
            }
        }
    }

    /// Repeats the ABORTs that a server did not answer: it answers again, and their tasks may still run.
    pub(super) fn repeat_lost_aborts(&mut self, now: Instant, remote: &str) {
        let is_lost = |number: &TaskNumber| {
            let task = self.tasks.get(number);
            let is_lost =
                |task: &RunTask| task.abort_lost && task.remote == remote && task.can_be_asked();
            task.is_some_and(is_lost) && !self.is_stopping(*number)
        };
        let lost: Vec<TaskNumber> = self.live.iter().copied().filter(is_lost).collect();
        for number in lost {
            self.abort(now, number);
        }
    }

    /// Reports stopped tasks, and leaves the phase when nothing is left to wait for.
    pub(super) fn settle(&mut self) {
        match &self.phase {
            Phase::Stopping(stopping) => {
                let (all, then) = (stopping.tasks.clone(), stopping.then);
                let listing = self.any_under_way(&stopping.listings);
                for number in &all {
                    let Some(task) = self.tasks.get(number) else {
                        continue;
                    };
                    if task.state.is_over() {
                        let text = match task.text.is_empty() {
                            true => task.state.to_string(),
                            false => format!("{}: {}", task.state, task.text),
                        };
                        self.tell_stop(*number, true, &text);
                    }
                }
                let told = |number| self.tasks.get(number).is_none_or(|task| task.stop_told);
                if listing || !all.iter().all(told) {
                    return;
                }
                match then {
                    Some(scene) => self.show(scene),
                    None => self.end_run(self.stop_outcome()),
                }
            }
            Phase::Settling(asked) if !self.any_under_way(asked) => {
                self.end_run(self.final_outcome());
            }
            _ => {}
        }
    }

    /// The outcome if the run is stopped and ends now.
    pub(super) fn stop_outcome(&self) -> RunOutcome {
        match self.live.is_empty() {
            true => RunOutcome::Stopped,
            false => RunOutcome::NotConfirmed,
        }
    }

    fn any_under_way(&self, requests: &BTreeSet<RequestNumber>) -> bool {
        let mut requests = requests.iter();
        requests.any(|request| self.under_way.contains_key(request))
    }

    /// Stops the listed tasks that this run did not start.
    pub(super) fn on_tasks(&mut self, now: Instant, remote: &str, answer: ServerAnswer) {
        let (listed, gaps) = match answer {
            ServerAnswer::Tasks {
                listed: Some(listed),
                gaps,
            } => (Some(listed), gaps),
            ServerAnswer::Nothing { text, .. } | ServerAnswer::Unclear { text } => {
                (None, vec![text])
            }
            _ => (None, vec!["the server does not list its tasks".to_owned()]),
        };
        for why in &gaps {
            let text = format!("tasks that others started on '{remote}' may still run: {why}");
            self.emit(RunEvent::Note { text });
        }
        if let Some((boot, tasks)) = listed {
            self.stop_found(now, remote, boot, tasks);
        }
        self.emit(RunEvent::TasksListed {
            remote: remote.to_owned(),
            gaps,
        });
    }

    fn stop_found(
        &mut self,
        now: Instant,
        remote: &str,
        boot: u32,
        tasks: Vec<(RemoteId, String)>,
    ) {
        for (id, text) in tasks {
            // Two names may stand for one server.
            let is_known =
                |task: &RunTask| task.id.as_ref() == Some(&id) && task.boot == Some(boot);
            if self.tasks.values().any(is_known) {
                continue;
            }
            let task = self.number_task();
            let Phase::Stopping(stopping) = &mut self.phase else {
                return;
            };
            stopping.tasks.insert(task);
            self.live.insert(task);
            let found = RunTask {
                state: TaskState::Accepted,
                id: Some(id.clone()),
                ours: true,
                boot: Some(boot),
                ..RunTask::new(now, remote.to_owned())
            };
            self.tasks.insert(task, found);
            self.emit(RunEvent::TaskFound {
                task,
                remote: remote.to_owned(),
                id,
                text,
            });
            self.abort(now, task);
        }
    }

    /// Asks once more about tasks in the background, then ends the run.
    pub(super) fn leave(&mut self, now: Instant) {
        self.question = None;
        let unseen = |number: &TaskNumber| {
            let task = self.tasks.get(number);
            task.is_some_and(|task| task.asked.is_none() && task.can_be_asked())
        };
        let unseen: Vec<TaskNumber> = self.live.iter().copied().filter(unseen).collect();
        let asked = unseen
            .into_iter()
            .filter_map(|number| self.ask_about(now, number, true));
        self.phase = Phase::Settling(asked.collect());
        self.settle();
    }
}
