//! A script as it was read: scenes of steps of tasks, each with its place in the file.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use super::event::{Outline, SceneOutline, StepOutline, TaskOutline};
use super::finding::Finding;
use super::read;
use ztl_std::remotes::{NoRemote, Remotes};
use ztl_yaml::{Diagnostic, Diagnostics, Document, Rules, Span};

/// Most lines that are named where one name stands in many.
const LINES: usize = 10;

/// A script: what is played, in the order of its file.
///
/// Names are what is shown and sent; keys are what stands in the file, parameters included.
#[derive(Debug, Clone)]
pub struct Script {
    /// In the order of the file.
    pub scenes: Vec<Scene>,
    document: Document,
    doubts: Vec<Finding>,
}

/// A scene: steps, one after the other.
#[derive(Debug, Clone)]
pub struct Scene {
    /// As in the file, with parameters.
    pub key: String,
    /// Without them.
    pub name: String,
    /// Time before its first step.
    pub delay: Duration,
    /// In the order of the file.
    pub steps: Vec<Step>,
    /// Where its key stands.
    pub span: Span,
}

/// A step: tasks that belong together.
#[derive(Debug, Clone)]
pub struct Step {
    /// As in the file, with parameters.
    pub key: String,
    /// Without them.
    pub name: String,
    /// Time before its first task's own delay.
    pub delay: Duration,
    /// Whether the next step waits for the end of this one.
    pub wait: bool,
    /// Whether its tasks start together, each after its own delay; else one after the other.
    pub parallel: bool,
    /// What is done when a task that it waits for fails.
    pub on_failure: OnFailure,
    /// Those whose tasks these are.
    pub handlers: Vec<Handler>,
    /// All tasks of all handlers, in the order of the file.
    pub tasks: Vec<Task>,
    /// Where its key stands.
    pub span: Span,
}

/// A handler within a step.
#[derive(Debug, Clone)]
pub struct Handler {
    /// As in the file, with parameters.
    pub key: String,
    /// The handler's name, as it is sent.
    pub name: String,
    /// The name of its server in the configuration.
    pub remote: String,
    /// Where its key stands.
    pub span: Span,
}

/// A task: what a component of a handler is to do.
#[derive(Debug, Clone)]
pub struct Task {
    /// Whose it is: a place in [`Step::handlers`].
    pub handler: usize,
    /// The component as in the file, with parameters.
    pub key: String,
    /// The component's name, as it is sent.
    pub component: String,
    /// Time before it is sent.
    pub delay: Duration,
    /// Whether its step waits for its end.
    pub wait: bool,
    /// Longest time from its start to its end.
    pub limit: Option<Duration>,
    /// The goal's text, as it is sent.
    pub goal: String,
    /// Where its key stands.
    pub span: Span,
}

/// What is done when a task that a step waits for fails, is refused, or takes too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OnFailure {
    /// The operator is asked.
    Ask,
    /// Everything is stopped.
    Stop,
    /// It is told, and the script goes on, as the original does; but where a server is not there, the
    /// operator is asked.
    #[default]
    Usual,
    /// It is told, and the script goes on.
    GoOn,
    /// It is tried again, so many times; then the operator is asked.
    Retry(u32),
}

/// What holds where a script says nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Defaults {
    /// Longest time of a task.
    pub timeout: Option<Duration>,
    /// For every step.
    pub on_failure: OnFailure,
    /// For every step.
    pub parallel: bool,
}

impl Script {
    /// Reads a script that can be played; `defaults` hold where it says nothing.
    ///
    /// ```
    /// use ztl_script::{Defaults, Script};
    ///
    /// let file = b"
    /// scene:
    ///   step (delay = 1.5; wait = false):
    ///     robot:
    ///       say: hello
    ///       turn: [0, 90.0]
    /// ";
    /// let script = Script::read("scene.yaml", file, Defaults::default()).unwrap();
    /// let step = &script.scenes[0].steps[0];
    /// assert_eq!((step.name.as_str(), step.delay.as_millis(), step.wait), ("step ", 1500, false));
    /// assert_eq!(step.tasks[1].goal, "[0, 90.0]");
    /// ```
    ///
    /// # Errors
    /// Every mistake that keeps it from being played, each with its place.
    pub fn read(file: &str, bytes: &[u8], defaults: Defaults) -> Result<Self, Diagnostics> {
        let (script, findings) = Self::examine(file, bytes, defaults);
        let mistakes = findings.into_iter().filter(|finding| !finding.is_doubt());
        let mistakes: Vec<_> = mistakes.map(Finding::into_diagnostic).collect();
        match script {
            Some(script) if mistakes.is_empty() => Ok(script),
            _ => Err(Diagnostics::new(mistakes)),
        }
    }

