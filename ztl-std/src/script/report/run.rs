//! What happened in a run, put together from its events: scenes, steps, tasks, what the operator
//! did, waits, and how long servers took to answer.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::script::event::{
    By, Command, Event, Kind, Outcome, Outline, Question, RequestNumber, SceneEnd, SceneOutline,
    Stamped, StepEnd, StepOutline, TaskNumber, TaskOutline, TaskState, Why,
};
use crate::script::record::Record;

/// A run.
#[derive(Debug, Clone)]
pub(super) struct Run {
    pub(super) record: Record,
    /// From its start to the last event.
    pub(super) length: Duration,
    /// `None` when the record is cut off.
    pub(super) outcome: Option<Outcome>,
    pub(super) last_words: String,
    pub(super) takes: Vec<Take>,
    pub(super) tasks: Vec<Task>,
    pub(super) actions: Vec<Action>,
    pub(super) waits: Vec<Wait>,
    pub(super) latencies: BTreeMap<(String, Asked), Latencies>,
    /// Scenes passed over.
    pub(super) skipped: Vec<(Duration, usize, By)>,
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
    pub(super) end: Option<SceneEnd>,
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
    pub(super) end: Option<StepEnd>,
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
    pub(super) command: Option<Command>,
    pub(super) by: By,
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
    Trouble(Why),
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
    pub(super) fn new(record: Record) -> Self {
        let mut reader = Reader {
            run: Self {
                length: record
                    .events
                    .last()
                    .map_or(Duration::ZERO, |event| event.at),
                record: Record {
                    events: Vec::new(),
                    ..record
                },
                outcome: None,
                last_words: String::new(),
                takes: Vec::new(),
                tasks: Vec::new(),
                actions: Vec::new(),
                waits: Vec::new(),
                latencies: BTreeMap::new(),
                skipped: Vec::new(),
                notes: Vec::new(),
            },
            take_open: false,
            step_open: false,
            question: None,
            wait: None,
            requests: BTreeMap::new(),
        };
        let first = record.events.first().cloned();
        for event in record.events {
            reader.handle(event);
        }
        reader.finish();
        reader.run.record.events.extend(first);
        reader.run
    }

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
        if !matches!(self.end, Some(SceneEnd::Completed | SceneEnd::Failures)) {
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

/// A question that stands: since when, what about.
type Standing = (Duration, Question);

struct Reader {
    run: Run,
    take_open: bool,
    step_open: bool,
    question: Option<Standing>,
    wait: Option<Wait>,
    requests: BTreeMap<RequestNumber, (String, Asked, Option<TaskNumber>)>,
}

impl Reader {
    fn handle(&mut self, Stamped { at, event, .. }: Stamped) {
        match event {
            Event::Asked { question, .. } => self.ask(at, question),
            Event::Key { key, command } => self.key(at, key, command),
            Event::Decided {
                command,
                by,
                scene,
                step,
            } => self.decide(at, command, by, (scene, step)),
            Event::SceneStarted {
                scene,
                take,
                replay,
            } => {
                self.end_take(at, None);
                self.run.takes.push(Take {
                    scene,
                    number: take,
                    replay,
                    from: at,
                    to: at,
                    end: None,
                    steps: Vec::new(),
                });
                self.take_open = true;
            }
            Event::SceneEnded { end, .. } => self.end_take(at, Some(end)),
            Event::SceneSkipped { scene, by } => self.run.skipped.push((at, scene, by)),
            Event::StepStarted { step, .. } => self.start_step(at, step),
            Event::StepEnded { end, .. } => self.end_step(at, Some(end)),
            Event::StepWaiting {
                scene,
                step,
                why,
                tasks,
            } => self.start_wait(at, Cause::Trouble(why), Some((scene, step)), tasks),
            Event::StepGoesOn { .. } => {
                self.end_wait(at);
                self.question = None;
            }
            Event::Paused { scene, step } => {
                self.start_wait(at, Cause::Pause, Some((scene, step)), Vec::new());
            }
            Event::Resumed => self.end_wait(at),
            Event::TaskStarting {
                task,
                part,
                retry_of,
                ..
            } => self.start_task(at, task, part, retry_of),
            Event::TaskState {
                task, state, text, ..
            } => self.task_state(at, task, state, text),
            Event::RequestSent {
                request,
                kind,
                remote,
                task,
                text,
            } => {
                let asked = match kind {
                    Kind::Init => Asked::Init,
                    Kind::Status if text.starts_with("wait ") => Asked::Held,
                    Kind::Status => Asked::Status,
                    Kind::Abort => Asked::Abort,
                };
                self.requests.insert(request, (remote, asked, task));
            }
            Event::Answered {
                request, latency, ..
            } => self.answer(request, latency),
            Event::Unanswered { request, .. } => {
                if let Some((remote, asked, _)) = self.requests.remove(&request) {
                    self.run
                        .latencies
                        .entry((remote, asked))
                        .or_default()
                        .unanswered += 1;
                }
            }
            Event::Note { text } => self.run.notes.push((at, text)),
            Event::RunEnded { outcome, text, .. } => {
                self.run.outcome = Some(outcome);
                self.run.last_words = text;
            }
            _ => {}
        }
    }

    fn ask(&mut self, at: Duration, question: Question) {
        self.question = Some((at, question));
        let scene = match question {
            Question::Scene { scene } => Some(scene),
            Question::End => None,
            // Their waits have events of their own.
            Question::Step { .. } | Question::Pause => return,
        };
        self.start_wait(at, Cause::Operator, None, Vec::new());
        if let Some(wait) = &mut self.wait {
            wait.scene = scene;
        }
    }

    fn key(&mut self, at: Duration, key: String, command: Option<Command>) {
        self.run.actions.push(Action {
            at,
            key: Some(key),
            command,
            by: By::Operator,
            decided: false,
            scene: None,
            step: None,
            after: self.question.map(|(asked, _)| at.saturating_sub(asked)),
            deviation: false,
        });
    }

    fn decide(
        &mut self,
        at: Duration,
        command: Command,
        by: By,
        (scene, step): (Option<usize>, Option<usize>),
    ) {
        let question = self.question.take();
        let at_the_end = matches!(question, Some((_, Question::End)));
        let deviation = matches!(by, By::Operator | By::Signal)
            && match command {
                Command::Start | Command::Resume => false,
                Command::Leave => !at_the_end,
                _ => true,
            };
        let asked_for = self.run.actions.last_mut().filter(|action| {
            !action.decided && by == By::Operator && action.command == Some(command)
        });
        if let Some(action) = asked_for {
            action.decided = true;
            action.scene = scene;
            action.step = step;
            action.deviation = deviation;
        } else {
            self.run.actions.push(Action {
                at,
                key: None,
                command: Some(command),
                by,
                decided: true,
                scene,
                step,
                after: question.map(|(asked, _)| at.saturating_sub(asked)),
                deviation,
            });
        }
        // A pause that is ordered while a step waits changes nothing about that wait.
        if command != Command::Pause {
            self.end_wait(at);
        }
    }

    fn start_step(&mut self, at: Duration, step: usize) {
        self.end_step(at, None);
        let Some(take) = self.run.takes.last() else {
            return;
        };
        let planned_from = match take.steps.last() {
            Some(before) => before.to,
            None => {
                take.from
                    + self
                        .run
                        .scene(take.scene)
                        .map_or(Duration::ZERO, |s| s.delay)
            }
        };
        if let Some(take) = self.run.takes.last_mut() {
            take.steps.push(Step {
                step,
                planned_from,
                from: at,
                to: at,
                end: None,
                planned: None,
            });
            self.step_open = true;
        }
    }

    fn end_step(&mut self, at: Duration, end: Option<StepEnd>) {
        if !std::mem::take(&mut self.step_open) {
            return;
        }
        if matches!(&self.wait, Some(wait) if matches!(wait.cause, Cause::Trouble(_))) {
            self.end_wait(at);
        }
        if let Some(step) = self
            .run
            .takes
            .last_mut()
            .and_then(|take| take.steps.last_mut())
        {
            step.to = at;
            step.end = end;
        }
    }

    fn end_take(&mut self, at: Duration, end: Option<SceneEnd>) {
        self.end_step(at, None);
        if std::mem::take(&mut self.take_open)
            && let Some(take) = self.run.takes.last_mut()
        {
            take.to = at;
            take.end = end;
        }
    }

    fn start_wait(
        &mut self,
        at: Duration,
        cause: Cause,
        place: Option<(usize, usize)>,
        tasks: Vec<TaskNumber>,
    ) {
        self.end_wait(at);
        self.wait = Some(Wait {
            from: at,
            to: at,
            cause,
            scene: place.map(|(scene, _)| scene),
            step: place.map(|(_, step)| step),
            tasks,
        });
    }

    fn end_wait(&mut self, at: Duration) {
        if let Some(mut wait) = self.wait.take() {
            wait.to = at;
            self.run.waits.push(wait);
        }
    }

    fn start_task(
        &mut self,
        at: Duration,
        number: TaskNumber,
        part: usize,
        retry_of: Option<TaskNumber>,
    ) {
        let run = &self.run;
        let (take, step) = match run.takes.last() {
            Some(last) => (run.takes.len() - 1, last.steps.len().saturating_sub(1)),
            None => return,
        };
        let planned_from = run.takes.last().and_then(|take| {
            let played = take.steps.last()?;
            let offset = offset(run.step(take.scene, played.step)?, part)?;
            retry_of.is_none().then_some(played.from + offset)
        });
        self.run.tasks.push(Task {
            number,
            take,
            step,
            part,
            retry_of,
            planned_from,
            from: at,
            accepted: None,
            to: None,
            state: TaskState::Asked,
            text: String::new(),
            latency: None,
            unknown: Vec::new(),
        });
    }

    fn task_state(&mut self, at: Duration, number: TaskNumber, state: TaskState, text: String) {
        let mine = |task: &&mut Task| task.number == number;
        // The newest are asked about most.
        let Some(task) = self.run.tasks.iter_mut().rev().find(mine) else {
            return;
        };
        match (task.state, state) {
            (TaskState::Unknown, TaskState::Unknown) => {}
            (TaskState::Unknown, _) => {
                if let Some((_, to)) = task.unknown.last_mut() {
                    *to = at;
                }
            }
            (_, TaskState::Unknown) => task.unknown.push((at, at)),
            _ => {}
        }
        let has_it = !matches!(
            state,
            TaskState::Asked | TaskState::NotStarted | TaskState::Refused | TaskState::Unknown
        );
        if has_it && task.accepted.is_none() {
            task.accepted = Some(at);
        }
        if state.is_over() && task.to.is_none() {
            task.to = Some(at);
        }
        task.state = state;
        task.text = text;
    }

    fn answer(&mut self, request: RequestNumber, latency: Duration) {
        let Some((remote, asked, task)) = self.requests.remove(&request) else {
            return;
        };
        self.run
            .latencies
            .entry((remote, asked))
            .or_default()
            .answered
            .push(latency);
        if asked == Asked::Init
            && let Some(number) = task
            && let Some(task) = self
                .run
                .tasks
                .iter_mut()
                .rev()
                .find(|task| task.number == number)
        {
            task.latency = Some(latency);
        }
    }

    /// The record ends: what is open ends with it, and what was planned can be told.
    fn finish(&mut self) {
        let end = self.run.length;
        self.end_wait(end);
        self.end_take(end, None);
        for task in &mut self.run.tasks {
            if task.state == TaskState::Unknown
                && let Some((_, to)) = task.unknown.last_mut()
            {
                *to = end;
            }
        }
        let mut plans = Vec::new();
        for (at, take) in self.run.takes.iter().enumerate() {
            for (nth, step) in take.steps.iter().enumerate() {
                plans.push(planned(&self.run, at, nth, take.scene, step));
            }
        }
        let steps = self.run.takes.iter_mut().flat_map(|take| &mut take.steps);
        for (step, planned) in steps.zip(plans) {
            let whole = matches!(step.end, Some(StepEnd::Completed | StepEnd::Failures));
            step.planned = whole.then_some(planned);
        }
    }
}

/// When the script's delays put a task, counted from the start of its step.
pub(super) fn offset(step: &StepOutline, part: usize) -> Option<Duration> {
    let own = step.tasks.get(part)?.delay;
    let before = if step.parallel {
        Duration::ZERO
    } else {
        step.tasks.iter().take(part).map(|task| task.delay).sum()
    };
    Some(step.delay + before + own)
}

/// What the delays of a step and its tasks' own times add up to. A task that was tried again
/// counts as it was at last.
fn planned(run: &Run, take: usize, nth: usize, scene: usize, step: &Step) -> Duration {
    let Some(outline) = run.step(scene, step.step) else {
        return Duration::ZERO;
    };
    let parts = outline.tasks.iter().enumerate().map(|(part, plan)| {
        let offset = offset(outline, part).unwrap_or_default();
        let last = run
            .tasks_of(take, nth)
            .filter(|task| task.part == part)
            .last();
        let own = last.and_then(|task| Some(task.to?.saturating_sub(task.accepted?)));
        let awaited = outline.wait && plan.wait;
        offset + own.filter(|_| awaited).unwrap_or_default()
    });
    parts.fold(outline.delay, Duration::max)
}
