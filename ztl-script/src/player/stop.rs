//! Stopping everything that a run has started, and what came of it; ABORTs at a task's limit too.

use ztl_core::{Instant, State};

use std::collections::BTreeSet;

use super::super::event::{
    By, Command, Event, Outcome, Question, RequestNumber, TaskNumber, TaskState,
};
use super::tasks::Live;
use super::{Answer, Ask, POLL, Phase, Player};

/// How often a task is told to stop before it is given up.
const TRIES: u32 = 3;

/// Of a task whose INIT was not answered.
pub(super) const UNNAMED: &str =
    "whether it was started is unknown, and it cannot be named to the server";

/// What is being stopped.
#[derive(Debug)]
pub(super) struct Stopping {
    tasks: BTreeSet<TaskNumber>,
    /// Questions to servers about tasks that others have started.
    asked: BTreeSet<RequestNumber>,
    /// It is everything.
    all: bool,
    /// What is shown afterwards: a scene, or beyond the last the end; `None`: the run is over.
    pub(super) then: Option<usize>,
}

impl Stopping {
    pub(super) fn choices(&self) -> Vec<Command> {
        match (self.then, self.all) {
            (None, _) => vec![Command::Leave],
            (Some(_), true) => vec![Command::Stop],
            (Some(_), false) => vec![Command::StopAll, Command::Stop],
        }
    }
}

impl Player {
    /// Whether a task is being stopped.
    pub(super) fn is_stopping(&self, number: TaskNumber) -> bool {
        matches!(&self.phase, Phase::Stopping(stopping) if stopping.tasks.contains(&number))
    }

    /// What is shown when all that is under way is stopped.
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

    /// Stops the tasks of a scene or all, as the command says.
    pub(super) fn stop(&mut self, now: Instant, command: Command, by: By) {
        let (scene, step) = self.place();
        self.events.push_back(Event::Decided {
            command,
            by,
            scene,
            step,
        });
        let all = command != Command::StopScene;
        let then = (command != Command::Stop).then(|| self.before());
        let here = |number: &TaskNumber| {
            let place = self.tasks.get(number).and_then(|task| task.place);
            place.is_some_and(|(of, ..)| Some(of) == scene)
        };
        let tasks = self.live.iter().copied();
        let tasks: BTreeSet<TaskNumber> = tasks.filter(|number| all || here(number)).collect();
        self.leave_play();
        self.question = None;
        let mut asked = BTreeSet::new();
        if command == Command::StopAll {
            for remote in self.options.remotes.clone() {
                asked.insert(self.send_to(now, &remote, None, Ask::Tasks));
            }
        }
        self.phase = Phase::Stopping(Stopping {
            tasks: tasks.clone(),
            asked,
            all,
            then,
        });
        self.events.push_back(Event::Stopping {
            tasks: tasks.iter().copied().collect(),
        });
        for number in tasks {
            let Some(task) = self.tasks.get_mut(&number) else {
                continue;
            };
            task.aborts = 0;
            task.stop_told = false;
            // One that was asked for and not answered yet is stopped when its id is known.
            if task.id.is_some() {
                self.abort(now, number);
            } else if task.state == TaskState::Unknown {
                self.tell_stop(number, false, UNNAMED);
            }
        }
        self.settle();
    }

