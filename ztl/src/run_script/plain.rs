//! The plain view: the output and keys of the original's `ztl_run_script` (`docs/compatibility.md`, "Scripts").

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tracing::{error, info, warn};
use ztl_script::event::{
    DecidedBy, Question, RunCommand, RunEvent, TaskNumber, TaskState, WaitReason,
};
use ztl_script::{RunnerHandle, Scene, Script, Step, Task};

use super::output::LineOutput;
use crate::keyboard::{KeyBytes, Keyboard};

/// The log target of the original.
pub(super) const LOG: &str = "script-exec";

pub(super) struct PlainView<'s> {
    script: &'s Script,
    lines: LineOutput,
    /// Wakes the run when a question is visible.
    inputs: RunnerHandle,
    /// The question, its answers, and since when it is visible.
    asked: Option<(Question, Vec<RunCommand>, Since)>,
    last_scene: Option<usize>,
    tasks: BTreeMap<TaskNumber, Started>,
    /// The scene, step and handler without a server that was reported last.
    reported: Option<(usize, usize, usize)>,
    playing: bool,
}

type Since = Arc<OnceLock<Instant>>;

#[derive(Debug, Clone, Copy)]
struct Started {
    scene: usize,
    step: usize,
    part: usize,
    state: TaskState,
}

impl<'s> PlainView<'s> {
    pub(super) const fn new(script: &'s Script, lines: LineOutput, inputs: RunnerHandle) -> Self {
        Self {
            script,
            lines,
            inputs,
            asked: None,
            last_scene: None,
            tasks: BTreeMap::new(),
            reported: None,
            playing: false,
        }
    }

    /// The question that stands.
    pub(super) fn question(&self) -> Option<Question> {
        self.asked.as_ref().map(|(question, _, _)| *question)
    }

    /// Whether a question is not visible yet. Keys wait for it.
    pub(super) fn is_asking(&self) -> bool {
        let asked = self.asked.as_ref();
        asked.is_some_and(|(_, _, since)| since.get().is_none())
    }

    /// What a key means: nothing if it was pressed before the question was visible.
    pub(super) fn meaning(&self, key: &KeyBytes) -> Option<RunCommand> {
        let (question, choices, since) = self.asked.as_ref()?;
        if since.get().is_none_or(|since| key.at < *since) {
            return None;
        }
        let first = key.bytes.first()?.to_ascii_lowercase();
        let command = match (question, first) {
            (Question::Scene { .. }, b'\r') => RunCommand::Start,
            (Question::Scene { .. } | Question::End, b'r')
                if choices.contains(&RunCommand::Replay) =>
            {
                RunCommand::Replay
            }
            (Question::Scene { .. }, _) => RunCommand::Skip,
            (Question::End, b'a') => RunCommand::Restart,
            (Question::End, _) => RunCommand::Leave,
            (Question::Step { .. }, b'g') => RunCommand::GoOn,
            (Question::Step { .. }, b't') => RunCommand::Retry,
            (Question::Step { .. }, b's') => RunCommand::Skip,
            (Question::Step { .. }, b'x') => RunCommand::Stop,
            (Question::Pause, _) => RunCommand::Resume,
            _ => return None,
        };
        choices.contains(&command).then_some(command)
    }

