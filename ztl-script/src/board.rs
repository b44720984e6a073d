//! The state of a run as views show it, computed from its events only.

mod notes;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use ztl_core::dispatcher::NOTHING_KNOWN;

use crate::event::{
    DecidedBy, Ending, Outline, Question, RemoteOutline, RequestNumber, RunCommand, RunEvent,
    RunOutcome, ServerState, StampedEvent, TaskNumber, TaskOutline, TaskState, WaitReason,
};

pub use notes::Note;

/// Longest text of a server that a view shows, in bytes. The record has it in full.
const LONGEST_TEXT: usize = 4000;

/// The state of a run.
#[derive(Debug, Clone, Default)]
pub struct RunBoard {
    /// The script file, as given.
    pub script: String,
    /// What the script plans.
    pub outline: Outline,
    /// The servers of the script, by name.
    pub servers: Vec<(String, ServerView)>,
    /// Time of the last event.
    pub at: Duration,
    /// The progress of each scene.
    pub scenes: Vec<Progress>,
    /// Duration of the last take of each scene.
    pub lengths: Vec<Option<Duration>>,
    /// The scene that is shown or playing.
    pub scene: Option<usize>,
    /// The scene that is playing, or was played last.
    pub played: Option<SceneRun>,
    /// The tasks that run, and those of the last take of a scene.
    pub tasks: BTreeMap<TaskNumber, TaskRun>,
    /// The question that stands.
    pub question: Option<Question>,
    /// Number of questions so far, so that an answer never counts for the next one.
    pub questions: u64,
    choices: Vec<RunCommand>,
    /// Whether the operator ordered a pause after this step.
    pub pause: bool,
    /// Whether the run pauses.
    pub paused: bool,
    /// Why the step waits, and the tasks concerned.
    pub waiting: Option<(WaitReason, Vec<TaskNumber>)>,
    /// Whether the operator leaves, while the final states of tasks are read once.
    leaving: bool,
    /// The last stop, until the next decision.
    pub stopping: Option<Stopping>,
    /// The last key, what it meant, and when it was pressed.
    pub key: Option<(String, Option<RunCommand>, Duration)>,
    /// Notes, the newest ones last.
    pub notes: VecDeque<Note>,
    /// How the run ended, the tasks that may still run, and more about it.
    pub ended: Option<(RunOutcome, Vec<TaskNumber>, String)>,
    requests: BTreeMap<RequestNumber, String>,
}

/// The tasks that are being stopped.
#[derive(Debug, Clone)]
pub struct Stopping {
    /// What was ordered.
    pub command: RunCommand,
    /// For each task whether the stop was confirmed, and the text; `None` until it is answered.
    pub answers: BTreeMap<TaskNumber, Option<(bool, String)>>,
    /// For each server asked for the tasks that others started, whether its list is complete; `None` until
    /// it is answered.
    pub lists: BTreeMap<String, Option<bool>>,
    /// Whether the run waits for no more answers.
    pub over: bool,
}

/// A server of the script.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ServerView {
    /// Its state; `None` if it was not asked yet.
    pub state: Option<ServerState>,
    /// Since when.
    pub since: Duration,
    /// Latency of the last answer, without held ones.
    pub latency: Option<Duration>,
}

/// The progress of a scene or step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Progress {
    /// Not played.
    #[default]
    Pending,
    /// It plays.
    Playing,
    /// It is over.
    Completed,
    /// It is over, and something failed.
    Failed,
    /// It was left before its end.
    Stopped,
    /// It was skipped.
    Skipped,
}

/// A take of a scene.
#[derive(Debug, Clone)]
pub struct SceneRun {
    /// Its scene.
    pub scene: usize,
    /// How many times the scene has started, from 1.
    pub take: u32,
    /// When it began.
    pub from: Duration,
    /// When it ended.
    pub to: Option<Duration>,
    /// The progress of its steps.
    pub steps: Vec<StepRun>,
}

/// A step of a take.
#[derive(Debug, Clone, Default)]
pub struct StepRun {
    /// Whether it plays, or how it ended.
    pub progress: Progress,
    /// When it began.
    pub from: Duration,
    /// When it ended.
    pub to: Option<Duration>,
}

/// A task.
#[derive(Debug, Clone)]
pub struct TaskRun {
    /// `handler:component:goal`.
    pub name: String,
    /// Its scene, step and place there; `None` for one of a cue or of another client.
    pub place: Option<(usize, usize, usize)>,
    /// Its cue.
    pub cue: Option<usize>,
    /// Whether it belongs to the current take of its scene.
    pub current: bool,
    /// Whether it is a retry.
    pub again: bool,
    /// When it began.
    pub from: Duration,
    /// When it ended.
    pub to: Option<Duration>,
    /// Its state.
    pub state: TaskState,
    /// Progress, result or reason.
    pub text: String,
}

