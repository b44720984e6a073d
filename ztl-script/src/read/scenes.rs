//! The four levels of a script: scenes, steps, handlers, and components with their goals.

use std::collections::HashMap;
use std::time::Duration;

use ztl_yaml::python::PythonValue;
use ztl_yaml::{Document, Node, NodeValue, Span};

use super::reader::{Entry, Reader, short, short_quoted};
use super::{keys, params};
use crate::finding::Finding;
use crate::model::{Cue, Defaults, Handler, OnFailure, Scene, Step, Task};

const SHAPE: &str = "write scene: {step: {handler: {component: goal}}}, each on a line of its own";

/// The key of the cues. With parameters, or with a blank behind it, it is a scene.
const CUES: &str = "cues";

/// The scenes and cues of a document, as far as they can be read, and the findings.
pub(crate) fn scenes(
    document: &Document,
    defaults: Defaults,
) -> (Vec<Scene>, Vec<Cue>, Vec<Finding>) {
    let mut reader = Reader::new(document, defaults);
    let root = document.root();
    if root.is_null() {
        reader.mistake(
            root.span,
            "there is no scene in this file",
            Some(SHAPE.to_owned()),
        );
    }
    let entries = match root.is_null() {
        true => Vec::new(),
        false => reader.level(root, root.span, ("script", ""), "scenes"),
    };
    let mut scenes = Vec::new();
    let mut cues = Vec::new();
    for mut entry in entries {
        if matches!(&entry.key, PythonValue::Text(key) if key == CUES) {
            reader.look_through(&mut entry, |reader, lost| drop(reader.cues(&lost)));
            cues = reader.cues(&entry);
            continue;
        }
        reader.look_through(&mut entry, |reader, lost| drop(reader.scene(lost)));
        scenes.push(reader.scene(entry));
    }
    let names = scenes.iter().map(|scene| (scene.name.trim(), scene.span));
    reader.namesakes("scene", "--scene", names);
    let mut findings = reader.findings;
    findings.sort_by_key(|finding| finding.diagnostic().span.map(|span| span.start));
    (scenes, cues, findings)
}

