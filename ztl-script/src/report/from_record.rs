//! Rebuilds a run from its events.

use std::collections::BTreeMap;
use std::time::Duration;

use super::run::{
    Action, PlayedScene, PlayedStep, PlayedTask, ReportedRun, RequestClass, StopTarget, Wait,
    WaitCause,
};
use crate::event::{
    DecidedBy, Ending, Question, RequestKind, RequestNumber, RunCommand, RunEvent, RunOutcome,
    StampedEvent, StepOutline, TaskNumber, TaskState,
};
use crate::record::Record;

/// The run that a record describes.
pub(super) fn read(record: Record) -> ReportedRun {
    let mut reader = Reader {
        run: ReportedRun {
            length: record
                .events
                .last()
                .map_or(Duration::ZERO, |event| event.at),
            record: Record {
                events: Vec::new(),
                ..record
            },
            drawing: String::new(),
            outcome: None,
            last_words: String::new(),
            takes: Vec::new(),
            tasks: Vec::new(),
            actions: Vec::new(),
            waits: Vec::new(),
            latencies: BTreeMap::new(),
            skipped: Vec::new(),
            notes: Vec::new(),
            open_stops: BTreeMap::new(),
            found: BTreeMap::new(),
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

/// Why a stop is not confirmed, until it is answered.
const NO_ANSWER: &str = "no answer in the record";

/// An open question, and since when.
type Standing = (Duration, Question);

struct Reader {
    run: ReportedRun,
    take_open: bool,
    step_open: bool,
    question: Option<Standing>,
    wait: Option<Wait>,
    requests: BTreeMap<RequestNumber, (String, RequestClass, Option<TaskNumber>)>,
}

impl Reader {
    fn handle(&mut self, StampedEvent { at, event, .. }: StampedEvent) {
        match event {
            RunEvent::Asked { question, .. } => self.ask(at, question),
            RunEvent::Key { key, command } => self.key(at, key, command),
            RunEvent::Decided {
                command,
                by,
                scene,
                step,
            } => self.decide(at, command, by, (scene, step)),
            RunEvent::SceneStarted {
                scene,
                take,
                replay,
            } => {
                self.end_take(at, None);
                self.run.takes.push(PlayedScene {
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
            RunEvent::SceneEnded { end, .. } => self.end_take(at, Some(end)),
            RunEvent::SceneSkipped { scene, by } => self.run.skipped.push((at, scene, by)),
            RunEvent::StepStarted { step, .. } => self.start_step(at, step),
            RunEvent::StepEnded { end, .. } => self.end_step(at, Some(end)),
            RunEvent::StepWaiting {
                scene,
                step,
                why,
                tasks,
            } => self.start_wait(at, WaitCause::Unsettled(why), Some((scene, step)), tasks),
            RunEvent::StepGoesOn { .. } => {
                self.end_wait(at);
                self.question = None;
            }
            RunEvent::Paused { scene, step } => {
                self.start_wait(at, WaitCause::Pause, Some((scene, step)), Vec::new());
            }
            RunEvent::Resumed => self.end_wait(at),
            RunEvent::TaskStarting {
                task,
                part,
                retry_of,
                ..
            } => self.start_task(at, task, part, retry_of),
            RunEvent::TaskState {
                task, state, text, ..
            } => self.task_state(at, task, state, text),
            RunEvent::RequestSent {
                request,
                kind,
                remote,
                task,
                hold,
                ..
            } => {
                let asked = match (kind, hold) {
                    (RequestKind::Init, _) => RequestClass::Init,
                    (RequestKind::Status, Some(_)) => RequestClass::Held,
                    (RequestKind::Status, None) => RequestClass::Status,
                    (RequestKind::Abort, _) => RequestClass::Abort,
                };
                self.requests.insert(request, (remote, asked, task));
            }
            RunEvent::Answered {
                request, latency, ..
            } => self.answer(request, latency),
            RunEvent::Unanswered { request, .. } => {
                if let Some((remote, asked, _)) = self.requests.remove(&request) {
                    self.run
                        .latencies
                        .entry((remote, asked))
                        .or_default()
                        .unanswered += 1;
                }
            }
            RunEvent::Stopping { tasks, remotes } => {
                let tasks = tasks.into_iter().map(StopTarget::Task);
                for target in tasks.chain(remotes.into_iter().map(StopTarget::Others)) {
                    self.open_stop(at, target, NO_ANSWER);
                }
            }
            RunEvent::TaskFound { task, text, .. } => {
                self.run.found.insert(task, text);
                self.open_stop(at, StopTarget::Task(task), NO_ANSWER);
            }
            RunEvent::StopAnswered {
                task,
                confirmed: false,
                text,
            } => self.open_stop(at, StopTarget::Task(task), &text),
            RunEvent::StopAnswered { task, .. } => self.confirm_stop(&StopTarget::Task(task)),
            RunEvent::TasksListed { remote, gaps } => {
                let target = StopTarget::Others(remote);
                match gaps.is_empty() {
                    true => self.confirm_stop(&target),
                    false => self.open_stop(at, target, &gaps.join("; ")),
                }
            }
            RunEvent::Note { text } => self.run.notes.push((at, text)),
            RunEvent::CueStarting { cue, part, .. } => {
                let cue = self.run.outline().cues.get(cue);
                let task = cue.and_then(|cue| Some((cue, cue.tasks.get(part)?)));
                if let Some((cue, task)) = task {
                    let text = format!("cue '{}': {}", cue.name, task.name());
                    self.run.notes.push((at, text));
                }
            }
            RunEvent::RunEnded {
                outcome,
                running,
                text,
            } => {
                // Older records say `stopped` here too.
                let open = outcome == RunOutcome::Stopped && !running.is_empty();
                self.run.outcome = Some(if open {
                    RunOutcome::NotConfirmed
                } else {
                    outcome
                });
                self.run.last_words = text;
            }
            _ => {}
        }
    }

    fn open_stop(&mut self, at: Duration, target: StopTarget, why: &str) {
        self.run.open_stops.insert(target, (at, why.to_owned()));
    }

    fn confirm_stop(&mut self, target: &StopTarget) {
        self.run.open_stops.remove(target);
    }

    fn ask(&mut self, at: Duration, question: Question) {
        self.question = Some((at, question));
        let scene = match question {
            Question::Scene { scene } => Some(scene),
            Question::End => None,
            // These waits have their own events.
            Question::Step { .. } | Question::Pause => return,
        };
        self.start_wait(at, WaitCause::Operator, None, Vec::new());
        if let Some(wait) = &mut self.wait {
            wait.scene = scene;
        }
    }

    fn key(&mut self, at: Duration, key: String, command: Option<RunCommand>) {
        self.run.actions.push(Action {
            at,
            key: Some(key),
            command,
            by: DecidedBy::Operator,
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
        command: RunCommand,
        by: DecidedBy,
        (scene, step): (Option<usize>, Option<usize>),
    ) {
        let question = self.question.take();
        let at_the_end = matches!(question, Some((_, Question::End)));
        let deviation = matches!(by, DecidedBy::Operator | DecidedBy::Signal)
            && match command {
                RunCommand::Start | RunCommand::Resume => false,
                RunCommand::Leave => !at_the_end,
                _ => true,
            };
        let asked_for = self.run.actions.last_mut().filter(|action| {
            !action.decided && by == DecidedBy::Operator && action.command == Some(command)
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
        // A pause ordered while a step waits does not end that wait.
        if command != RunCommand::Pause {
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
            take.steps.push(PlayedStep {
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

    fn end_step(&mut self, at: Duration, end: Option<Ending>) {
        if !std::mem::take(&mut self.step_open) {
            return;
        }
        if matches!(&self.wait, Some(wait) if matches!(wait.cause, WaitCause::Unsettled(_))) {
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

    fn end_take(&mut self, at: Duration, end: Option<Ending>) {
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
        cause: WaitCause,
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
        self.run.tasks.push(PlayedTask {
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
        if state.is_over() {
            self.confirm_stop(&StopTarget::Task(number));
        }
        let mine = |task: &&mut PlayedTask| task.number == number;
        // Mostly the newest.
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
        if asked == RequestClass::Init
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

    /// At the end of the record, ends everything open and computes the plans.
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
            let whole = matches!(step.end, Some(Ending::Completed | Ending::Failures));
            step.planned = whole.then_some(planned);
        }
    }
}

/// The planned start of a task by the script's delays, from the start of its step.
pub(super) fn offset(step: &StepOutline, part: usize) -> Option<Duration> {
    let own = step.tasks.get(part)?.delay;
    let before = if step.parallel {
        Duration::ZERO
    } else {
        step.tasks.iter().take(part).map(|task| task.delay).sum()
    };
    Some(step.delay + before + own)
}

/// The planned duration of a step: its delays and its tasks' own durations. Of a retried task the last try
/// counts.
fn planned(
    run: &ReportedRun,
    take: usize,
    nth: usize,
    scene: usize,
    step: &PlayedStep,
) -> Duration {
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