impl TaskRun {
    fn new(from: Duration) -> Self {
        Self {
            name: String::new(),
            place: None,
            cue: None,
            current: false,
            again: false,
            from,
            to: None,
            state: TaskState::Asked,
            text: String::new(),
        }
    }
}

impl RunBoard {
    /// Applies an event, in time linear in the running tasks and the steps of one scene.
    pub fn handle(&mut self, StampedEvent { at, event, .. }: &StampedEvent) {
        let at = *at;
        self.at = at;
        match event {
            RunEvent::RunStarted(started) => {
                self.script.clone_from(&started.script);
                self.outline.clone_from(&started.outline);
                self.scenes = vec![Progress::Pending; self.outline.scenes.len()];
                self.lengths = vec![None; self.scenes.len()];
                let server = |remote: &RemoteOutline| {
                    let mut server = ServerView::default();
                    if remote.endpoint.is_none() {
                        let text = "no valid entry in the configuration".to_owned();
                        server.state = Some(ServerState::Absent { text });
                    }
                    (remote.name.clone(), server)
                };
                self.servers = started.remotes.iter().map(server).collect();
            }
            RunEvent::SceneShown { scene } => self.scene = Some(*scene),
            RunEvent::Asked { question, choices } => {
                self.question = Some(*question);
                self.choices.clone_from(choices);
                self.questions += 1;
                if let Some(stopping) = &mut self.stopping {
                    stopping.over = true;
                }
            }
            RunEvent::Key { key, command } => {
                self.key = Some((key.clone(), *command, at));
            }
            RunEvent::Decided { command, by, .. } => self.decide(*command, *by),
            RunEvent::SceneStarted { scene, take, .. } => self.start_scene(at, *scene, *take),
            RunEvent::SceneEnded { scene, end, .. } => {
                if let Some(played) = &mut self.played {
                    played.to = Some(at);
                    if let Some(length) = self.lengths.get_mut(*scene) {
                        *length = Some(at.saturating_sub(played.from));
                    }
                }
                let progress = match end {
                    Ending::Completed => Progress::Completed,
                    Ending::Failures => Progress::Failed,
                    Ending::Stopped => Progress::Stopped,
                };
                self.set_progress(*scene, progress);
            }
            RunEvent::SceneSkipped { scene, .. } => self.set_progress(*scene, Progress::Skipped),
            RunEvent::StepStarted { step, .. } => {
                self.with_step(*step, |shown| {
                    *shown = StepRun {
                        progress: Progress::Playing,
                        from: at,
                        to: None,
                    };
                });
            }
            RunEvent::StepEnded { step, end, .. } => {
                self.waiting = None;
                self.unask(|question| matches!(question, Question::Step { .. }));
                self.with_step(*step, |shown| {
                    shown.to = Some(at);
                    shown.progress = match end {
                        Ending::Completed => Progress::Completed,
                        Ending::Failures => Progress::Failed,
                        Ending::Stopped => Progress::Stopped,
                    };
                });
            }
            RunEvent::StepSkipped { step, .. } => {
                self.with_step(*step, |shown| shown.progress = Progress::Skipped);
            }
            RunEvent::StepWaiting { why, tasks, .. } => {
                self.waiting = Some((why.clone(), tasks.clone()));
            }
            RunEvent::StepGoesOn { .. } => {
                self.waiting = None;
                self.unask(|question| matches!(question, Question::Step { .. }));
            }
            RunEvent::Paused { .. } => {
                self.pause = false;
                self.paused = true;
            }
            RunEvent::Resumed => {
                self.paused = false;
                self.unask(|question| question == Question::Pause);
            }
            RunEvent::TaskStarting {
                task,
                scene,
                step,
                part,
                retry_of,
            } => self.start_task(at, *task, (*scene, *step, *part), retry_of.is_some()),
            RunEvent::CueStarting { task, cue, part } => {
                // What it started before is over.
                self.tasks
                    .retain(|_, task| task.cue != Some(*cue) || !task.state.is_over());
                let outline = self.outline.cues.get(*cue);
                let plan = outline.and_then(|cue| cue.tasks.get(*part));
                let started = TaskRun {
                    name: plan.map(TaskOutline::name).unwrap_or_default(),
                    cue: Some(*cue),
                    ..TaskRun::new(at)
                };
                self.tasks.insert(*task, started);
            }
            RunEvent::TaskState {
                task, state, text, ..
            } => self.task_state(at, *task, *state, text),
            RunEvent::RequestSent {
                request,
                remote,
                hold: None,
                ..
            } => {
                self.requests.insert(*request, remote.clone());
            }
            RunEvent::Answered {
                request, latency, ..
            } => {
                if let Some(remote) = self.requests.remove(request)
                    && let Some((_, server)) = self.servers.iter_mut().find(|it| it.0 == remote)
                {
                    server.latency = Some(*latency);
                }
            }
            RunEvent::Unanswered { request, .. } => drop(self.requests.remove(request)),
            RunEvent::Server { remote, state } => {
                let state = match state {
                    ServerState::Absent { text } => ServerState::Absent { text: cut(text) },
                    state => state.clone(),
                };
                let server = ServerView {
                    state: Some(state),
                    since: at,
                    latency: None,
                };
                match self.servers.iter_mut().find(|(name, _)| name == remote) {
                    Some((_, known)) => *known = server,
                    None => self.servers.push((remote.clone(), server)),
                }
            }
            RunEvent::TaskFound { task, text, .. } => {
                let found = TaskRun {
                    name: cut(text),
                    state: TaskState::Accepted,
                    ..TaskRun::new(at)
                };
                self.tasks.insert(*task, found);
                self.stop_answer(*task, None);
            }
            RunEvent::Stopping { tasks, remotes } => {
                for task in tasks {
                    self.stop_answer(*task, None);
                }
                if let Some(stopping) = &mut self.stopping {
                    let asked = remotes.iter().map(|remote| (remote.clone(), None));
                    stopping.lists.extend(asked);
                }
            }
            RunEvent::TasksListed { remote, gaps } => {
                let lists = self.stopping.as_mut().map(|it| &mut it.lists);
                if let Some(list) = lists.and_then(|lists| lists.get_mut(remote)) {
                    *list = Some(gaps.is_empty());
                }
            }
            RunEvent::StopAnswered {
                task,
                confirmed,
                text,
            } => self.stop_answer(*task, Some((*confirmed, cut(text)))),
            RunEvent::Note { text } => self.note(cut(text)),
            RunEvent::RunEnded {
                outcome,
                running,
                text,
            } => {
                self.ended = Some((*outcome, running.clone(), cut(text)));
                self.question = None;
            }
            _ => {}
        }
    }

