//! Stopping everything that a run has started, and what came of it; ABORTs at a task's limit too.

use ztl_core::{Instant, State};

use super::super::event::{By, Command, Event, Outcome, TaskNumber, TaskState};
use super::{Answer, POLL, Phase, Player};

/// How often a task is told to stop before it is given up.
const TRIES: u32 = 3;

/// Of a task whose INIT was not answered.
pub(super) const UNNAMED: &str =
    "whether it was started is unknown, and it cannot be named to the server";

impl Player {
    /// Stops everything.
    pub(super) fn stop(&mut self, now: Instant, by: By) {
        let (scene, step) = self.place();
        self.events.push_back(Event::Decided {
            command: Command::Stop,
            by,
            scene,
            step,
        });
        self.leave_play();
        self.question = None;
        self.phase = Phase::Stopping(self.live.clone());
        let tasks: Vec<TaskNumber> = self.live.iter().copied().collect();
        self.events.push_back(Event::Stopping {
            tasks: tasks.clone(),
        });
        for number in tasks {
            let Some(task) = self.tasks.get_mut(&number) else {
                continue;
            };
            task.aborts = 0;
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
        let stopping = matches!(self.phase, Phase::Stopping(_));
        let unstoppable =
            matches!(&answer, Answer::Task { state, text } if !state.is_final() && text == "False");
        let words = match &answer {
            Answer::Task { state, .. } if state.is_final() => None,
            Answer::Task { text, .. } if unstoppable => {
                Some(format!("it cannot be stopped, and goes on ({text})"))
            }
            Answer::Task { text, .. } => Some(format!("it has not ended yet ({text})")),
            Answer::TaskUnknown { text, .. } | Answer::Nothing { text, .. } => Some(text.clone()),
            _ => None,
        };
        let forgotten = matches!(answer, Answer::TaskUnknown { .. });
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
                self.stop(now, By::Script);
            }
            return;
        };
        if unstoppable || forgotten || gives_up {
            self.tell_stop(number, false, &words);
        }
    }

    /// Tells of tasks that have ended, and ends when there is nothing more to wait for.
    pub(super) fn settle(&mut self) {
        match &self.phase {
            Phase::Stopping(tasks) => {
                let all = tasks.clone();
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
                if all.iter().all(told) {
                    self.over(Outcome::Stopped);
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