impl<'d> Reader<'d> {
    /// The entries of the mapping behind a key. `what`: the kind of the key; `of`: the kind of its entries.
    fn level(
        &mut self,
        node: &'d Node,
        at: Span,
        (what, name): (&str, &str),
        of: &str,
    ) -> Vec<Entry<'d>> {
        let name = name.trim();
        let whose = match what {
            "script" => "a script".to_owned(),
            "cues" => format!("'{CUES}'"),
            what => format!("{what} '{}'", short(name)),
        };
        let NodeValue::Map(_) = &node.value else {
            let is = format!("{whose} is a mapping of {of}");
            let (message, help) = match () {
                () if node.is_null() && node.span == at => keys::without_colon(name),
                () if params::NAMES.contains(&name) => {
                    let value = self.value(node, None);
                    (is, Some(keys::in_parentheses(name, value)))
                }
                () => {
                    let value = match &node.value {
                        NodeValue::Scalar { text, plain: true } => text,
                        _ => "",
                    };
                    let spaced = keys::spaced(name).or_else(|| keys::spaced(value));
                    let help = spaced.unwrap_or_else(|| SHAPE.to_owned());
                    (format!("{is}; found {}", node.kind()), Some(help))
                }
            };
            // If nothing is written, point at the key.
            let span = if node.is_null() { at } else { node.span };
            self.mistake(span, message, help);
            return Vec::new();
        };
        let mut entries = self.entries(node, true);
        if entries.is_empty() {
            // The original plays it and does nothing.
            self.doubt(
                node.span,
                format!("{whose} has no {of}: nothing is done"),
                None,
            );
        }
        if what != "handler" {
            // Parts of a text are no scenes, steps or handlers; components without a goal are played.
            entries.retain(|entry| {
                if let Some((span, message, help)) =
                    entry.cut.and_then(|_| keys::colon_missing(entry))
                {
                    self.mistake(span, message, help);
                }
                entry.cut.is_none()
            });
        }
        entries
    }

    /// Looks for mistakes in entries that a later key of the same name replaced. They are doubts: the script
    /// is played without these entries, but the mistakes would count once the names differ.
    fn look_through(&mut self, entry: &mut Entry<'d>, look: impl Fn(&mut Self, Entry<'d>)) {
        for (name, value) in std::mem::take(&mut entry.lost) {
            let before = self.findings.len();
            let (key, lost, cut) = (entry.key.clone(), Vec::new(), None);
            look(
                self,
                Entry {
                    key,
                    name,
                    value,
                    lost,
                    cut,
                },
            );
            let found = self.findings.split_off(before).into_iter();
            self.findings
                .extend(found.map(|found| Finding::doubt(found.into_diagnostic())));
        }
    }

    /// Reports scenes or steps of one name whose parameters differ: each of them is played.
    fn namesakes<'n>(
        &mut self,
        what: &str,
        option: &str,
        names: impl Iterator<Item = (&'n str, Span)>,
    ) {
        let mut lines: HashMap<&str, usize> = HashMap::new();
        for (name, span) in names {
            let Some(line) = lines.insert(name, span.start.line) else {
                continue;
            };
            let name = short_quoted(name);
            let message = format!(
                "the {what} in line {line} is named {name}, too: both are played, and {option} {name} is ambiguous"
            );
            let help = "give them different names".to_owned();
            self.doubt(span, message, Some(help));
        }
    }

    fn scene(&mut self, entry: Entry<'d>) -> Scene {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut scene = Scene {
            name: parsed.name.to_owned(),
            delay: Duration::ZERO,
            steps: Vec::new(),
            operator_gone: self.defaults.operator_gone,
            span: entry.name.span,
            key: key.clone(),
        };
        for piece in &parsed.pieces {
            match piece.name {
                Some("delay") => {
                    scene.delay = self.delay(&entry, &key, *piece).unwrap_or(scene.delay)
                }
                Some("wait") => self.doubt_at(
                    &entry,
                    &key,
                    *piece,
                    "a scene takes no 'wait': it has no effect",
                    None,
                ),
                Some("operator_gone") => {
                    let read = params::operator_gone(piece.value.unwrap_or_default());
                    let read = self.parsed(&entry, &key, *piece, read);
                    scene.operator_gone = read.unwrap_or_default();
                }
                _ => self.unknown(&entry, &key, *piece, "a scene", &["delay", "operator_gone"]),
            }
        }
        let steps = self.level(
            entry.value,
            entry.name.span,
            ("scene", &scene.name),
            "steps",
        );
        for mut entry in steps {
            self.look_through(&mut entry, |reader, lost| drop(reader.step(lost)));
            scene.steps.push(self.step(entry));
        }
        let names = scene.steps.iter().map(|step| (step.name.trim(), step.span));
        self.namesakes("step", "--from", names);
        scene
    }

    /// The cues: written as the steps of a scene.
    fn cues(&mut self, entry: &Entry<'d>) -> Vec<Cue> {
        let what = ("cues", "");
        let mut cues: Vec<Cue> = Vec::new();
        for mut entry in self.level(entry.value, entry.name.span, what, "cues") {
            self.look_through(&mut entry, |reader, lost| drop(reader.cue(lost)));
            let cue = self.cue(entry);
            let same = cues
                .iter()
                .find(|other| cue.key.is_some() && other.key == cue.key);
            if let Some(other) = same {
                let (line, span) = (other.step.span.start.line, cue.step.span);
                let message = format!("the cue in line {line} has the same key");
                self.mistake(span, message, Some("give them different keys".to_owned()));
            }
            cues.push(cue);
        }
        cues
    }

    fn cue(&mut self, entry: Entry<'d>) -> Cue {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut cue = Cue {
            step: Step {
                name: parsed.name.to_owned(),
                delay: Duration::ZERO,
                wait: false,
                parallel: true,
                on_failure: OnFailure::GoOn,
                handlers: Vec::new(),
                tasks: Vec::new(),
                span: entry.name.span,
                key: key.clone(),
            },
            key: None,
            operator_gone: self.defaults.operator_gone,
        };
        let mut limit = self.defaults.timeout;
        for piece in &parsed.pieces {
            let value = piece.value.unwrap_or_default();
            match piece.name {
                Some("key") => {
                    cue.key = self.parsed(&entry, &key, *piece, params::cue_key(value));
                }
                Some("operator_gone") => {
                    let read = params::operator_gone(value);
                    let read = self.parsed(&entry, &key, *piece, read);
                    cue.operator_gone = read.unwrap_or_default();
                }
                Some("timeout") => limit = self.limit(&entry, &key, *piece).unwrap_or(limit),
                _ => {
                    let known = ["key", "operator_gone", "timeout"];
                    self.unknown(&entry, &key, *piece, "a cue", &known);
                }
            }
        }
        self.handlers(
            (entry.value, entry.name.span),
            ("cue", parsed.name),
            limit,
            &mut cue.step,
        );
        for task in &mut cue.step.tasks {
            if !std::mem::take(&mut task.delay).is_zero() {
                let message = "a cue starts its tasks at once: this delay has no effect";
                self.doubt(task.span, message, None);
            }
        }
        cue
    }

    fn step(&mut self, entry: Entry<'d>) -> Step {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut step = Step {
            name: parsed.name.to_owned(),
            delay: Duration::ZERO,
            wait: true,
            parallel: self.defaults.parallel,
            on_failure: self.defaults.on_failure,
            handlers: Vec::new(),
            tasks: Vec::new(),
            span: entry.name.span,
            key: key.clone(),
        };
        let mut limit = self.defaults.timeout;
        for piece in &parsed.pieces {
            match (piece.name, piece.value) {
                (Some("delay"), _) => {
                    step.delay = self.delay(&entry, &key, *piece).unwrap_or(step.delay)
                }
                (Some("wait"), Some(value)) => step.wait = self.truth(&entry, &key, value),
                (Some("parallel"), None) => step.parallel = true,
                (Some("parallel"), Some(value)) => step.parallel = self.truth(&entry, &key, value),
                (Some("timeout"), _) => limit = self.limit(&entry, &key, *piece).unwrap_or(limit),
                (Some("on_failure"), _) => {
                    let read = params::on_failure(piece.value.unwrap_or_default());
                    step.on_failure = self.parsed(&entry, &key, *piece, read).unwrap_or_default();
                }
                _ => {
                    let known = ["delay", "wait", "parallel", "timeout", "on_failure"];
                    self.unknown(&entry, &key, *piece, "a step", &known);
                }
            }
        }
        self.handlers(
            (entry.value, entry.name.span),
            ("step", parsed.name),
            limit,
            &mut step,
        );
        step
    }

    /// The handlers of a step or cue, with their tasks.
    fn handlers(
        &mut self,
        (value, at): (&'d Node, Span),
        of: (&str, &str),
        limit: Option<Duration>,
        step: &mut Step,
    ) {
        for mut entry in self.level(value, at, of, "handlers") {
            let before = step.clone();
            self.look_through(&mut entry, |reader, lost| {
                reader.handler(&lost, limit, &mut before.clone());
            });
            self.handler(&entry, limit, step);
        }
    }

    fn handler(&mut self, entry: &Entry<'d>, limit: Option<Duration>, step: &mut Step) {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut handler = Handler {
            name: parsed.name.to_owned(),
            remote: key.clone(),
            span: entry.name.span,
            key: key.clone(),
        };
        let mut clear = keys::is_clear(entry);
        for piece in &parsed.pieces {
            match (piece.name, piece.value) {
                (Some("remote"), Some(remote)) => handler.remote = remote.to_owned(),
                _ => {
                    self.unknown(entry, &key, *piece, "a handler", &["remote"]);
                    clear = false;
                }
            }
        }
        if clear {
            self.sent(entry.name, "handler", &handler.name);
        }
        let tasks = self.level(
            entry.value,
            entry.name.span,
            ("handler", &handler.name),
            "components with their goals",
        );
        if !keys::is_clear(entry) {
            // It was not meant as a handler, so it needs no server.
            return;
        }
        let index = step.handlers.len();
        step.handlers.push(handler);
        for mut entry in tasks {
            self.look_through(&mut entry, |reader, lost| {
                drop(reader.task(&lost, index, limit))
            });
            let before = self.mistakes();
            let task = self.task(&entry, index, limit);
            // A server could only judge what was made of the mistake.
            if self.mistakes() == before {
                step.tasks.push(task);
            }
        }
    }

    fn task(&mut self, entry: &Entry<'d>, handler: usize, limit: Option<Duration>) -> Task {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut task = Task {
            handler,
            component: parsed.name.to_owned(),
            delay: Duration::ZERO,
            wait: true,
            limit,
            goal: String::new(),
            goal_span: match entry.value.is_null() {
                true => entry.name.span,
                false => entry.value.span,
            },
            span: entry.name.span,
            key: key.clone(),
        };
        for piece in &parsed.pieces {
            match (piece.name, piece.value) {
                (Some("delay"), _) => {
                    task.delay = self.delay(entry, &key, *piece).unwrap_or(task.delay)
                }
                (Some("wait"), Some(value)) => task.wait = self.truth(entry, &key, value),
                (Some("timeout"), _) => {
                    task.limit = self.limit(entry, &key, *piece).unwrap_or(task.limit)
                }
                _ => self.unknown(
                    entry,
                    &key,
                    *piece,
                    "a component",
                    &["delay", "wait", "timeout"],
                ),
            }
        }
        let tell = match keys::lacks_colon(entry.name, entry.value) {
            true => {
                if let Some((span, message, help)) = keys::colon_missing(entry) {
                    self.doubt(span, message, help);
                }
                None
            }
            false => {
                self.sent(entry.name, "component", &task.component);
                Some(false)
            }
        };
        let goal = self.value(entry.value, tell);
        self.parameter(entry.name, &goal);
        task.goal = goal.to_string();
        task
    }
}
