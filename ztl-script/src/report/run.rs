//! What happened in a run: scenes, steps, tasks, what the operator
//! did, waits, and how long servers took to answer.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::event::{
    DecidedBy, Ending, Outline, RunCommand, RunOutcome, SceneOutline, StepOutline, TaskNumber,
    TaskOutline, TaskState, WaitReason,
};
use crate::record::Record;

/// A run.
#[derive(Debug, Clone)]
pub(super) struct Run {
    pub(super) record: Record,
    /// From its start to the last event.
    pub(super) length: Duration,
    /// `None` when the record is cut off.
    pub(super) outcome: Option<RunOutcome>,
    pub(super) last_words: String,
    pub(super) takes: Vec<Take>,
    pub(super) tasks: Vec<Task>,
    pub(super) actions: Vec<Action>,
    pub(super) waits: Vec<Wait>,
    pub(super) latencies: BTreeMap<(String, Asked), Latencies>,
    /// Scenes passed over.
    pub(super) skipped: Vec<(Duration, usize, DecidedBy)>,
    pub(super) notes: Vec<(Duration, String)>,
}

/// A scene, played once.
#[derive(Debug, Clone)]
pub(super) struct Take {
    pub(super) scene: usize,
    pub(super) number: u32,
    pub(super) replay: bool,
    pub(super) from: Duration,
    pub(super) to: Duration,
    /// `None` when the record ends before it.
    pub(super) end: Option<Ending>,
    pub(super) steps: Vec<Step>,
}

/// A step, played once.
#[derive(Debug, Clone)]
pub(super) struct Step {
    pub(super) step: usize,
    /// When the script would have it start: at the end of the one before, or after its scene's delay.
    pub(super) planned_from: Duration,
    pub(super) from: Duration,
    pub(super) to: Duration,
    pub(super) end: Option<Ending>,
    /// What its delays and its tasks' own times add up to; `None` when it was left before its end, and
    /// nobody knows what they would have been.
    pub(super) planned: Option<Duration>,
}

/// A task, sent once.
#[derive(Debug, Clone)]
pub(super) struct Task {
    pub(super) number: TaskNumber,
    /// Its place among [`Run::takes`], and among the steps there.
    pub(super) take: usize,
    pub(super) step: usize,
    pub(super) part: usize,
    pub(super) retry_of: Option<TaskNumber>,
    /// When the script's delays alone would have it start; nothing plans a retry.
    pub(super) planned_from: Option<Duration>,
    pub(super) from: Duration,
    /// When its server said that it has it.
    pub(super) accepted: Option<Duration>,
    /// When it was known to be over.
    pub(super) to: Option<Duration>,
    pub(super) state: TaskState,
    pub(super) text: String,
    /// From INIT to its answer.
    pub(super) latency: Option<Duration>,
    /// The times at which nobody knew how it was: from, to.
    pub(super) unknown: Vec<(Duration, Duration)>,
}

/// What the operator did, or somebody in the operator's place.
#[derive(Debug, Clone)]
pub(super) struct Action {
    pub(super) at: Duration,
    pub(super) key: Option<String>,
    pub(super) command: Option<RunCommand>,
    pub(super) by: DecidedBy,
    /// It was done, not only asked for.
    pub(super) decided: bool,
    pub(super) scene: Option<usize>,
    pub(super) step: Option<usize>,
    /// Since the question was asked that it answers.
    pub(super) after: Option<Duration>,
    /// The script would have it otherwise.
    pub(super) deviation: bool,
}

/// A time in which the script did not go on.
#[derive(Debug, Clone)]
pub(super) struct Wait {
    pub(super) from: Duration,
    pub(super) to: Duration,
    pub(super) cause: Cause,
    pub(super) scene: Option<usize>,
    pub(super) step: Option<usize>,
    pub(super) tasks: Vec<TaskNumber>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Cause {
    /// For the operator, between scenes.
    Operator,
    /// The operator wanted a pause.
    Pause,
    Trouble(WaitReason),
}

/// What was asked of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Asked {
    Init,
    Status,
    /// A STATUS that the server may hold until the task ends: its time tells nothing of the line.
    Held,
    Abort,
}

#[derive(Debug, Clone, Default)]
pub(super) struct Latencies {
    pub(super) answered: Vec<Duration>,
    pub(super) unanswered: u64,
}

impl Run {
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

    /// The step that a task belongs to, and what the script says of the task.
    pub(super) fn plan(&self, task: &Task) -> Option<(&StepOutline, &TaskOutline)> {
        let take = self.takes.get(task.take)?;
        let step = self.step(take.scene, take.steps.get(task.step)?.step)?;
        Some((step, step.tasks.get(task.part)?))
    }

    pub(super) fn task(&self, number: TaskNumber) -> Option<&Task> {
        // They are numbered from 1 in the order of starting; a damaged record may lack some.
        self.tasks.iter().find(|task| task.number == number)
    }

    pub(super) fn tasks_of(&self, take: usize, step: usize) -> impl Iterator<Item = &Task> {
        let mine = move |task: &&Task| task.take == take && task.step == step;
        self.tasks.iter().filter(mine)
    }

    pub(super) fn deviations(&self) -> impl Iterator<Item = &Action> {
        self.actions.iter().filter(|action| action.deviation)
    }

    /// How long the script stood still for a cause.
    pub(super) fn waited(&self, cause: impl Fn(&Cause) -> bool) -> Duration {
        let waits = self.waits.iter().filter(|wait| cause(&wait.cause));
        waits.map(|wait| wait.to.saturating_sub(wait.from)).sum()
    }
}

impl Step {
    pub(super) fn length(&self) -> Duration {
        self.to.saturating_sub(self.from)
    }
}

impl Take {
    pub(super) fn length(&self) -> Duration {
        self.to.saturating_sub(self.from)
    }

    /// What its delay and its steps' plans add up to; `None` when it was left before its end.
    pub(super) fn planned(&self, run: &Run) -> Option<Duration> {
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

impl Task {
    /// How long it took, from its start until it was known to be over.
    pub(super) fn length(&self) -> Option<Duration> {
        Some(self.to?.saturating_sub(self.from))
    }

    /// How much later than planned it started.
    pub(super) fn late(&self) -> Option<Duration> {
        Some(self.from.saturating_sub(self.planned_from?))
    }
}
