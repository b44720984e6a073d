//! From a YAML document to scenes, by PyYAML's rules (wire specification 8.1 to 8.3); with all that is
//! wrong or doubtful in it, each at its place.

use std::collections::HashMap;
use std::time::Duration;

use super::finding::Finding;
use super::model::{Defaults, Handler, Scene, Step, Task};
use super::params::{self, Piece};
use super::scalar::{self, CORE};
use super::value::{Value, quoted};
use crate::yaml::{Diagnostics, Document, LOOP, Mark, Node, Rules, Span, Value as Yaml, closest};

/// Most characters of a value that are repeated in a message.
const SHOWN: usize = 40;

/// The scenes of a document, as far as they can be made out, and what was found.
pub(super) fn scenes(document: &Document, defaults: Defaults) -> (Vec<Scene>, Vec<Finding>) {
    let mut reader = Reader {
        document,
        defaults,
        findings: Vec::new(),
    };
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
        false => reader.level(root, root.span, "a script", "scenes"),
    };
    let mut scenes = Vec::new();
    for mut entry in entries {
        reader.look_through(&mut entry, |reader, lost| drop(reader.scene(lost)));
        scenes.push(reader.scene(entry));
    }
    let mut findings = reader.findings;
    findings.sort_by_key(|finding| finding.diagnostic().span.map(|span| span.start));
    (scenes, findings)
}

impl Value {
    /// What PyYAML's `safe_load` makes of a file: a goal as it would stand in a script.
    ///
    /// # Errors
    /// What PyYAML would not take.
    pub fn read(file: &str, bytes: &[u8]) -> Result<Self, Diagnostics> {
        let document = Document::parse_by(file, bytes, Rules::Python)?;
        let (defaults, findings) = (Defaults::default(), Vec::new());
        let mut reader = Reader {
            document: &document,
            defaults,
            findings,
        };
        let value = reader.value(document.root(), None);
        let mistakes = reader
            .findings
            .into_iter()
            .filter(|finding| !finding.is_doubt());
        let mistakes: Vec<_> = mistakes.map(Finding::into_diagnostic).collect();
        match mistakes.is_empty() {
            true => Ok(value),
            false => Err(Diagnostics::new(mistakes)),
        }
    }
}

const SHAPE: &str = "write scene: {step: {handler: {component: goal}}}, each on a line of its own";

struct Reader<'d> {
    document: &'d Document,
    defaults: Defaults,
    findings: Vec<Finding>,
}

/// A key and what stands behind it.
struct Entry<'d> {
    key: Value,
    name: &'d Node,
    value: &'d Node,
    /// What stood there before under the same key, and is not played.
    lost: Vec<(&'d Node, &'d Node)>,
}

impl<'d> Reader<'d> {
    fn mistake(&mut self, span: Span, message: impl Into<String>, help: Option<String>) {
        let mut found = self.document.mistake(span, message);
        found.help = help;
        self.findings.push(Finding::mistake(found));
    }

    fn doubt(&mut self, span: Span, message: impl Into<String>, help: Option<String>) {
        let mut found = self.document.mistake(span, message);
        found.help = help;
        self.findings.push(Finding::doubt(found));
    }

    /// The entries of one of the four nested mappings.
    fn level(&mut self, node: &'d Node, at: Span, whose: &str, of: &str) -> Vec<Entry<'d>> {
        let Yaml::Map(_) = &node.value else {
            let message = format!("{whose} is a mapping of {of}; here is {}", node.kind());
            // Where nothing is written, its key is shown.
            let span = if node.is_null() { at } else { node.span };
            self.mistake(span, message, Some(SHAPE.to_owned()));
            return Vec::new();
        };
        let entries = self.entries(node, true);
        if entries.is_empty() {
            // Python plays it: nothing is done.
            self.doubt(
                node.span,
                format!("{whose} has no {of}: nothing is done"),
                None,
            );
        }
        entries
    }

    /// Looks for mistakes in what another key of the same name has replaced: they keep nothing from being
    /// played, but are there once the names differ.
    fn look_through(&mut self, entry: &mut Entry<'d>, look: impl Fn(&mut Self, Entry<'d>)) {
        for (name, value) in std::mem::take(&mut entry.lost) {
            let before = self.findings.len();
            let (key, lost) = (entry.key.clone(), Vec::new());
            look(
                self,
                Entry {
                    key,
                    name,
                    value,
                    lost,
                },
            );
            let found = self.findings.split_off(before).into_iter();
            self.findings
                .extend(found.map(|found| Finding::doubt(found.into_diagnostic())));
        }
    }