    /// Writes the lines of an event.
    pub(super) fn handle(&mut self, event: &RunEvent, keyboard: Option<&Keyboard>) {
        match event {
            RunEvent::SceneShown { scene } if keyboard.is_some() => self.show(*scene),
            RunEvent::Asked { question, choices } => {
                if let Some(keyboard) = keyboard {
                    keyboard.clear();
                }
                let since = Since::default();
                if keyboard.is_some() {
                    let (seen, inputs) = (Arc::clone(&since), self.inputs.clone());
                    self.lines.ask(prompt(*question, choices), move |at| {
                        // The question is written once.
                        let _ = seen.set(at);
                        inputs.wake();
                    });
                }
                self.asked = Some((*question, choices.clone(), since));
            }
            RunEvent::Decided {
                command, by, scene, ..
            } => self.decided(*command, *by, *scene),
            RunEvent::SceneStarted { scene, .. } => {
                self.playing = true;
                self.last_scene = Some(*scene);
                if let Some(scene) = self.scene(*scene) {
                    let delay = with_delay(scene.delay);
                    self.lines
                        .line(format_args!("EXECUTING SCENE '{}'{delay}...", scene.name));
                }
            }
            RunEvent::SceneEnded { .. } => self.playing = false,
            RunEvent::StepStarted { scene, step } => {
                self.reported = None;
                if let Some(step) = self.script.step(*scene, *step) {
                    let background = if step.wait { "" } else { " IN BACKGROUND" };
                    let delay = with_delay(step.delay);
                    self.lines.line(format_args!(
                        "STARTING STEP '{}'{background}{delay}...",
                        step.name
                    ));
                }
            }
            RunEvent::StepWaiting {
                scene,
                step,
                why,
                tasks,
            } => self.waiting(*scene, *step, why, tasks),
            RunEvent::StepGoesOn { scene, step } => {
                self.asked = None;
                if let Some(step) = self.script.step(*scene, *step) {
                    warn!(target: LOG, "Step '{}' goes on.", step.name);
                }
            }
            RunEvent::TaskStarting {
                task,
                scene,
                step,
                part,
                ..
            } => {
                let state = TaskState::Asked;
                let started = Started {
                    scene: *scene,
                    step: *step,
                    part: *part,
                    state,
                };
                self.tasks.insert(*task, started);
            }
            RunEvent::TaskState {
                task,
                state,
                text,
                no_server,
                ..
            } => self.state(*task, *state, text, *no_server),
            RunEvent::Stopping { tasks, .. } if !tasks.is_empty() => {
                let s = if tasks.len() == 1 { "" } else { "S" };
                self.lines
                    .line(format_args!("STOPPING {} TASK{s}...", tasks.len()));
            }
            RunEvent::StopAnswered {
                task,
                confirmed,
                text,
            } => {
                let word = if *confirmed {
                    "STOPPED"
                } else {
                    "NOT CONFIRMED"
                };
                self.lines
                    .line(format_args!("{word}: {}: {text}", self.about(*task)));
            }
            RunEvent::Note { text } => warn!(target: LOG, "{text}"),
            RunEvent::RunEnded { running, .. } => {
                for task in running {
                    warn!(target: LOG, "{} may still run.", self.about(*task));
                }
            }
            _ => {}
        }
    }

    fn scene(&self, scene: usize) -> Option<&'s Scene> {
        self.script.scenes.get(scene)
    }

    /// Describes a task in the original's words.
    fn about(&self, number: TaskNumber) -> String {
        match self.task(number) {
            Some((step, task)) => {
                let handler = step.handler(task).map_or("", |handler| &handler.key);
                format!(
                    "Component '{}' on handler '{handler}' for step '{}'",
                    task.component, step.name
                )
            }
            None => format!("Task {}", number.0),
        }
    }

    fn task(&self, number: TaskNumber) -> Option<(&'s Step, &'s Task)> {
        let Started {
            scene, step, part, ..
        } = *self.tasks.get(&number)?;
        let step = self.script.step(scene, step)?;
        Some((step, step.tasks.get(part)?))
    }

    fn show(&self, scene: usize) {
        let Some(scene) = self.scene(scene) else {
            return;
        };
        self.lines.line("\n----------------------------");
        self.lines
            .line(format_args!("ABOUT TO EXECUTE SCENE '{}'", scene.key));
        for step in &scene.steps {
            self.lines.line(format_args!("STEP: {}", step.key));
            for task in &step.tasks {
                let handler = step.handler(task).map_or("", |handler| &handler.key);
                self.lines
                    .line(format_args!("\t{handler} [{}]: -> {}", task.key, task.goal));
            }
        }
    }

    fn decided(&mut self, command: RunCommand, by: DecidedBy, scene: Option<usize>) {
        let asked = self.asked.take().map(|(question, _, _)| question);
        let about_scene = matches!(asked, Some(Question::Scene { .. }));
        let key = |scene: Option<usize>| {
            scene
                .and_then(|scene| self.scene(scene))
                .map_or("", |scene| &scene.key)
        };
        match command {
            RunCommand::Skip if about_scene => self
                .lines
                .line(format_args!("\nSKIPPING SCENE '{}'", key(scene))),
            RunCommand::Replay => self
                .lines
                .line(format_args!("\n Repeating Scene '{}", key(self.last_scene))),
            RunCommand::Restart => {
                self.lines.line("\n Repeating Script");
                self.last_scene = None;
            }
            RunCommand::Stop if by == DecidedBy::Signal && self.playing => {
                error!(target: LOG, "Interrupted, exiting.");
            }
            RunCommand::Stop if by == DecidedBy::Script => {
                error!(target: LOG, "The tasks of this run are aborted, and it ends: the script requires it, or there is no operator to decide.");
            }
            _ => {}
        }
    }

    fn waiting(&mut self, scene: usize, step: usize, why: &WaitReason, tasks: &[TaskNumber]) {
        let Some(step) = self.script.step(scene, step) else {
            return;
        };
        let tasks: Vec<&str> = tasks
            .iter()
            .filter_map(|task| self.task(*task))
            .map(|(_, task)| task.component.trim())
            .collect();
        let (name, tasks) = (&step.name, tasks.join(", "));
        let why = match why {
            WaitReason::ServerSilent { remote } => {
                format!("'{remote}' does not answer, so the state of {tasks} is unknown")
            }
            WaitReason::ServerRestarted { remote } => {
                format!("'{remote}' was restarted, so the outcome of {tasks} is unknown")
            }
            WaitReason::TaskUnknown => {
                format!("the server has lost its tasks, so the outcome of {tasks} is unknown")
            }
            WaitReason::NotTold { remote } => {
                format!("'{remote}' answers, but does not report the state of {tasks}")
            }
            WaitReason::AnswerUnclear { remote } => {
                format!("'{remote}' gives no usable answer about {tasks}, so its state is unknown")
            }
            WaitReason::StartUnknown => format!("no clear answer whether {tasks} was started"),
            WaitReason::Failed => format!("{tasks} failed"),
            WaitReason::TooLong => {
                format!("{tasks} takes longer than its limit and has not stopped")
            }
        };
        warn!(target: LOG, "Step '{name}' waits: {why}.");
    }

    fn state(&mut self, number: TaskNumber, state: TaskState, text: &str, no_server: bool) {
        let Some(started) = self.tasks.get_mut(&number) else {
            return;
        };
        let before = std::mem::replace(&mut started.state, state);
        let Started {
            scene, step: index, ..
        } = *started;
        let Some((step, task)) = self.task(number) else {
            return;
        };
        let Some(handler) = step.handler(task) else {
            return;
        };
        let (name, key, component) = (&step.name, &handler.key, &task.component);
        match state {
            TaskState::NotStarted if no_server => {
                let place = (scene, index, task.handler);
                if self.reported != Some(place) {
                    self.reported = Some(place);
                    error!(target: LOG, "No remote for handler '{key}'. Step '{name}' COULD NOT BE TRIGGERED. REPLY: '{text}'");
                }
            }
            TaskState::NotStarted | TaskState::Refused => could_not(name, key, component, text),
            TaskState::Unknown if before == TaskState::Asked => {
                could_not(name, key, component, text)
            }
            state
                if before == TaskState::Asked && !state.is_over() && !(step.wait && task.wait) =>
            {
                info!(target: LOG, "Component '{component}' on handler '{key}' for step '{name}' TRIGGERED TO RUN IN BACKGROUND.");
            }
            state if state.is_failure() => {
                let word = state.name().to_uppercase();
                warn!(target: LOG, "Component '{component}' on handler '{key}' for step '{name}' ended {word}. REPLY: '{text}'");
            }
            _ => {}
        }
    }
}

