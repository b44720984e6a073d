//! When a step is over, why it is not, and what comes then.

use ztl_core::Instant;

use super::super::event::{
    By, Command, Event, Question, SceneEnd, StepEnd, TaskNumber, TaskState, Why,
};
use super::super::model::OnFailure;
use super::steps::{Stage, Todo, Told};
use super::tasks::Live;
use super::{Phase, Player};

impl Player {
    /// All was started and answered: whether the step is over. If not, it says why.
    pub(super) fn step_over(&mut self, now: Instant) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let Some(step) = &play.step else { return false };
        let policy = self
            .script
            .step(play.scene, step.step)
            .map(|plan| plan.on_failure)
            .unwrap_or_default();
        let (asked, retries) = (step.asked, step.retries);
        let of = |is: &dyn Fn(&Live) -> bool| -> Vec<TaskNumber> {
            let tasks = step.tasks.iter().copied();
            tasks
                .filter(|number| self.tasks.get(number).is_some_and(is))
                .collect()
        };
        let open = of(&Live::is_open);
        let failed = of(&|task| !task.excused && task.is_failure());
        if !open.is_empty() {
            self.wait_or_go_on(now, &open);
            return false;
        }
        if failed.is_empty() {
            self.end_step();
            return true;
        }
        match policy {
            OnFailure::Retry(count) if retries < count && !asked => {
                self.try_again(now);
                true
            }
            OnFailure::Ask | OnFailure::Retry(_) => {
                self.wait_for_operator(now, Why::Failed, failed);
                false
            }
            // The others of this server would fare no better.
            OnFailure::Usual if !of(&|task| !task.excused && task.absent).is_empty() => {
                self.wait_for_operator(now, Why::Failed, failed);
                false
            }
            OnFailure::Usual | OnFailure::GoOn | OnFailure::Stop => {
                self.end_step();
                true
            }
        }
    }

    /// Some tasks have not ended: says so, if something is wrong with one of them.
    fn wait_or_go_on(&mut self, now: Instant, open: &[TaskNumber]) {
        let trouble = |number: &TaskNumber| {
            let task = self.tasks.get(number)?;
            let why = task.unknown.as_ref().map(|(why, _)| why.clone());
            let late = task.late && !task.aborting;
            why.or(late.then_some(Why::TooLong))
                .map(|why| (why, *number))
        };
        let mut troubles: Vec<(Why, TaskNumber)> = open.iter().filter_map(trouble).collect();
        // What cannot mend itself comes first.
        troubles.sort_by_key(|(why, _)| why.may_mend());
        match troubles.first() {
            Some((why, _)) => {
                let why = why.clone();
                let tasks = troubles.into_iter().map(|(_, number)| number).collect();
                self.wait_for_operator(now, why, tasks);
            }
            None => self.settled(),
        }
    }

    /// What the operator was told is settled.
    pub(super) fn settled(&mut self) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let (scene, Some(step)) = (play.scene, &mut play.step) else {
            return;
        };
        if step.told.take().is_some() {
            let step = step.step;
            self.question = None;
            self.events.push_back(Event::StepGoesOn { scene, step });
        }
    }

    /// The step waits; the operator decides.
    fn wait_for_operator(&mut self, now: Instant, why: Why, tasks: Vec<TaskNumber>) {
        let can_try_again = self.can_try_again();
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let (scene, Some(step)) = (play.scene, &mut play.step) else {
            return;
        };
        let told = step.told.as_ref();
        let is_told = told.is_some_and(|told| told.why == why && told.tasks == tasks);
        if is_told && told.is_some_and(|told| told.can_try_again == can_try_again) {
            return;
        }
        // These can mend themselves: an unattended run waits for that.
        let may_mend = why.may_mend();
        step.told = Some(Told {
            why: why.clone(),
            tasks: tasks.clone(),
            can_try_again,
        });
        step.asked = true;
        let step = step.step;
        if !is_told {
            self.events.push_back(Event::StepWaiting {
                scene,
                step,
                why,
                tasks,
            });
        }
        if !self.options.unattended {
            self.ask(Question::Step { scene, step });
        } else if !may_mend {
            self.stop(now, Command::Stop, By::Script);
        }
    }

    /// Whether something can be tried again in the step that waits.
    pub(super) fn can_try_again(&self) -> bool {
        let Phase::Playing(play) = &self.phase else {
            return false;
        };
        let tasks = play.step.iter().flat_map(|step| &step.tasks);
        tasks
            .into_iter()
            .any(|number| self.tasks.get(number).is_some_and(Live::is_failure))
    }

    /// Starts again what failed, of the step that is under way.
    pub(super) fn try_again(&mut self, now: Instant) {
        self.settled();
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let Some(step) = &mut play.step else { return };
        let failed = |number: &TaskNumber| self.tasks.get(number).is_some_and(Live::is_failure);
        let (again, rest): (Vec<_>, Vec<_>) = step.tasks.iter().partition(|number| failed(number));
        step.tasks = rest;
        step.retries += 1;
        for number in again {
            if let Some((.., part)) = self.tasks.get(&number).and_then(|task| task.place) {
                let todo = Todo {
                    part,
                    at: Some(now),
                    retry_of: Some(number),
                };
                step.todo.push_back(todo);
            }
        }
    }

    /// Nothing of this step is waited for any more.
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

    pub(super) fn end_step(&mut self) {
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
            // What is unknown is never started again by a word that means all that failed.
            if let (true, Some((.., part))) = (task.is_failure(), task.place) {
                failures = true;
                self.failed.push((step.step, part, *number));
            }
        }
        play.failures |= failures;
        let end = match failures {
            true => StepEnd::Failures,
            false => StepEnd::Completed,
        };
        let (pause, step) = (std::mem::take(&mut play.pause), step.step);
        let more = !play.steps.is_empty();
        play.stage = Stage::Step;
        if pause && more {
            play.stage = Stage::Paused;
        }
        self.events.push_back(Event::StepEnded { scene, step, end });
        if pause && more {
            self.events.push_back(Event::Paused { scene, step });
            self.ask(Question::Pause);
        }
    }

    /// Goes on after a pause.
    pub(super) fn resume(&mut self) {
        self.question = None;
        if let Phase::Playing(play) = &mut self.phase {
            play.stage = Stage::Step;
        }
        self.events.push_back(Event::Resumed);
    }

    /// Leaves the scene that is played, whatever is under way.
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
            let end = StepEnd::Stopped;
            self.events.push_back(Event::StepEnded {
                scene,
                step: step.step,
                end,
            });
        }
        self.end_scene(SceneEnd::Stopped);
    }

    pub(super) fn end_scene(&mut self, end: SceneEnd) {
        let Phase::Playing(play) = &self.phase else {
            return;
        };
        let (scene, take) = (play.scene, play.take);
        self.last = Some(scene);
        self.phase = Phase::Idle;
        self.events
            .push_back(Event::SceneEnded { scene, take, end });
    }
}