    pub(super) fn tell_stop(&mut self, number: TaskNumber, confirmed: bool, text: &str) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        if !task.stop_told {
            task.stop_told = true;
            let text = text.to_owned();
            self.events.push_back(Event::StopAnswered {
                task: number,
                confirmed,
                text,
            });
        }
    }

    /// What a server says of an ABORT.
    pub(super) fn on_abort(&mut self, now: Instant, number: TaskNumber, answer: Answer) {
        let Some(task) = self.tasks.get_mut(&number) else {
            return;
        };
        task.aborting = false;
        task.next = now + POLL;
        let gives_up = task.aborts >= TRIES;
        let stopping = self.is_stopping(number);
        let unstoppable =
            matches!(&answer, Answer::Task { state, text } if !state.is_final() && text == "False");
        let words = match &answer {
            Answer::Task { state, .. } if state.is_final() => None,
            Answer::Task { text, .. } if unstoppable => {
                Some(format!("it cannot be stopped, and goes on ({text})"))
            }
            Answer::Task { text, .. } => Some(format!("it has not ended yet ({text})")),
            Answer::TaskUnknown { text, .. }
            | Answer::NotTold { text }
            | Answer::Unclear { text }
            | Answer::Nothing { text, .. } => Some(text.clone()),
            _ => None,
        };
        // To ask again would not help.
        let hopeless = matches!(answer, Answer::TaskUnknown { .. } | Answer::Unclear { .. });
        // An ABORT's progress is none of the task's.
        let tells = !matches!(
            &answer,
            Answer::Task {
                state: State::Initiated | State::Accepted,
                ..
            }
        );
        if tells {
            self.on_known(now, number, answer);
        }
        let Some(words) = words.filter(|_| stopping) else {
            // A step that cannot be ended by its limit, and nobody who could decide.
            let nobody = self.options.unattended && unstoppable && !stopping;
            if nobody && matches!(self.phase, Phase::Playing(_)) {
                self.stop(now, Command::Stop, By::Script);
            }
            return;
        };
        if unstoppable || hopeless || gives_up {
            self.tell_stop(number, false, &words);
        }
    }

    /// Tells of tasks that have ended, and ends when there is nothing more to wait for.
    pub(super) fn settle(&mut self) {
        match &self.phase {
            Phase::Stopping(stopping) => {
                let (all, then) = (stopping.tasks.clone(), stopping.then);
                let asking = stopping
                    .asked
                    .iter()
                    .any(|request| self.under_way.contains_key(request));
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
                if asking || !all.iter().all(told) {
                    return;
                }
                match then {
                    Some(scene) => self.show(scene),
                    None if self.live.is_empty() => self.over(Outcome::Stopped),
                    None => self.over(Outcome::NotConfirmed),
                }
            }
            Phase::Settling(asked)
                if asked
                    .iter()
                    .all(|request| !self.under_way.contains_key(request)) =>
            {
                self.over(self.fate());
            }
            _ => {}
        }
    }

    /// What a server lists: what this run has not started is stopped too.
    pub(super) fn on_tasks(&mut self, now: Instant, remote: &str, answer: Answer) {
        let (listed, gaps) = match answer {
            Answer::Tasks {
                listed: Some(listed),
                gaps,
            } => (Some(listed), gaps),
            Answer::Nothing { text, .. } | Answer::Unclear { text } => (None, vec![text]),
            _ => (None, vec!["the server does not list its tasks".to_owned()]),
        };
        for why in gaps {
            let text = format!("tasks that others started on '{remote}' may still run: {why}");
            self.events.push_back(Event::Note { text });
        }
        let Some((boot, tasks)) = listed else { return };
        for (id, text) in tasks {
            // Two names may be one server.
            let is_known = |task: &Live| task.id.as_ref() == Some(&id) && task.boot == Some(boot);
            if self.tasks.values().any(is_known) {
                continue;
            }
            let Phase::Stopping(stopping) = &mut self.phase else {
                return;
            };
            let task = TaskNumber(self.next_task);
            self.next_task += 1;
            stopping.tasks.insert(task);
            self.live.insert(task);
            let live = Live {
                state: TaskState::Accepted,
                id: Some(id.clone()),
                ours: true,
                boot: Some(boot),
                ..Live::new(now, remote)
            };
            self.tasks.insert(task, live);
            self.events.push_back(Event::TaskFound {
                task,
                remote: remote.to_owned(),
                id,
                text,
            });
            self.abort(now, task);
        }
    }

    /// Asks once more about tasks in the background, and ends.
    pub(super) fn leave(&mut self, now: Instant) {
        self.question = None;
        let unseen: Vec<TaskNumber> = self
            .live
            .iter()
            .copied()
            .filter(|number| {
                self.tasks
                    .get(number)
                    .is_some_and(|task| task.asked.is_none() && task.can_be_asked())
            })
            .collect();
        let asked = unseen
            .into_iter()
            .filter_map(|number| self.ask_about(now, number, true));
        self.phase = Phase::Settling(asked.collect());
        self.settle();
    }
}