    /// Reads a file, and says all that is wrong and doubtful in it, in its order. The script is what can be
    /// made out, to look further; one with mistakes is not to be played ([`read`](Self::read)). There is
    /// none where the file cannot be read or is invalid YAML.
    #[must_use]
    pub fn check(path: &Path, defaults: Defaults) -> (Option<Self>, Vec<Finding>) {
        match ztl_std::files::read_yaml(path) {
            Ok(bytes) => Self::examine(&path.display().to_string(), &bytes, defaults),
            Err(mistakes) => (None, mistakes.into_iter().map(Finding::mistake).collect()),
        }
    }

    fn examine(file: &str, bytes: &[u8], defaults: Defaults) -> (Option<Self>, Vec<Finding>) {
        let document = match Document::parse_by(file, bytes, Rules::Python) {
            Ok(document) => document,
            Err(mistakes) => return (None, mistakes.into_iter().map(Finding::mistake).collect()),
        };
        let (scenes, findings) = read::scenes(&document, defaults);
        let doubts = findings
            .iter()
            .filter(|finding| finding.is_doubt())
            .cloned();
        let script = Self {
            scenes,
            document,
            doubts: doubts.collect(),
        };
        (Some(script), findings)
    }

    /// The same from a file.
    ///
    /// # Errors
    /// As [`read`](Self::read), and when the file cannot be read.
    pub fn load(path: &Path, defaults: Defaults) -> Result<Self, Diagnostics> {
        let name = path.display().to_string();
        Self::read(&name, &ztl_std::files::read_yaml(path)?, defaults)
    }

    /// What is played, but was probably not meant so; in the order of the file.
    #[must_use]
    pub fn doubts(&self) -> &[Finding] {
        &self.doubts
    }

    /// What keeps its tasks from their servers: names that `remotes` does not have, and entries that are
    /// wrong. Each is said once, however often the script uses it.
    #[must_use]
    pub fn unknown_remotes(&self, remotes: &Remotes) -> Vec<Finding> {
        let names = self.remotes();
        if remotes.task_names().next().is_none() && !names.is_empty() {
            let message = "it names no server under 'remotes'";
            let needed = format!("the script uses: {}", names.join(", "));
            let found = Diagnostic::of_file(remotes.name(), message).with_help(needed);
            return vec![Finding::mistake(found)];
        }
        let mut findings: Vec<Finding> = Vec::new();
        for name in names {
            match remotes.task(name) {
                Ok(_) => {}
                Err(NoRemote::Wrong(mistakes)) => {
                    // Two names may stand for one entry.
                    for found in mistakes.into_iter().map(Finding::mistake) {
                        if !findings.contains(&found) {
                            findings.push(found);
                        }
                    }
                }
                Err(unknown) => findings.extend(self.unknown_remote(name, &unknown)),
            }
        }
        findings
    }

    /// A name that the configuration does not have, at its first place.
    fn unknown_remote(&self, name: &str, unknown: &NoRemote) -> Option<Finding> {
        let steps = self.scenes.iter().flat_map(|scene| &scene.steps);
        let mut handlers = steps
            .flat_map(|step| &step.handlers)
            .filter(|handler| handler.remote == name);
        let first = handlers.next()?;
        let mut message = unknown.to_string();
        if first.key != first.name && first.remote == first.key {
            message += "; in parentheses, write (remote=NAME)";
        }
        let lines: BTreeSet<usize> = handlers.map(|handler| handler.span.start.line).collect();
        if !lines.is_empty() {
            let shown: Vec<String> = lines.iter().take(LINES).map(usize::to_string).collect();
            let more = match lines.len().saturating_sub(LINES) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            message += &format!(" (also in line {}{more})", shown.join(", "));
        }
        Some(Finding::mistake(self.document.mistake(first.span, message)))
    }

    /// The names of the servers that it uses, each once, in the order of the file.
    #[must_use]
    pub fn remotes(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        let steps = self.scenes.iter().flat_map(|scene| &scene.steps);
        for handler in steps.flat_map(|step| &step.handlers) {
            if !names.contains(&handler.remote.as_str()) {
                names.push(&handler.remote);
            }
        }
        names
    }

    /// The file that it was read from.
    #[must_use]
    pub const fn document(&self) -> &Document {
        &self.document
    }

    /// What it says is to be done.
    #[must_use]
    pub fn outline(&self) -> Outline {
        Outline {
            scenes: self.scenes.iter().map(Scene::outline).collect(),
        }
    }

    /// A step, if there is such a one.
    #[must_use]
    pub fn step(&self, scene: usize, step: usize) -> Option<&Step> {
        self.scenes.get(scene)?.steps.get(step)
    }
}

impl Scene {
    fn outline(&self) -> SceneOutline {
        SceneOutline {
            name: self.name.trim().to_owned(),
            delay: self.delay,
            steps: self.steps.iter().map(Step::outline).collect(),
        }
    }
}

impl Step {
    fn outline(&self) -> StepOutline {
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
        }
    }

    /// Whose task it is.
    #[must_use]
    pub fn handler(&self, task: &Task) -> Option<&Handler> {
        self.handlers.get(task.handler)
    }
}
