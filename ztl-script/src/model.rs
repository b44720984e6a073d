//! Scenes of steps of tasks, each with its place in the file.
//!
//! Names are what is shown and sent; keys are the text of the file, parameters included.

use std::time::Duration;

use ztl_yaml::Span;

use crate::event::{SceneOutline, StepOutline, TaskOutline};

/// A scene: steps, one after the other.
#[derive(Debug, Clone)]
pub struct Scene {
    /// As in the file, with parameters.
    pub key: String,
    /// Without parameters.
    pub name: String,
    /// Time before its first step.
    pub delay: Duration,
    /// In the order of the file.
    pub steps: Vec<Step>,
    /// What happens to it when nobody operates the show any more.
    pub operator_gone: OperatorGone,
    /// Place of its key.
    pub span: Span,
}

/// A cue: tasks that the operator starts together at any moment, beside the scene that plays.
#[derive(Debug, Clone)]
pub struct Cue {
    /// Its tasks, without delays.
    pub step: Step,
    /// The key that starts it.
    pub key: Option<char>,
    /// What happens to its tasks when nobody operates the show any more.
    pub operator_gone: OperatorGone,
}

/// A step: tasks that belong together.
#[derive(Debug, Clone)]
pub struct Step {
    /// As in the file, with parameters.
    pub key: String,
    /// Without parameters.
    pub name: String,
    /// Time before the delay of its first task begins.
    pub delay: Duration,
    /// Whether the next step waits for the end of this one.
    pub wait: bool,
    /// Whether its tasks start together, each after its own delay; otherwise one after the other.
    pub parallel: bool,
    /// What to do when a task that it waits for fails.
    pub on_failure: OnFailure,
    /// The handlers of its tasks.
    pub handlers: Vec<Handler>,
    /// All tasks of all handlers, in the order of the file.
    pub tasks: Vec<Task>,
    /// Place of its key.
    pub span: Span,
}

/// A handler within a step.
#[derive(Debug, Clone)]
pub struct Handler {
    /// As in the file, with parameters.
    pub key: String,
    /// The handler's name, as it is sent.
    pub name: String,
    /// Name of its server in the configuration.
    pub remote: String,
    /// Place of its key.
    pub span: Span,
}

/// A task: what a component of a handler is to do.
#[derive(Debug, Clone)]
pub struct Task {
    /// Index of its handler in [`Step::handlers`].
    pub handler: usize,
    /// The component as in the file, with parameters.
    pub key: String,
    /// The component's name, as it is sent.
    pub component: String,
    /// Time before it is sent.
    pub delay: Duration,
    /// Whether its step waits for its end.
    pub wait: bool,
    /// Time limit.
    pub limit: Option<Duration>,
    /// The goal, as it is sent.
    pub goal: String,
    /// Its place; that of the key if nothing is written.
    pub goal_span: Span,
    /// Place of its key.
    pub span: Span,
}

/// What to do when a task that a step waits for fails, is refused, or takes too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnFailure {
    /// Ask the operator.
    Ask,
    /// Abort the tasks of this run and end it.
    Stop,
    /// Report it and continue, as the original does; but ask the operator if a server is absent.
    #[default]
    Usual,
    /// Report it and continue.
    GoOn,
    /// Retry so many times, then ask the operator.
    Retry(u32),
}

/// What happens when nobody operates the show any more, because the operator's page is gone (`ztl web`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OperatorGone {
    /// It goes on.
    #[default]
    GoOn,
    /// It is stopped after this time.
    Stop(Duration),
}

/// What applies where a script says nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Defaults {
    /// Time limit of a task.
    pub timeout: Option<Duration>,
    /// For every step.
    pub on_failure: OnFailure,
    /// For every step.
    pub parallel: bool,
    /// For every scene and cue.
    pub operator_gone: OperatorGone,
}

impl Scene {
    pub(crate) fn outline(&self) -> SceneOutline {
        SceneOutline {
            name: self.name.trim().to_owned(),
            delay: self.delay,
            steps: self.steps.iter().map(Step::outline).collect(),
        }
    }
}

impl Cue {
    pub(crate) fn outline(&self) -> StepOutline {
        StepOutline {
            key: self.key,
            ..self.step.outline()
        }
    }
}

impl Step {
    pub(crate) fn outline(&self) -> StepOutline {
        let tasks = self.tasks.iter().filter_map(|task| {
            let handler = self.handler(task)?;
            Some(TaskOutline {
                handler: handler.name.clone(),
                component: task.component.clone(),
                goal: task.goal.clone(),
                remote: handler.remote.clone(),
                delay: task.delay,
                wait: task.wait,
                limit: task.limit,
            })
        });
        StepOutline {
            name: self.name.trim().to_owned(),
            delay: self.delay,
            wait: self.wait,
            parallel: self.parallel,
            tasks: tasks.collect(),
            key: None,
        }
    }

    /// The handler of a task.
    #[must_use]
    pub fn handler(&self, task: &Task) -> Option<&Handler> {
        self.handlers.get(task.handler)
    }
}
