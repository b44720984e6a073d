//! From scene to scene and from step to step.

use std::collections::VecDeque;

use ztl_core::Instant;

use super::super::event::{By, Command, Event, Question, SceneEnd, TaskNumber, TaskState, Why};
use super::super::model::OnFailure;
use super::tasks::Live;
use super::{Ask, Phase, Player};

/// A scene that is played.
#[derive(Debug)]
pub(super) struct Play {
    pub(super) scene: usize,
    pub(super) take: u32,
    /// Steps to come, and which parts of them: all, or those that are tried again.
    pub(super) steps: VecDeque<(usize, Option<Vec<Todo>>)>,
    /// The scene that was shown before, or beyond the last the end: that is shown when this is stopped.
    pub(super) before: usize,
    /// What is shown when it is over.
    pub(super) then: usize,
    pub(super) stage: Stage,
    /// The step that is under way, or was last.
    pub(super) step: Option<StepPlay>,
    pub(super) failures: bool,
    /// After this step nothing more is started.
    pub(super) pause: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stage {
    /// Until then nothing is done.
    Delay(Instant),
    Step,
    Paused,
}

/// A step that is played.
#[derive(Debug)]
pub(super) struct StepPlay {
    pub(super) step: usize,
    /// What is to be started.
    pub(super) todo: VecDeque<Todo>,
    /// What was started and is not tried again.
    pub(super) tasks: Vec<TaskNumber>,
    /// What the operator was told of why it waits.
    pub(super) told: Option<Told>,
    /// The operator was asked about it: nothing of it is tried again without a decision.
    pub(super) asked: bool,
    pub(super) retries: u32,
    pub(super) begun: bool,
}

/// Why a step waits, as the operator was told.
#[derive(Debug)]
pub(super) struct Told {
    pub(super) why: Why,
    pub(super) tasks: Vec<TaskNumber>,
    /// Something could be tried again.
    pub(super) can_try_again: bool,
}

/// A part of a step that is to be started.
#[derive(Debug, Clone, Copy)]
pub(super) struct Todo {
    pub(super) part: usize,
    pub(super) at: Option<Instant>,
    pub(super) retry_of: Option<TaskNumber>,
}

impl Play {
    /// When it goes on by itself.
    pub(super) fn wake(&self) -> Option<Instant> {
        match self.stage {
            Stage::Delay(until) => Some(until),
            Stage::Paused => None,
            Stage::Step => {
                let todo = self.step.as_ref()?.todo.iter();
                todo.filter_map(|todo| todo.at).min()
            }
        }
    }

    pub(super) const fn is_paused(&self) -> bool {
        matches!(self.stage, Stage::Paused)
    }
}

impl StepPlay {
    pub(super) fn all_started(&self) -> bool {
        self.todo.is_empty()
    }
}

impl Player {
    /// Plays a scene, with the scenes that are shown before and after it.
    pub(super) fn play(&mut self, now: Instant, scene: usize, shown: (usize, usize), replay: bool) {
        let from = match self.options.from {
            Some((of, step)) if of == scene && !self.takes.contains_key(&scene) => step,
            _ => 0,
        };
        for step in 0..from {
            self.events.push_back(Event::StepSkipped {
                scene,
                step,
                by: By::Options,
            });
        }
        let steps = self
            .script
            .scenes
            .get(scene)
            .map_or(0, |scene| scene.steps.len());
        let steps = (from..steps).map(|step| (step, None)).collect();
        let delay = self
            .script
            .scenes
            .get(scene)
            .map(|scene| scene.delay)
            .unwrap_or_default();
        self.begin_play(now + delay, scene, shown, replay, steps);
    }

    /// Tries again what failed in the last scene.
    pub(super) fn play_failed(&mut self, now: Instant, scene: usize, shown: usize) {
        let mut steps: VecDeque<(usize, Option<Vec<Todo>>)> = VecDeque::new();
        for (step, part, number) in std::mem::take(&mut self.failed) {
            let todo = Todo {
                part,
                at: None,
                retry_of: Some(number),
            };
            match steps.back_mut() {
                Some((last, Some(parts))) if *last == step => parts.push(todo),
                _ => steps.push_back((step, Some(vec![todo]))),
            }
        }
        self.begin_play(now, scene, (shown, shown), true, steps);
    }

    fn begin_play(
        &mut self,
        start: Instant,
        scene: usize,
        (before, then): (usize, usize),
        replay: bool,
        steps: VecDeque<(usize, Option<Vec<Todo>>)>,
    ) {
        let take = self.takes.entry(scene).or_insert(0);
        *take += 1;
        let take = *take;
        self.failed.clear();
        self.question = None;
        self.events.push_back(Event::SceneStarted {
            scene,
            take,
            replay,
        });
        self.phase = Phase::Playing(Box::new(Play {
            scene,
            take,
            steps,
            before,
            then,
            stage: Stage::Delay(start),
            step: None,
            failures: false,
            pause: false,
        }));
    }

    /// Does whatever can be done now.
    pub(super) fn advance(&mut self, now: Instant) {
        // Each turn starts something or ends a step, of which there are not endlessly many.
        while self.turn(now) {}
        self.settle();
    }

    fn turn(&mut self, now: Instant) -> bool {
        let Phase::Playing(play) = &mut self.phase else {
            return self.answer_oneself(now);
        };
        match play.stage {
            Stage::Paused => false,
            Stage::Delay(until) if now < until => false,
            Stage::Delay(_) => {
                play.stage = Stage::Step;
                match play.step.as_mut().filter(|step| !step.begun) {
                    Some(step) => {
                        step.begun = true;
                        let together = self
                            .script
                            .step(play.scene, step.step)
                            .is_some_and(|step| step.parallel);
                        if together {
                            self.set_due(now);
                        }
                    }
                    None => self.next_step(now),
                }
                true
            }
            Stage::Step => self.step_turn(now),
        }
    }