    /// The commands that are possible now.
    pub fn choices(&self) -> Vec<RunCommand> {
        if self.ended.is_some() {
            Vec::new()
        } else if let Some(stopping) = self.stopping.as_ref().filter(|it| !it.over) {
            match stopping.command {
                RunCommand::StopScene => vec![RunCommand::StopAll, RunCommand::Stop],
                RunCommand::StopAll => vec![RunCommand::Stop],
                _ => vec![RunCommand::Leave],
            }
        } else if self.question.is_some() {
            self.choices.clone()
        } else if self.leaving {
            vec![RunCommand::Leave]
        } else if !self.plays() {
            vec![RunCommand::StopAll, RunCommand::Stop]
        } else {
            let mut choices = vec![match self.pause {
                true => RunCommand::Resume,
                false => RunCommand::Pause,
            }];
            // Only if the operator is asked between scenes.
            if self.choices.contains(&RunCommand::StopAll) {
                choices.extend([RunCommand::StopScene, RunCommand::StopAll]);
            }
            choices.push(RunCommand::Stop);
            choices
        }
    }

    fn stop_answer(&mut self, task: TaskNumber, answer: Option<(bool, String)>) {
        if let Some(stopping) = &mut self.stopping {
            stopping.answers.insert(task, answer);
        }
    }

    /// Tasks that may still run and are not part of the playing step.
    pub fn in_background(&self) -> impl Iterator<Item = &TaskRun> {
        let step = self.playing_step();
        self.tasks.values().filter(move |task| {
            let place = task.place.map(|(scene, step, _)| (scene, step));
            let here = task.current && place == step;
            !task.state.is_over() && !here
        })
    }

    /// Whether the script has cues.
    pub fn has_cues(&self) -> bool {
        !self.outline.cues.is_empty()
    }

    /// Whether a task failed, a server is missing, or there are notes.
    pub fn has_details(&self) -> bool {
        let wrong = |task: &TaskRun| task.state.is_failure() || task.state == TaskState::Unknown;
        let missing = |(_, server): &(String, ServerView)| {
            let state = server.state.as_ref();
            matches!(
                state,
                Some(ServerState::Absent { .. } | ServerState::Silent)
            )
        };
        self.tasks.values().any(wrong) || self.servers.iter().any(missing) || !self.notes.is_empty()
    }

