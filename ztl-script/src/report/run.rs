//! What happened in a run: scenes, steps, tasks, the operator's actions, waits, and the latencies of
//! servers.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::event::{
    DecidedBy, Ending, Outline, RunCommand, RunOutcome, SceneOutline, StepOutline, TaskNumber,
    TaskOutline, TaskState, WaitReason,
};
use crate::record::Record;

/// A run.
#[derive(Debug, Clone)]
pub(super) struct ReportedRun {
    pub(super) record: Record,
    /// More about it below its overview, in HTML.
    pub(super) drawing: String,
    /// From its start to the last event.
    pub(super) length: Duration,
    /// `None` if the record is cut off.
    pub(super) outcome: Option<RunOutcome>,
    pub(super) last_words: String,
    pub(super) takes: Vec<PlayedScene>,
    pub(super) tasks: Vec<PlayedTask>,
    pub(super) actions: Vec<Action>,
    pub(super) waits: Vec<Wait>,
    pub(super) latencies: BTreeMap<(String, RequestClass), Latencies>,
    /// Skipped scenes.
    pub(super) skipped: Vec<(Duration, usize, DecidedBy)>,
    pub(super) notes: Vec<(Duration, String)>,
    /// Stops that were not confirmed, since when, and why.
    pub(super) open_stops: BTreeMap<StopTarget, (Duration, String)>,
    /// Names of tasks that others started.
    pub(super) found: BTreeMap<TaskNumber, String>,
}

/// What a stop has to end.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum StopTarget {
    Task(TaskNumber),
    /// The tasks that others started on this server.
    Others(String),
}

/// A scene, played once.
#[derive(Debug, Clone)]
pub(super) struct PlayedScene {
    pub(super) scene: usize,
    pub(super) number: u32,
    pub(super) replay: bool,
    pub(super) from: Duration,
    pub(super) to: Duration,
    /// `None` if the record ends before.
    pub(super) end: Option<Ending>,
    pub(super) steps: Vec<PlayedStep>,
}

/// A step, played once.
#[derive(Debug, Clone)]
pub(super) struct PlayedStep {
    pub(super) step: usize,
    /// Its planned start: the end of the step before, or after its scene's delay.
    pub(super) planned_from: Duration,
    pub(super) from: Duration,
    pub(super) to: Duration,
    pub(super) end: Option<Ending>,
    /// The sum of its delays and its tasks' durations; `None` if it was left before its end.
    pub(super) planned: Option<Duration>,
}

/// A task, sent once.
#[derive(Debug, Clone)]
pub(super) struct PlayedTask {
    pub(super) number: TaskNumber,
    /// Its index in [`Run::takes`], and among the steps there.
    pub(super) take: usize,
    pub(super) step: usize,
    pub(super) part: usize,
    pub(super) retry_of: Option<TaskNumber>,
    /// Its start by the script's delays alone; `None` for a retry.
    pub(super) planned_from: Option<Duration>,
    pub(super) from: Duration,
    /// When its server confirmed that it has it.
    pub(super) accepted: Option<Duration>,
    /// When it was known to be over.
    pub(super) to: Option<Duration>,
    pub(super) state: TaskState,
    pub(super) text: String,
    /// From INIT to its answer.
    pub(super) latency: Option<Duration>,
    /// The periods in which its state was unknown: from, to.
    pub(super) unknown: Vec<(Duration, Duration)>,
}

/// A key or a decision, by the operator or in the operator's place.
#[derive(Debug, Clone)]
pub(super) struct Action {
    pub(super) at: Duration,
    pub(super) key: Option<String>,
    pub(super) command: Option<RunCommand>,
    pub(super) by: DecidedBy,
    /// Whether it was carried out.
    pub(super) decided: bool,
    pub(super) scene: Option<usize>,
    pub(super) step: Option<usize>,
    /// Time since the question that it answers.
    pub(super) after: Option<Duration>,
    /// Whether it deviates from the script.
    pub(super) deviation: bool,
}