/// The question and its keys.
fn prompt(question: Question, choices: &[RunCommand]) -> &'static str {
    let can = |command| choices.contains(&command);
    match question {
        Question::Scene { .. } if can(RunCommand::Replay) => {
            "PRESS <ENTER> TO CONFIRM, PRESS <R> TO REPLAY LAST SCENE OR ANY OTHER KEY TO SKIP"
        }
        Question::Scene { .. } => "PRESS <ENTER> TO CONFIRM or ANY OTHER KEY TO SKIP",
        Question::End if can(RunCommand::Replay) => {
            "PRESS <R> TO REPLAY THE LAST SCENE, PRESS <A> TO RESTART THE SCRIPT OR ANY OTHER KEY TO EXIT"
        }
        Question::End => "PRESS <A> TO RESTART THE SCRIPT OR ANY OTHER KEY TO EXIT",
        Question::Step { .. } if can(RunCommand::Retry) => {
            "PRESS <G> TO GO ON ANYWAY, <T> TO TRY AGAIN WHAT FAILED, <S> TO SKIP THE REST OF THE SCENE OR <X> TO ABORT ALL TASKS OF THIS RUN AND END IT"
        }
        Question::Step { .. } => {
            "PRESS <G> TO GO ON ANYWAY, <S> TO SKIP THE REST OF THE SCENE OR <X> TO ABORT ALL TASKS OF THIS RUN AND END IT"
        }
        Question::Pause => "PRESS ANY KEY TO GO ON",
    }
}

fn could_not(step: &str, handler: &str, component: &str, reply: &str) {
    error!(target: LOG, "Component '{component}' on handler '{handler}' for step '{step}' COULD NOT BE TRIGGERED. REPLY: '{reply}'");
}

fn with_delay(delay: Duration) -> String {
    match delay.is_zero() {
        true => String::new(),
        false => format!(" WITH DELAY {}s", delay.as_secs_f64()),
    }
}