    /// Whether a scene is playing.
    fn plays(&self) -> bool {
        self.played
            .as_ref()
            .is_some_and(|played| played.to.is_none())
    }

    /// The playing scene and step.
    pub fn playing_step(&self) -> Option<(usize, usize)> {
        let played = self.played.as_ref().filter(|played| played.to.is_none())?;
        let playing = |step: &StepRun| step.progress == Progress::Playing;
        Some((played.scene, played.steps.iter().position(playing)?))
    }

    fn decide(&mut self, command: RunCommand, by: DecidedBy) {
        match command {
            RunCommand::Pause => self.pause = true,
            RunCommand::Resume => self.pause = false,
            RunCommand::Leave => self.leaving = true,
            _ => {}
        }
        if !matches!(
            command,
            RunCommand::Pause | RunCommand::Resume | RunCommand::Leave
        ) {
            let stops = matches!(
                command,
                RunCommand::StopScene | RunCommand::StopAll | RunCommand::Stop
            );
            self.stopping = stops.then(|| Stopping {
                command,
                answers: BTreeMap::new(),
                lists: BTreeMap::new(),
                over: false,
            });
        }
        // A pause ordered while a step waits does not answer its question.
        if command != RunCommand::Pause || self.question == Some(Question::Pause) {
            self.question = None;
        }
        if by == DecidedBy::Operator && command == RunCommand::Restart {
            self.scenes.fill(Progress::Pending);
        }
        if !matches!(command, RunCommand::Pause | RunCommand::Resume) {
            self.paused = false;
        }
    }

    fn start_scene(&mut self, at: Duration, scene: usize, take: u32) {
        self.question = None;
        // A pause that was ordered before is over.
        self.pause = false;
        self.scene = Some(scene);
        self.set_progress(scene, Progress::Playing);
        // Ended tasks are covered by the sign of their scene; the others continue in the background.
        self.tasks.retain(|_, task| !task.state.is_over());
        for task in self.tasks.values_mut() {
            task.current = false;
        }
        let steps = self
            .outline
            .scenes
            .get(scene)
            .map_or(0, |scene| scene.steps.len());
        self.played = Some(SceneRun {
            scene,
            take,
            from: at,
            to: None,
            steps: vec![StepRun::default(); steps],
        });
    }

    fn set_progress(&mut self, scene: usize, progress: Progress) {
        if let Some(shown) = self.scenes.get_mut(scene) {
            *shown = progress;
        }
    }

    fn with_step(&mut self, step: usize, change: impl FnOnce(&mut StepRun)) {
        if let Some(shown) = self
            .played
            .as_mut()
            .and_then(|played| played.steps.get_mut(step))
        {
            change(shown);
        }
    }

    fn unask(&mut self, which: impl FnOnce(Question) -> bool) {
        if self.question.is_some_and(which) {
            self.question = None;
        }
    }

    fn start_task(
        &mut self,
        at: Duration,
        number: TaskNumber,
        (scene, step, part): (usize, usize, usize),
        again: bool,
    ) {
        let scenes = self.outline.scenes.get(scene);
        let steps = scenes.and_then(|scene| scene.steps.get(step));
        let name = match steps.and_then(|step| step.tasks.get(part)) {
            Some(task) => task.name(),
            None => format!("task {}", number.0),
        };
        let task = TaskRun {
            name,
            place: Some((scene, step, part)),
            current: true,
            again,
            ..TaskRun::new(at)
        };
        self.tasks.insert(number, task);
    }

    fn task_state(&mut self, at: Duration, number: TaskNumber, state: TaskState, text: &str) {
        if let Some(task) = self.tasks.get_mut(&number) {
            task.state = state;
            // A gateway puts the request before the reason; the screen shows the request already.
            let text = match text.split_once("' refused: ") {
                Some((request, reason)) if request.starts_with('\'') => reason,
                // As long as there is no progress.
                None if text == NOTHING_KNOWN && !state.is_over() => "",
                _ => text,
            };
            task.text = cut(text);
            if state.is_over() && task.to.is_none() {
                task.to = Some(at);
            }
        }
        // It ended after the run gave up stopping it.
        let stopping = self.stopping.as_mut();
        if let Some(answer) = stopping.and_then(|it| it.answers.get_mut(&number))
            && matches!(answer, Some((false, _)))
            && state.is_over()
        {
            *answer = Some((true, state.to_string()));
        }
    }
}

/// A text as a view shows it: if it is long, its beginning and its length.
fn cut(text: &str) -> String {
    match text.get(..text.floor_char_boundary(LONGEST_TEXT)) {
        Some(start) if start.len() < text.len() => format!("{start}… ({} bytes)", text.len()),
        _ => text.to_owned(),
    }
}