/// A period in which the script did not continue.
#[derive(Debug, Clone)]
pub(super) struct Wait {
    pub(super) from: Duration,
    pub(super) to: Duration,
    pub(super) cause: WaitCause,
    pub(super) scene: Option<usize>,
    pub(super) step: Option<usize>,
    pub(super) tasks: Vec<TaskNumber>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum WaitCause {
    /// Waiting for the operator, between scenes.
    Operator,
    /// A pause by the operator.
    Pause,
    /// For a server or a decision: something failed, is silent or unknown.
    Unsettled(WaitReason),
}

/// A kind of request, for statistics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum RequestClass {
    Init,
    Status,
    /// A STATUS that the server may hold until the task ends, so its latency says nothing about the network.
    Held,
    Abort,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Latencies {
    pub(super) answered: Vec<Duration>,
    pub(super) unanswered: u64,
}

impl ReportedRun {
    pub(super) fn outline(&self) -> &Outline {
        &self.record.started.outline
    }

    pub(super) fn scene(&self, scene: usize) -> Option<&SceneOutline> {
        self.outline().scenes.get(scene)
    }

    pub(super) fn step(&self, scene: usize, step: usize) -> Option<&StepOutline> {
        self.scene(scene)?.steps.get(step)
    }

    pub(super) fn scene_name(&self, scene: usize) -> String {
        let name = self.scene(scene).map(|scene| scene.name.clone());
        name.unwrap_or_else(|| format!("scene {}", scene + 1))
    }

    pub(super) fn step_name(&self, scene: usize, step: usize) -> String {
        let name = self.step(scene, step).map(|step| step.name.clone());
        name.unwrap_or_else(|| format!("step {}", step + 1))
    }

    /// The planned step of a task, and the planned task.
    pub(super) fn plan(&self, task: &PlayedTask) -> Option<(&StepOutline, &TaskOutline)> {
        let take = self.takes.get(task.take)?;
        let step = self.step(take.scene, take.steps.get(task.step)?.step)?;
        Some((step, step.tasks.get(task.part)?))
    }

    pub(super) fn task(&self, number: TaskNumber) -> Option<&PlayedTask> {
        // A damaged record may lack some, so the number is not an index.
        self.tasks.iter().find(|task| task.number == number)
    }

    pub(super) fn tasks_of(&self, take: usize, step: usize) -> impl Iterator<Item = &PlayedTask> {
        let mine = move |task: &&PlayedTask| task.take == take && task.step == step;
        self.tasks.iter().filter(mine)
    }

    pub(super) fn deviations(&self) -> impl Iterator<Item = &Action> {
        self.actions.iter().filter(|action| action.deviation)
    }

    /// Total duration of the waits with this cause.
    pub(super) fn waited(&self, cause: impl Fn(&WaitCause) -> bool) -> Duration {
        let waits = self.waits.iter().filter(|wait| cause(&wait.cause));
        waits.map(|wait| wait.to.saturating_sub(wait.from)).sum()
    }
}

impl PlayedStep {
    pub(super) fn length(&self) -> Duration {
        self.to.saturating_sub(self.from)
    }
}

impl PlayedScene {
    pub(super) fn length(&self) -> Duration {
        self.to.saturating_sub(self.from)
    }

    /// The sum of its delay and its steps' plans; `None` if it was left before its end.
    pub(super) fn planned(&self, run: &ReportedRun) -> Option<Duration> {
        if !matches!(self.end, Some(Ending::Completed | Ending::Failures)) {
            return None;
        }
        let delay = run
            .scene(self.scene)
            .map_or(Duration::ZERO, |scene| scene.delay);
        let steps = self.steps.iter().filter_map(|step| step.planned);
        Some(steps.sum::<Duration>() + delay)
    }
}

impl PlayedTask {
    /// From its start until its end was known.
    pub(super) fn length(&self) -> Option<Duration> {
        Some(self.to?.saturating_sub(self.from))
    }

    /// Delay of its start against the plan.
    pub(super) fn late(&self) -> Option<Duration> {
        Some(self.from.saturating_sub(self.planned_from?))
    }
}
