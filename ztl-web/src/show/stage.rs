//! What clients are shown of the show.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use serde_json::{Value, json};
use ztl_script::board::{Progress, RunBoard, TaskRun};
use ztl_script::event::{
    Question, RunCommand, RunEvent, ServerState, StampedEvent, StepOutline, TaskNumber, WaitReason,
};
use ztl_script::{OperatorGone, Script};
use ztl_std::RemoteId;

use crate::clock::now_ms;
use crate::cut;

/// Notes that are shown.
const NOTES: usize = 20;
/// Most tasks in a list.
const TASKS: usize = 100;

pub(super) struct Stage {
    run: RunBoard,
    /// The ids and servers of tasks that run.
    ids: BTreeMap<TaskNumber, (String, Option<RemoteId>)>,
    /// The newest last, each with the console's time.
    notes: VecDeque<(u64, String)>,
    is_recorded: bool,
    /// What the number of the first question follows. A console that starts later counts from later.
    before: u64,
}

impl Stage {
    pub(super) fn new(is_recorded: bool) -> Self {
        Self {
            run: RunBoard::default(),
            ids: BTreeMap::new(),
            notes: VecDeque::new(),
            is_recorded,
            before: now_ms(),
        }
    }

    pub(super) fn handle(&mut self, event: &StampedEvent) {
        self.run.handle(event);
        match &event.event {
            RunEvent::Note { text } => {
                if self.notes.len() >= NOTES {
                    self.notes.pop_front();
                }
                self.notes
                    .push_back((now_ms(), cut::text(text, 4 * cut::LINE)));
                // Kept here, with their times.
                self.run.notes.clear();
            }
            RunEvent::RequestSent {
                remote,
                task: Some(task),
                ..
            } => {
                self.ids
                    .entry(*task)
                    .or_insert_with(|| (remote.clone(), None));
            }
            RunEvent::TaskState {
                task, state, id, ..
            } => {
                if state.is_over() {
                    self.ids.remove(task);
                } else if let Some((_, known)) = self.ids.get_mut(task) {
                    known.clone_from(id);
                }
            }
            _ => {}
        }
    }

    pub(super) fn has_ended(&self) -> bool {
        self.run.ended.is_some()
    }

    pub(super) fn at(&self) -> Duration {
        self.run.at
    }

    pub(super) fn question(&self) -> Option<Question> {
        self.run.question
    }

    /// The number of the open question.
    pub(super) fn question_number(&self) -> Option<u64> {
        let number = self.before.saturating_add(self.run.questions);
        self.run.question.map(|_| number)
    }

    /// What a cue plans.
    pub(super) fn cue(&self, cue: usize) -> Option<&StepOutline> {
        self.run.outline.cues.get(cue)
    }

    /// The scene and take that play.
    pub(super) fn playing(&self) -> Option<(usize, u32)> {
        let played = self.run.played.as_ref();
        let played = played.filter(|played| played.to.is_none());
        played.map(|played| (played.scene, played.take))
    }

    /// The tasks of cues that run, with their ids.
    pub(super) fn cue_tasks(&self) -> Vec<(TaskNumber, usize, RemoteId)> {
        let tasks = self.run.tasks.iter();
        let of_cues = tasks.filter(|(_, task)| !task.state.is_over());
        let of_cues = of_cues.filter_map(|(number, task)| {
            let (_, id) = self.ids.get(number)?;
            Some((*number, task.cue?, id.clone()?))
        });
        of_cues.collect()
    }

    /// The server of a task that runs.
    pub(super) fn remote_of(&self, task: TaskNumber) -> &str {
        self.ids.get(&task).map_or("", |(remote, _)| remote)
    }