    /// Nobody is asked: every scene is played, and at the end it ends.
    fn answer_oneself(&mut self, now: Instant) -> bool {
        let command = match (&self.phase, self.question) {
            (Phase::Idle, Some(Question::Scene { .. })) => Command::Start,
            (Phase::Idle, Some(Question::End)) => Command::Leave,
            _ => return false,
        };
        if self.options.unattended {
            self.obey(now, command, By::Options);
        }
        self.options.unattended
    }

    /// The parts of a step whose tasks start together have their times now.
    fn set_due(&mut self, now: Instant) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let Some(step) = &mut play.step else { return };
        let plan = self.script.step(play.scene, step.step);
        for todo in &mut step.todo {
            let task = plan.and_then(|plan| plan.tasks.get(todo.part));
            todo.at = Some(now + task.map(|task| task.delay).unwrap_or_default());
        }
    }

    /// Begins the next step, or ends the scene.
    fn next_step(&mut self, now: Instant) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let Some((index, parts)) = play.steps.pop_front() else {
            let end = match play.failures {
                true => SceneEnd::Failures,
                false => SceneEnd::Completed,
            };
            let then = play.then;
            self.end_scene(end);
            return self.show(then);
        };
        let scene = play.scene;
        let Some(plan) = self.script.step(scene, index) else {
            return;
        };
        let all = (0..plan.tasks.len()).map(|part| Todo {
            part,
            at: None,
            retry_of: None,
        });
        let again = parts.is_some();
        play.step = Some(StepPlay {
            step: index,
            todo: parts.map_or_else(|| all.collect(), VecDeque::from),
            tasks: Vec::new(),
            told: None,
            asked: false,
            retries: 0,
            begun: false,
        });
        let delay = if again {
            std::time::Duration::ZERO
        } else {
            plan.delay
        };
        play.stage = Stage::Delay(now + delay);
        self.events
            .push_back(Event::StepStarted { scene, step: index });
    }

    /// Starts what is due, then sees whether the step is over.
    fn step_turn(&mut self, now: Instant) -> bool {
        let Phase::Playing(play) = &mut self.phase else {
            return false;
        };
        let Some(step) = &mut play.step else {
            self.next_step(now);
            return true;
        };
        let Some(plan) = self.script.step(play.scene, step.step) else {
            return false;
        };
        let failed = |number: &TaskNumber| {
            self.tasks
                .get(number)
                .is_some_and(|task| !task.excused && task.is_failure())
        };
        if plan.on_failure == OnFailure::Stop && step.tasks.iter().any(failed) {
            self.stop(now, Command::Stop, By::Script);
            return false;
        }
        let asked = |number: &TaskNumber| {
            self.tasks
                .get(number)
                .is_some_and(|task| task.state == TaskState::Asked)
        };
        let unanswered = step.tasks.iter().any(asked);
        if step.todo.is_empty() {
            return !unanswered && self.step_over(now);
        }
        if plan.parallel {
            let due = step
                .todo
                .iter()
                .position(|todo| todo.at.is_none_or(|at| at <= now));
            let Some(todo) = due.and_then(|due| step.todo.remove(due)) else {
                return false;
            };
            self.start(now, todo);
            return true;
        }
        // One after the other: the next one's delay begins when the last one was answered.
        if unanswered {
            return false;
        }
        let Some(todo) = step.todo.front_mut() else {
            return false;
        };
        let delay = match plan.tasks.get(todo.part) {
            // Without a server there is nothing to wait for.
            Some(task)
                if plan
                    .handler(task)
                    .is_some_and(|handler| self.options.remotes.contains(&handler.remote)) =>
            {
                task.delay
            }
            _ => std::time::Duration::ZERO,
        };
        let at = *todo.at.get_or_insert(now + delay);
        if now < at {
            return false;
        }
        if let Some(todo) = step.todo.pop_front() {
            self.start(now, todo);
        }
        true
    }

    /// Starts a task of the step that is under way.
    fn start(&mut self, now: Instant, todo: Todo) {
        let Phase::Playing(play) = &mut self.phase else {
            return;
        };
        let (scene, Some(step)) = (play.scene, &mut play.step) else {
            return;
        };
        let script = std::sync::Arc::clone(&self.script);
        let Some(plan) = script.step(scene, step.step) else {
            return;
        };
        let Some(task) = plan.tasks.get(todo.part) else {
            return;
        };
        let Some(handler) = plan.handler(task) else {
            return;
        };
        let number = TaskNumber(self.next_task);
        self.next_task += 1;
        step.tasks.push(number);
        if let Some(again) = todo.retry_of {
            self.unresolved.remove(&again);
        }
        let (step, part, retry_of) = (step.step, todo.part, todo.retry_of);
        self.events.push_back(Event::TaskStarting {
            task: number,
            scene,
            step,
            part,
            retry_of,
        });
        let live = Live {
            place: Some((scene, step, part)),
            awaited: plan.wait && task.wait,
            status_text: format!("{}:{}:{}", handler.key, task.component, task.goal),
            ..Live::new(now, &handler.remote)
        };
        self.tasks.insert(number, live);
        self.live.insert(number);
        if !self.options.remotes.contains(&handler.remote) {
            let text = format!("there is no server '{}'", handler.remote);
            return self.set_state(number, TaskState::NotStarted, &text);
        }
        let init = Ask::Init {
            handler: handler.name.clone(),
            component: task.component.clone(),
            goal: task.goal.clone(),
        };
        self.send(now, number, init);
    }
}