    fn scene(&mut self, entry: Entry<'d>) -> Scene {
        let key = entry.key.to_string();
        let parsed = self.key(&key, entry.name);
        let mut scene = Scene {
            name: parsed.name.to_owned(),
            delay: Duration::ZERO,
            steps: Vec::new(),
            span: entry.name.span,
            key: key.clone(),
        };
        for piece in &parsed.pieces {
            match piece.name {
                Some("delay") => {
                    scene.delay = self.seconds(&entry, &key, *piece).unwrap_or(scene.delay)
                }
                Some("wait") => self.doubt_at(
                    &entry,
                    &key,
                    *piece,
                    "a scene takes no 'wait': it has no effect",
                    None,
                ),
                _ => self.unknown(&entry, &key, *piece, "a scene", &["delay"]),
            }
        }
        let whose = format!("scene '{}'", short(scene.name.trim()));
        let steps = self.level(entry.value, entry.name.span, &whose, "steps");
        for mut entry in steps {
            self.look_through(&mut entry, |reader, lost| drop(reader.step(lost)));
            scene.steps.push(self.step(entry));
        }
        scene
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
                    step.delay = self.seconds(&entry, &key, *piece).unwrap_or(step.delay)
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
        let whose = format!("step '{}'", short(step.name.trim()));
        for mut entry in self.level(entry.value, entry.name.span, &whose, "handlers") {
            let before = step.clone();
            self.look_through(&mut entry, |reader, lost| {
                reader.handler(&lost, limit, &mut before.clone());
            });
            self.handler(&entry, limit, &mut step);
        }
        step
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
        for piece in &parsed.pieces {
            match (piece.name, piece.value) {
                (Some("remote"), Some(remote)) => handler.remote = remote.to_owned(),
                _ => self.unknown(entry, &key, *piece, "a handler", &["remote"]),
            }
        }
        self.sent(entry.name, "handler", &handler.name);
        let whose = format!("handler '{}'", short(handler.name.trim()));
        let tasks = self.level(
            entry.value,
            entry.name.span,
            &whose,
            "components with their goals",
        );
        let index = step.handlers.len();
        step.handlers.push(handler);
        for mut entry in tasks {
            self.look_through(&mut entry, |reader, lost| {
                drop(reader.task(&lost, index, limit))
            });
            step.tasks.push(self.task(&entry, index, limit));
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
            span: entry.name.span,
            key: key.clone(),
        };
        for piece in &parsed.pieces {
            match (piece.name, piece.value) {
                (Some("delay"), _) => {
                    task.delay = self.seconds(entry, &key, *piece).unwrap_or(task.delay)
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
        self.sent(entry.name, "component", &task.component);
        task.goal = self.value(entry.value, Some(false)).to_string();
        task
    }

    /// A name that goes over the wire in front of a ':'.
    fn sent(&mut self, node: &Node, what: &str, name: &str) {
        if name.contains(':') {
            let message = format!("servers take a {what}'s name to end before the ':'");
            self.doubt(node.span, message, None);
        } else if name.trim() != name {
            let message = format!(
                "the {what}'s name is sent with its blanks: {}",
                quoted(name)
            );
            let help = name.trim_start() == name;
            let help = help.then(|| "write no blank before the '('".to_owned());
            self.doubt(node.span, message, help);
        }
    }

    /// Takes a key apart, and says what is doubtful about its parentheses.
    fn key<'k>(&mut self, key: &'k str, node: &Node) -> params::Key<'k> {
        let parsed = params::parse(key);
        if let Some(doubt) = parsed.doubt {
            self.doubt(node.span, doubt, None);
        }
        parsed
    }

    fn seconds(&mut self, entry: &Entry<'_>, key: &str, piece: Piece<'_>) -> Option<Duration> {
        self.parsed(
            entry,
            key,
            piece,
            params::seconds(piece.value.unwrap_or_default()),
        )
    }

    fn limit(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
    ) -> Option<Option<Duration>> {
        self.parsed(
            entry,
            key,
            piece,
            params::limit(piece.value.unwrap_or_default()),
        )
    }

    fn parsed<T>(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        read: Result<T, String>,
    ) -> Option<T> {
        match read {
            Ok(value) => Some(value),
            Err(message) => {
                let span = within(entry.name, key, piece.value.unwrap_or(piece.text));
                self.mistake(span, message, None);
                None
            }
        }
    }

    /// A typo is false, as in the original, and doubtful.
    fn truth(&mut self, entry: &Entry<'_>, key: &str, value: &str) -> bool {
        let (truth, known) = params::truth(value);
        if !known {
            let help = closest(value, ["true", "false", "yes", "no", "on", "off"]);
            let help = match help {
                Some(meant) => format!("did you mean '{meant}'?"),
                None => "write yes or no".to_owned(),
            };
            let span = within(entry.name, key, value);
            let value = short(value);
            self.doubt(
                span,
                format!("'{value}' is neither yes nor no, and is taken for no"),
                Some(help),
            );
        }
        truth
    }

    /// A parameter that has no effect: why, and what was probably meant.
    fn unknown(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        whose: &str,
        known: &[&str],
    ) {
        let all = || {
            let first = known.first().unwrap_or(&"");
            format!("write as ({first}=…); there are: {}", known.join(", "))
        };
        let (text, message, help) = match (piece.name, piece.value) {
            (None, _) => {
                let message = format!("'{}' has more than one '='", short(piece.text));
                (piece.text, message, all())
            }
            (Some(name), None) if name.bytes().all(|c| c.is_ascii_digit()) => {
                let message = format!("'{name}' is a parameter of its own here");
                (
                    name,
                    message,
                    "write a fraction with a point, as 1.5".to_owned(),
                )
            }
            (Some(name), None) if known.contains(&name) => {
                (name, format!("'{name}' has no value"), all())
            }
            (Some(name), _) => {
                let message = format!("{whose} has no parameter '{}'", short(name));
                let meant = closest(name, known.iter().copied());
                let help = meant.map(|meant| format!("did you mean '{meant}'?"));
                (name, message, help.unwrap_or_else(all))
            }
        };
        let message = format!("{message}: it has no effect");
        self.doubt_at(entry, key, Piece { text, ..piece }, &message, Some(help));
    }

    fn doubt_at(
        &mut self,
        entry: &Entry<'_>,
        key: &str,
        piece: Piece<'_>,
        message: &str,
        help: Option<String>,
    ) {
        let span = within(entry.name, key, piece.text);
        self.doubt(span, message, help);
    }

    /// The entries of a mapping: `<<` merged, of equal keys the last value at the place of the first.
    fn entries(&mut self, node: &'d Node, tell: bool) -> Vec<Entry<'d>> {
        let mut pairs = Vec::new();
        self.flatten(node, &mut pairs);
        let mut entries: Vec<Entry<'d>> = Vec::new();
        // Where each is, and in which line of this very mapping it stands.
        let mut seen: HashMap<String, (usize, Option<usize>)> = HashMap::new();
        for (name, value, merged) in pairs {
            let key = match &name.value {
                // As a value it would have a meaning of its own.
                Yaml::Scalar { text, plain: true } if text == "=" => Value::Text(text.clone()),
                _ => self.value(name, tell.then_some(false)),
            };
            if !key.is_hashable() {
                self.mistake(name.span, "a collection cannot be a key", None);
                continue;
            }
            let line = (!merged).then_some(name.span.start.line);
            let identity = key.identity();
            let first = identity
                .as_ref()
                .and_then(|identity| seen.get(identity).copied());
            let Some((index, first)) = first else {
                if let Some(identity) = identity {
                    seen.insert(identity, (entries.len(), line));
                }
                entries.push(Entry {
                    key,
                    name,
                    value,
                    lost: Vec::new(),
                });
                continue;
            };
            if let Some(entry) = entries.get_mut(index) {
                if first.is_some() && !merged {
                    entry.lost.push((entry.name, entry.value));
                }
                entry.name = if merged { entry.name } else { name };
                entry.value = value;
            }
            // What was merged is there to be replaced.
            if let (Some(first), false) = (first, merged) {
                let key = key.to_string();
                let message = format!(
                    "'{}' stands here for the second time: this one counts, in the place of the first (line {first}), whose content is lost",
                    short(&key)
                );
                self.doubt(
                    name.span,
                    message,
                    Some("give them different names".to_owned()),
                );
            }
        }
        entries
    }

    /// Puts what is merged in front, as PyYAML does.
    fn flatten(&mut self, node: &'d Node, pairs: &mut Vec<(&'d Node, &'d Node, bool)>) {
        let Yaml::Map(own) = &node.value else { return };
        let (merges, rest): (Vec<_>, Vec<_>) = own.iter().partition(|(key, _)| is_merge(key));
        for (_, value) in merges {
            let maps: Vec<&Node> = match &value.value {
                Yaml::Map(_) => vec![value],
                // The first ones win.
                Yaml::List(maps) => maps.iter().rev().collect(),
                Yaml::Scalar { .. } => Vec::new(),
            };
            if maps.is_empty() || maps.iter().any(|map| !matches!(map.value, Yaml::Map(_))) {
                if !matches!(&value.value, Yaml::List(maps) if maps.is_empty()) {
                    self.mistake(
                        value.span,
                        "'<<' takes a mapping or a list of mappings",
                        None,
                    );
                }
                continue;
            }
            for map in maps {
                let mut merged = Vec::new();
                self.flatten(map, &mut merged);
                pairs.extend(merged.into_iter().map(|(key, value, _)| (key, value, true)));
            }
        }
        pairs.extend(rest.into_iter().map(|(key, value)| (key, value, false)));
    }

    /// A value as Python has it. `tell`: whether to say what became something else than what stands
    /// there, and whether it is within a collection.
    fn value(&mut self, node: &'d Node, tell: Option<bool>) -> Value {
        let tag = node
            .tag
            .as_deref()
            .filter(|tag| !matches!(*tag, "!" | "" | LOOP));
        let kind = match tag {
            None => None,
            Some(tag) => match tag.strip_prefix(CORE) {
                Some(kind) => Some(kind),
                None => {
                    let message = format!("the tag '{tag}' is not known; leave it out");
                    self.mistake(node.span, message, None);
                    return Value::Null;
                }
            },
        };
        match (&node.value, kind) {
            (Yaml::Scalar { text, .. }, None) if node.tag.as_deref() == Some(LOOP) => {
                Value::Loop(text.clone())
            }
            (Yaml::Scalar { text, plain }, kind) => self.scalar(node, text, *plain, kind, tell),
            (Yaml::List(items), None | Some("seq")) => Value::List(
                items
                    .iter()
                    .map(|item| self.value(item, tell.map(|_| true)))
                    .collect(),
            ),
            (Yaml::List(items), Some("omap" | "pairs")) => self.ordered(items, tell),
            (Yaml::Map(_), None | Some("map")) => {
                let entries = self.entries(node, tell.is_some());
                let pairs = entries.into_iter().map(|entry| {
                    // What is lost must be valid as well.
                    for (_, lost) in &entry.lost {
                        self.value(lost, None);
                    }
                    let value = self.value(entry.value, tell.map(|_| true));
                    (entry.key, value)
                });
                Value::Map(pairs.collect())
            }
            (Yaml::Map(_), Some("set")) => Value::Set(
                self.entries(node, tell.is_some())
                    .into_iter()
                    .map(|entry| entry.key)
                    .collect(),
            ),
            (_, Some(kind)) => {
                let message = format!("the tag '!!{kind}' does not belong to {}", node.kind());
                self.mistake(node.span, message, None);
                Value::Null
            }
        }
    }

    fn ordered(&mut self, items: &'d [Node], tell: Option<bool>) -> Value {
        let mut pairs = Vec::new();
        for item in items {
            match &item.value {
                Yaml::Map(pair) if let [(key, value)] = pair.as_slice() => {
                    let tell = tell.map(|_| true);
                    pairs.push((self.value(key, tell), self.value(value, tell)));
                }
                _ => self.mistake(item.span, "wanted is a mapping of one key", None),
            }
        }
        Value::Pairs(pairs)
    }

    fn scalar(
        &mut self,
        node: &Node,
        text: &str,
        plain: bool,
        kind: Option<&str>,
        tell: Option<bool>,
    ) -> Value {
        let read = match kind {
            Some(kind) => scalar::tagged(kind, text),
            None if plain || node.tag.is_some() => scalar::plain(text),
            None => Ok(Value::Text(text.to_owned())),
        };
        let value = read.unwrap_or_else(|message| {
            self.mistake(node.span, message, None);
            Value::Null
        });
        if let (Some(within), None, true) = (tell, kind, plain)
            && let Some(message) = surprise(text, &value, within)
        {
            let help = match (text, &value) {
                ("", _) => "write '' for an empty text, or None".to_owned(),
                (text, Value::Text(_)) => match text.parse().map(Value::Float) {
                    Ok(number) => format!("if you mean the number, write {number}"),
                    Err(_) => "put it in quotes".to_owned(),
                },
                (text, _) => format!("if you mean the text, put it in quotes: '{}'", short(text)),
            };
            self.doubt(node.span, message, Some(help));
        }
        value
    }
}

fn is_merge(key: &Node) -> bool {
    match (&key.value, key.tag.as_deref()) {
        (Yaml::Scalar { text, plain: true }, None) => text == "<<",
        (Yaml::Scalar { .. }, Some(tag)) => tag.strip_prefix(CORE) == Some("merge"),
        _ => false,
    }
}

/// What became something that its writer probably did not mean.
fn surprise(text: &str, value: &Value, within: bool) -> Option<String> {
    let became = |value: &Value| Some(format!("YAML reads {} as {value}", short_quoted(text)));
    match value {
        Value::Null if text.is_empty() => {
            Some("nothing is written here, which YAML reads as None".to_owned())
        }
        Value::Null => became(value),
        Value::Bool(_) if !matches!(text.to_lowercase().as_str(), "true" | "false") => {
            became(value)
        }
        // Digits of another base than ten; blanks and signs are as people mean them.
        Value::Int(digits)
            if !text.starts_with(['+']) && *digits != text && !text.contains('x') =>
        {
            became(value)
        }
        Value::Float(_) if text.contains([':', '_']) => became(value),
        Value::Date(_) | Value::Time(_) if within || value.to_string() != text => Some(format!(
            "YAML reads {} as a date, which is sent as {}",
            short_quoted(text),
            Value::List(vec![value.clone()])
        )),
        Value::Text(_) if within && is_almost_number(text) => Some(format!(
            "YAML reads {} as a text, which is sent in quotes",
            short_quoted(text)
        )),
        _ => None,
    }
}

/// `1e3`, `-.5`, `08`: numbers to people and to most programs, and not to YAML 1.1.
fn is_almost_number(text: &str) -> bool {
    text.contains(|c: char| c.is_ascii_digit()) && text.parse::<f64>().is_ok()
}

/// Where a part of a key stands; the whole key where that cannot be told.
fn within(node: &Node, key: &str, part: &str) -> Span {
    let Span { start, end } = node.span;
    // `part` is a slice of `key`.
    let offset = (part.as_ptr() as usize).checked_sub(key.as_ptr() as usize);
    let before = offset
        .and_then(|offset| key.get(..offset))
        .map(|before| before.chars().count());
    let one_line = start.line == end.line;
    let quotes = usize::from(!matches!(&node.value, Yaml::Scalar { plain: true, .. }));
    let as_written = end.column.saturating_sub(start.column) == key.chars().count() + 2 * quotes;
    match before {
        Some(before) if one_line && as_written => {
            let column = start.column + quotes + before;
            let from = Mark { column, ..start };
            let to = Mark {
                column: column + part.chars().count(),
                ..start
            };
            Span {
                start: from,
                end: to,
            }
        }
        _ => node.span,
    }
}

fn short(text: &str) -> String {
    match text.char_indices().nth(SHOWN) {
        Some((at, _)) => format!("{}…", text.get(..at).unwrap_or_default()),
        None => text.to_owned(),
    }
}

fn short_quoted(text: &str) -> String {
    quoted(&short(text))
}