    /// As the topic shows it.
    pub(super) fn shown(&self, script: &Script) -> Value {
        let run = &self.run;
        let (scenes, cues) = (&run.outline.scenes, &run.outline.cues);
        let shown = run.scene;
        let steps = shown.and_then(|scene| scenes.get(scene));
        let steps = steps.map_or(&[][..], |scene| scene.steps.as_slice());
        let names = scenes.iter().zip(&run.scenes).map(|(scene, progress)| {
            json!({ "name": cut::text(&scene.name, cut::LINE), "state": word(*progress) })
        });
        let steps = steps.iter().enumerate();
        let steps: Vec<Value> = steps
            .filter_map(|(index, step)| Some(self.step(shown?, index, step)))
            .collect();
        let of_scene = shown.and_then(|scene| script.scenes.get(scene));
        let stopping = run.stopping.as_ref().map(|stopping| {
            let answers = stopping.answers.iter().take(TASKS);
            let tasks = answers.map(|(number, answer)| {
                let name = run.tasks.get(number).map(|task| task.name.as_str());
                json!({
                    "number": number,
                    "task": cut::text(name.unwrap_or_default(), cut::LINE),
                    "confirmed": answer.as_ref().map(|(confirmed, _)| confirmed),
                    "text": answer.as_ref().map(|(_, text)| cut::text(text, cut::LINE)),
                })
            });
            json!({ "over": stopping.over, "tasks": tasks.collect::<Vec<_>>() })
        });
        let cues = cues.iter().zip(&script.cues).enumerate();
        let cues = cues.map(|(index, (outline, cue))| {
            let runs = run.tasks.values().filter(|task| task.cue == Some(index));
            let tasks: Vec<Value> = runs.take(TASKS).map(task).collect();
            json!({
                "name": cut::text(&outline.name, cut::LINE),
                "key": outline.key,
                "does": outline.tasks.iter().map(|task| cut::text(&task.name(), cut::LINE)).collect::<Vec<_>>(),
                "gone": gone(cue.operator_gone),
                "tasks": tasks,
            })
        });
        let servers = run.servers.iter().map(|(name, server)| {
            let (state, text) = match &server.state {
                None => ("unknown", String::new()),
                Some(ServerState::Answering { .. }) => ("answers", String::new()),
                Some(ServerState::Silent) => ("silent", String::new()),
                Some(ServerState::Restarted) => ("restarted", String::new()),
                Some(ServerState::Absent { text }) => ("missing", cut::text(text, cut::LINE)),
            };
            json!({ "name": name, "state": state, "text": text })
        });
        let background = run.in_background().filter(|task| task.cue.is_none());
        json!({
            "script": run.script,
            "scenes": names.collect::<Vec<_>>(),
            "scene": shown,
            "plays": self.playing().is_some(),
            "gone": of_scene.map(|scene| gone(scene.operator_gone)),
            "steps": steps,
            "background": background.take(TASKS).map(task).collect::<Vec<_>>(),
            "question": run.question.map(|question| json!({
                "number": self.question_number(),
                "about": about(question),
            })),
            "choices": self.choices(),
            "waiting": run.waiting.as_ref().map(|(why, tasks)| self.waiting(why, tasks)),
            "stopping": stopping,
            "servers": servers.collect::<Vec<_>>(),
            "cues": cues.collect::<Vec<_>>(),
            "notes": self.notes.iter().map(|(at, text)| json!({ "at_ms": at, "text": text })).collect::<Vec<_>>(),
            "recorded": self.is_recorded,
            "ended": run.ended.is_some(),
        })
    }

    /// Why a step waits, and for which tasks.
    fn waiting(&self, why: &WaitReason, tasks: &[TaskNumber]) -> String {
        let names = tasks.iter().filter_map(|task| self.run.tasks.get(task));
        let names: Vec<&str> = names.map(|task| task.name.as_str()).collect();
        match names.is_empty() {
            true => why.to_string(),
            false => cut::text(&format!("{why}: {}", names.join(", ")), cut::LINE),
        }
    }

    /// The commands that clients may give now.
    fn choices(&self) -> Vec<&'static str> {
        let mut words = Vec::new();
        for command in self.run.choices() {
            let word = match command {
                RunCommand::Start => "start",
                RunCommand::Skip => "skip",
                RunCommand::Replay => "replay",
                RunCommand::Jump { .. } => "jump",
                RunCommand::Restart => "restart",
                RunCommand::Pause => "pause",
                RunCommand::Resume => "resume",
                RunCommand::Retry => "retry",
                RunCommand::GoOn => "go_on",
                RunCommand::StopScene => "stop_scene",
                RunCommand::StopAll | RunCommand::Stop | RunCommand::Leave => continue,
            };
            if !words.contains(&word) {
                words.push(word);
            }
        }
        words
    }

    /// A step of the shown scene, with its tasks: planned, or as they run.
    fn step(&self, scene: usize, index: usize, step: &StepOutline) -> Value {
        let run = &self.run;
        let played = run.played.as_ref().filter(|played| played.scene == scene);
        let state = played.and_then(|played| played.steps.get(index));
        let tasks = step.tasks.iter().enumerate().take(TASKS).map(|(part, plan)| {
            let place = Some((scene, index, part));
            let mut runs = run.tasks.values().rev();
            match runs.find(|task| task.current && task.place == place) {
                Some(run) => task(run),
                None => json!({ "task": cut::text(&plan.name(), cut::LINE), "state": "planned", "text": "" }),
            }
        });
        json!({
            "name": cut::text(&step.name, cut::LINE),
            "state": word(state.map(|state| state.progress).unwrap_or_default()),
            "tasks": tasks.collect::<Vec<_>>(),
        })
    }
}

fn task(task: &TaskRun) -> Value {
    json!({
        "task": cut::text(&task.name, cut::LINE),
        "state": task.state.to_string(),
        "text": cut::text(&task.text, cut::LINE),
    })
}

fn word(progress: Progress) -> &'static str {
    match progress {
        Progress::Pending => "pending",
        Progress::Playing => "playing",
        Progress::Completed => "completed",
        Progress::Failed => "failed",
        Progress::Stopped => "stopped",
        Progress::Skipped => "skipped",
    }
}

fn about(question: Question) -> &'static str {
    match question {
        Question::Scene { .. } => "scene",
        Question::End => "end",
        Question::Step { .. } => "step",
        Question::Pause => "pause",
    }
}

/// What happens if nobody operates: seconds until it is stopped, or `null` if it goes on.
fn gone(gone: OperatorGone) -> Option<u64> {
    match gone {
        OperatorGone::GoOn => None,
        OperatorGone::Stop(after) => Some(after.as_secs()),
    }
}
