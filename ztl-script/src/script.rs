//! Scripts: reading them and checking them without servers.

use std::collections::BTreeSet;
use std::path::Path;

use sha2::Digest;
use ztl_std::remotes::{NoRemote, Remotes};
use ztl_yaml::{Diagnostic, Diagnostics, Document, Rules, Span};

use crate::event::Outline;
use crate::finding::Finding;
use crate::model::{Cue, Defaults, Handler, Scene, Step, Task};
use crate::read;

/// Most lines that one message names.
const LINES: usize = 10;

/// A script: scenes in the order of their file.
#[derive(Debug, Clone)]
pub struct Script {
    /// In the order of the file.
    pub scenes: Vec<Scene>,
    /// In the order of the file.
    pub cues: Vec<Cue>,
    document: Document,
    doubts: usize,
}

impl Script {
    /// Reads a script that can be played; `defaults` apply where it says nothing.
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
    /// Every mistake that keeps it from being played, with its place.
    pub fn read(file: &str, bytes: &[u8], defaults: Defaults) -> Result<Self, Diagnostics> {
        let (script, findings) = Self::examine(file, bytes, defaults);
        let mistakes = findings.into_iter().filter(|finding| !finding.is_doubt());
        let mistakes: Vec<_> = mistakes.map(Finding::into_diagnostic).collect();
        match script {
            Some(script) if mistakes.is_empty() => Ok(script),
            _ => Err(Diagnostics::new(mistakes)),
        }
    }

    /// Reads a script from a file.
    ///
    /// # Errors
    /// As [`read`](Self::read), and when the file cannot be read.
    pub fn load(path: &Path, defaults: Defaults) -> Result<Self, Diagnostics> {
        let name = path.display().to_string();
        Self::read(&name, &ztl_std::files::read_yaml(path)?, defaults)
    }

    /// Reads a file and reports its mistakes and doubts in order. Returns the readable part as a script for
    /// further checks; do not play a script with mistakes. Returns no script if the file cannot
    /// be read or is invalid YAML.
    #[must_use]
    pub fn check(path: &Path, defaults: Defaults) -> (Option<Self>, Vec<Finding>) {
        match ztl_std::files::read_yaml(path) {
            Ok(bytes) => Self::examine(&path.display().to_string(), &bytes, defaults),
            Err(mistakes) => (None, mistakes.into_iter().map(Finding::mistake).collect()),
        }
    }

    pub(crate) fn examine(
        file: &str,
        bytes: &[u8],
        defaults: Defaults,
    ) -> (Option<Self>, Vec<Finding>) {
        let document = match Document::parse_by(file, bytes, Rules::Python) {
            Ok(document) => document,
            Err(mistakes) => return (None, mistakes.into_iter().map(Finding::mistake).collect()),
        };
        let (scenes, cues, findings) = read::scenes(&document, defaults);
        let doubts = findings.iter().filter(|finding| finding.is_doubt()).count();
        let script = Self {
            scenes,
            cues,
            document,
            doubts,
        };
        (Some(script), findings)
    }

    /// How many [doubtful](Finding::is_doubt) places it has.
    #[must_use]
    pub const fn doubts(&self) -> usize {
        self.doubts
    }

    /// Names of servers that `remotes` does not have, and entries that are wrong. Each is reported once; if the file could
    /// not be read, only that.
    #[must_use]
    pub fn unknown_remotes(&self, remotes: &Remotes) -> Vec<Finding> {
        let names = self.remotes();
        if let Some(why) = remotes.unread()
            && names.iter().any(|name| remotes.task(name).is_err())
        {
            return why.iter().cloned().map(Finding::mistake).collect();
        }
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
        let handlers = self.handlers().filter(|handler| handler.remote == name);
        let places: Vec<Span> = handlers.map(|handler| handler.span).collect();
        let first = self.first_handler(name)?;
        let mut message = unknown.to_string();
        if first.key != first.name && first.remote == first.key {
            message += "; in parentheses, write (remote=NAME)";
        }
        Some(self.mistake_at(&places, message, None))
    }

    /// The names of its servers, each once, in the order of the file.
    #[must_use]
    pub fn remotes(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for handler in self.handlers() {
            if !names.contains(&handler.remote.as_str()) {
                names.push(&handler.remote);
            }
        }
        names
    }

    /// The tasks for one server, with their handlers.
    pub fn tasks_of<'s>(
        &'s self,
        remote: &'s str,
    ) -> impl Iterator<Item = (&'s Handler, &'s Task)> + 's {
        self.steps()
            .flat_map(|step| {
                step.tasks
                    .iter()
                    .map(move |task| (step.handler(task), task))
            })
            .filter_map(move |(handler, task)| {
                let handler = handler.filter(|handler| handler.remote == remote)?;
                Some((handler, task))
            })
    }

    /// The first handler for a server.
    pub(crate) fn first_handler(&self, remote: &str) -> Option<&Handler> {
        self.handlers().find(|handler| handler.remote == remote)
    }

    fn steps(&self) -> impl Iterator<Item = &Step> {
        let of_scenes = self.scenes.iter().flat_map(|scene| &scene.steps);
        of_scenes.chain(self.cues.iter().map(|cue| &cue.step))
    }

    fn handlers(&self) -> impl Iterator<Item = &Handler> {
        self.steps().flat_map(|step| &step.handlers)
    }

    /// A mistake at a place in its file.
    pub(crate) fn mistake(&self, span: Span, message: String, help: Option<String>) -> Finding {
        let mut found = self.document.mistake(span, message);
        found.help = help;
        Finding::mistake(found)
    }

    /// One mistake with several places: at the first one. The message names the lines of the others.
    pub(crate) fn mistake_at(
        &self,
        places: &[Span],
        mut message: String,
        help: Option<String>,
    ) -> Finding {
        let first = places.first().copied().unwrap_or_default();
        let mut lines: BTreeSet<usize> = places.iter().map(|span| span.start.line).collect();
        lines.remove(&first.start.line);
        if !lines.is_empty() {
            let shown: Vec<String> = lines.iter().take(LINES).map(usize::to_string).collect();
            let more = match lines.len().saturating_sub(LINES) {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            message += &format!(" (also in line {}{more})", shown.join(", "));
        }
        self.mistake(first, message, help)
    }

    /// SHA-256 of the bytes of its file in lower-case hex, as `sha256sum` prints it.
    #[must_use]
    pub fn sha256(&self) -> String {
        let digest = sha2::Sha256::digest(self.document.bytes());
        digest.iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// What it plans.
    #[must_use]
    pub fn outline(&self) -> Outline {
        Outline {
            scenes: self.scenes.iter().map(Scene::outline).collect(),
            cues: self.cues.iter().map(Cue::outline).collect(),
        }
    }

    /// A step, by the indices of its scene and itself.
    #[must_use]
    pub fn step(&self, scene: usize, step: usize) -> Option<&Step> {
        self.scenes.get(scene)?.steps.get(step)
    }
}
