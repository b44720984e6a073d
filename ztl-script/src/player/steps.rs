//! From scene to scene and from step to step.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use ztl_core::Instant;

use super::state::{Phase, Play, Player, RunTask, Stage, StepPlay, Todo};
use crate::event::{DecidedBy, Ending, Question, RunCommand, RunEvent, TaskNumber, TaskState};
use crate::model::{Handler, OnFailure, Task};
use crate::server::ServerRequest;

impl Player {
    /// Plays a scene. `shown`: the scenes shown before and after it.
    pub(super) fn play(&mut self, now: Instant, scene: usize, shown: (usize, usize), replay: bool) {
        let from = match self.options.from {
            Some((of, step)) if of == scene && !self.takes.contains_key(&scene) => step,
            _ => 0,
        };
        for step in 0..from {
            let by = DecidedBy::Options;
            self.emit(RunEvent::StepSkipped { scene, step, by });
        }
        let plan = self.script.scenes.get(scene);
        let steps = plan.map_or(0, |plan| plan.steps.len());
        let delay = plan.map(|plan| plan.delay).unwrap_or_default();
        let steps = (from..steps).map(|step| (step, None)).collect();
        self.begin_play(now + delay, scene, shown, replay, steps);
    }

    /// Retries what failed in the last scene.
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
        self.emit(RunEvent::SceneStarted {
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

    /// Does everything that can be done now.
    pub(super) fn advance(&mut self, now: Instant) {
        // Each turn starts a task or ends a step, so the loop ends.
        while self.turn(now) {}
        self.settle();
    }

    fn turn(&mut self, now: Instant) -> bool {
        let Some(play) = self.play_mut() else {
            return self.answer_unattended(now);
        };
        match play.stage {
            Stage::Paused => false,
            Stage::Delay(until) if now < until => false,
            Stage::Delay(_) => {
                play.stage = Stage::Step;
                match play.step.as_mut().filter(|step| !step.begun) {
                    Some(step) => {
                        step.begun = true;
                        self.schedule_parallel(now);
                    }
                    None => self.next_step(now),
                }
                true
            }
            Stage::Step => self.step_turn(now),
        }
    }

    /// An unattended run starts every scene, and ends after the last.
    fn answer_unattended(&mut self, now: Instant) -> bool {
        let command = match (&self.phase, self.question) {
            (Phase::Idle, Some(Question::Scene { .. })) => RunCommand::Start,
            (Phase::Idle, Some(Question::End)) => RunCommand::Leave,
            _ => return false,
        };
        if self.options.unattended {
            self.obey(now, command, DecidedBy::Options);
        }
        self.options.unattended
    }

    /// In a parallel step, all delays begin now.
    fn schedule_parallel(&mut self, now: Instant) {
        let script = Arc::clone(&self.script);
        let Some((scene, step)) = self.step_mut() else {
            return;
        };
        let Some(plan) = script.step(scene, step.step).filter(|plan| plan.parallel) else {
            return;
        };
        for todo in &mut step.todo {
            let task = plan.tasks.get(todo.part);
            todo.at = Some(now + task.map(|task| task.delay).unwrap_or_default());
        }
    }

    /// Begins the next step, or ends the scene.
    fn next_step(&mut self, now: Instant) {
        let script = Arc::clone(&self.script);
        let Some(play) = self.play_mut() else {
            return;
        };
        let Some((index, retried)) = play.steps.pop_front() else {
            let end = match play.failures {
                true => Ending::Failures,
                false => Ending::Completed,
            };
            let then = play.then;
            self.end_scene(end);
            return self.show(then);
        };
        let scene = play.scene;
        let Some(plan) = script.step(scene, index) else {
            return;
        };
        let delay = match retried {
            Some(_) => Duration::ZERO,
            None => plan.delay,
        };
        let all = (0..plan.tasks.len()).map(|part| Todo {
            part,
            at: None,
            retry_of: None,
        });
        play.step = Some(StepPlay {
            step: index,
            todo: retried.map_or_else(|| all.collect(), VecDeque::from),
            tasks: Vec::new(),
            told: None,
            asked: false,
            retries: 0,
            begun: false,
        });
        play.stage = Stage::Delay(now + delay);
        self.emit(RunEvent::StepStarted { scene, step: index });
    }

    /// Starts what is due; when everything is started, checks whether the step is over.
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
        let tasks = &self.tasks;
        let any = |is: fn(&RunTask) -> bool| {
            let mut of_step = step.tasks.iter().filter_map(|number| tasks.get(number));
            of_step.any(is)
        };
        if plan.on_failure == OnFailure::Stop && any(|task| !task.excused && task.is_failure()) {
            self.obey(now, RunCommand::Stop, DecidedBy::Script);
            return false;
        }
        let unanswered = any(|task| task.state == TaskState::Asked);
        if step.todo.is_empty() {
            return !unanswered && self.step_over(now);
        }
        if plan.parallel {
            let due = |todo: &Todo| todo.at.is_none_or(|at| at <= now);
            let due = step.todo.iter().position(due);
            let Some(todo) = due.and_then(|due| step.todo.remove(due)) else {
                return false;
            };
            self.start(now, todo);
            return true;
        }
        // One after the other: the delay of a task begins when the one before was answered.
        if unanswered {
            return false;
        }
        let Some(todo) = step.todo.front_mut() else {
            return false;
        };
        let task = plan.tasks.get(todo.part).filter(|task| {
            // A task without a server is not waited for.
            let handler = plan.handler(task);
            handler.is_some_and(|handler| self.options.remotes.contains(&handler.remote))
        });
        let delay = task.map(|task| task.delay).unwrap_or_default();
        let at = *todo.at.get_or_insert(now + delay);
        if now < at {
            return false;
        }
        if let Some(todo) = step.todo.pop_front() {
            self.start(now, todo);
        }
        true
    }

    /// Starts a task of the current step.
    fn start(&mut self, now: Instant, todo: Todo) {
        let script = Arc::clone(&self.script);
        let number = self.number_task();
        let Some((scene, step)) = self.step_mut() else {
            return;
        };
        let planned = script.step(scene, step.step).and_then(|plan| {
            let task = plan.tasks.get(todo.part)?;
            Some((plan, task, plan.handler(task)?))
        });
        let Some((plan, task, handler)) = planned else {
            return;
        };
        step.tasks.push(number);
        let (step, part, retry_of) = (step.step, todo.part, todo.retry_of);
        if let Some(failed) = retry_of {
            self.unresolved.remove(&failed);
        }
        self.emit(RunEvent::TaskStarting {
            task: number,
            scene,
            step,
            part,
            retry_of,
        });
        let new = RunTask {
            place: Some((scene, step, part)),
            awaited: plan.wait && task.wait,
            ..RunTask::new(now, handler.remote.clone())
        };
        self.init(now, (number, new), handler, task);
    }

    /// Sends a task.
    pub(super) fn init(
        &mut self,
        now: Instant,
        (number, new): (TaskNumber, RunTask),
        handler: &Handler,
        task: &Task,
    ) {
        let status_text = format!("{}:{}:{}", handler.key, task.component, task.goal);
        self.tasks.insert(number, RunTask { status_text, ..new });
        self.live.insert(number);
        if !self.options.remotes.contains(&handler.remote) {
            let text = format!(
                "the configuration has no valid entry for server '{}'",
                handler.remote
            );
            return self.set_state(number, TaskState::NotStarted, &text);
        }
        let init = ServerRequest::Init {
            handler: handler.name.clone(),
            component: task.component.clone(),
            goal: task.goal.clone(),
        };
        self.send(now, number, init);
    }
}
