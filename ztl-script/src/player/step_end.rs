//! When a step is over, why it is not, and what happens next.

use ztl_core::Instant;

use super::state::{Phase, Player, RunTask, Stage, Todo, ToldWait};
use crate::event::{
    DecidedBy, Ending, Question, RunCommand, RunEvent, TaskNumber, TaskState, WaitReason,
};
use crate::model::OnFailure;

impl Player {
    /// Everything was started and answered: returns whether the step is over or retries; otherwise says why
    /// it waits.
    pub(super) fn step_over(&mut self, now: Instant) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let Some(step) = &play.step else { return false };
        let plan = self.script.step(play.scene, step.step);
        let policy = plan.map(|plan| plan.on_failure).unwrap_or_default();
        let may_retry = |most| step.retries < most && !step.asked;
        let which = |is: fn(&RunTask) -> bool| -> Vec<TaskNumber> {
            let is = |number: &TaskNumber| self.tasks.get(number).is_some_and(is);
            step.tasks.iter().copied().filter(is).collect()
        };
        let open = which(RunTask::is_open);
        let failed = which(|task| !task.excused && task.is_failure());
        if !open.is_empty() {
            self.wait_or_go_on(now, &open);
            return false;
        }
        let waits = match policy {
            _ if failed.is_empty() => false,
            OnFailure::Retry(most) if may_retry(most) => {
                self.retry(now);
                return true;
            }
            OnFailure::Ask | OnFailure::Retry(_) => true,
            // The other tasks of an absent server would fail too.
            OnFailure::Usual => !which(|task| !task.excused && task.absent).is_empty(),
            OnFailure::GoOn | OnFailure::Stop => false,
        };
        match waits {
            true => self.wait_for_operator(now, WaitReason::Failed, failed),
            false => self.end_step(),
        }
        !waits
    }

    /// Some tasks have not ended: says so if one of them is unknown or late.
    fn wait_or_go_on(&mut self, now: Instant, open: &[TaskNumber]) {
        let undecided = |number: &TaskNumber| {
            let task = self.tasks.get(number)?;
            let why = task.unknown.as_ref().map(|(why, _)| why.clone());
            let late = task.late && !task.aborting;
            let why = why.or(late.then_some(WaitReason::TooLong))?;
            Some((why, *number))
        };
        let mut waits: Vec<(WaitReason, TaskNumber)> = open.iter().filter_map(undecided).collect();
        // What needs a decision comes first.
        waits.sort_by_key(|(why, _)| why.may_mend());
        match waits.first() {
            Some((why, _)) => {
                let why = why.clone();
                let tasks = waits.into_iter().map(|(_, number)| number).collect();
                self.wait_for_operator(now, why, tasks);
            }
            None => self.settled(),
        }
    }

    /// The reason to wait that the operator saw no longer applies.
    fn settled(&mut self) {
        let Some((scene, step)) = self.step_mut() else {
            return;
        };
        if step.told.take().is_some() {
            let step = step.step;
            self.question = None;
            self.emit(RunEvent::StepGoesOn { scene, step });
        }
    }

    /// The step waits; the operator decides.
    fn wait_for_operator(&mut self, now: Instant, why: WaitReason, tasks: Vec<TaskNumber>) {
        let can_retry = self.can_retry();
        let unattended = self.options.unattended;
        let Some((scene, step)) = self.step_mut() else {
            return;
        };
        let told = step.told.as_ref();
        let is_told = told.is_some_and(|told| told.why == why && told.tasks == tasks);
        if is_told && told.is_some_and(|told| told.can_retry == can_retry) {
            return;
        }
        let may_mend = why.may_mend();
        step.told = Some(ToldWait {
            why: why.clone(),
            tasks: tasks.clone(),
            can_retry,
        });
        step.asked = true;
        let step = step.step;
        if !is_told {
            self.emit(RunEvent::StepWaiting {
                scene,
                step,
                why,
                tasks,
            });
        }
        if !unattended {
            self.ask(Question::Step { scene, step });
        } else if !may_mend {
            self.obey(now, RunCommand::Stop, DecidedBy::Script);
        }
    }

    /// Whether something in the waiting step can be retried.
    pub(super) fn can_retry(&self) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let mut tasks = play.step.iter().flat_map(|step| &step.tasks);
        tasks.any(|number| self.tasks.get(number).is_some_and(RunTask::is_failure))
    }

    /// Starts the failed tasks of the current step again.
    pub(super) fn retry(&mut self, now: Instant) {
        self.settled();
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let Some(step) = &mut play.step else { return };
        step.retries += 1;
        step.tasks.retain(|number| {
            let task = self.tasks.get(number).filter(|task| task.is_failure());
            let Some((.., part)) = task.and_then(|task| task.place) else {
                return true;
            };
            step.todo.push_back(Todo {
                part,
                at: Some(now),
                retry_of: Some(*number),
            });
            false
        });
    }

    /// The current step waits for nothing any more.
    pub(super) fn excuse(&mut self) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let Some(step) = &mut play.step else { return };
        step.told = None;
        for number in &step.tasks {
            if let Some(task) = self.tasks.get_mut(number) {
                task.excused = true;
                if task.state != TaskState::Completed {
                    play.failures = true;
                    self.unresolved.insert(*number);
                }
            }
        }
        self.question = None;
    }

    fn end_step(&mut self) {
        self.settled();
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let (scene, Some(step)) = (play.scene, play.step.take()) else {
            return;
        };
        let mut failures = false;
        for number in &step.tasks {
            let Some(task) = self.tasks.get(number) else {
                continue;
            };
            let unknown = task.state == TaskState::Unknown && task.id.is_none();
            failures |= unknown || (task.awaited && task.state != TaskState::Completed);
            // A retry of everything that failed never includes what is unknown.
            if let (true, Some((.., part))) = (task.is_failure(), task.place) {
                failures = true;
                self.failed.push((step.step, part, *number));
            }
        }
        play.failures |= failures;
        let end = match failures {
            true => Ending::Failures,
            false => Ending::Completed,
        };
        let step = step.step;
        let pauses = std::mem::take(&mut play.pause) && !play.steps.is_empty();
        play.stage = match pauses {
            true => Stage::Paused,
            false => Stage::Step,
        };
        self.emit(RunEvent::StepEnded { scene, step, end });
        if pauses {
            self.emit(RunEvent::Paused { scene, step });
            self.ask(Question::Pause);
        }
    }

    /// Continues after a pause.
    pub(super) fn resume(&mut self) {
        self.question = None;
        if let Some(play) = self.play_mut() {
            play.stage = Stage::Step;
        }
        self.emit(RunEvent::Resumed);
    }

    /// Leaves the current scene, even while tasks are running.
    pub(super) fn leave_play(&mut self) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let scene = play.scene;
        if let Some(step) = play.step.take() {
            for number in &step.tasks {
                if let Some(task) = self.tasks.get_mut(number) {
                    task.excused = true;
                }
            }
            let (step, end) = (step.step, Ending::Stopped);
            self.emit(RunEvent::StepEnded { scene, step, end });
        }
        self.end_scene(Ending::Stopped);
    }

    pub(super) fn end_scene(&mut self, end: Ending) {
        let Phase::Playing(play) = &self.phase else {
            return;
        };
        let (scene, take) = (play.scene, play.take);
        self.last = Some(scene);
        self.phase = Phase::Idle;
        self.emit(RunEvent::SceneEnded { scene, take, end });
    }
}
