//! The file that says which programs do which tasks. `docs/serve.md` describes each key.

mod forward;
mod goal;
mod program;

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::desk::Busy;
use super::program::Program;
use super::rule::Rule;
use super::{Entry, Groups, Programs, Room, WILD, Work};
use ztl_std::listen::Listen;
use ztl_std::scope;
use ztl_yaml::{Diagnostic, Diagnostics, Document, Fields, Node, NodeValue, Reading};

/// How many tasks there may be at once in all, unless the file says otherwise.
const AT_ONCE: usize = 200;
/// How many tasks of a component that needs no program are done at once.
const WITHOUT_PROGRAM: usize = 16;
/// Most that can be asked for: each program needs two of a process's files, of which there are often
/// 1024.
const MOST: usize = 400;

/// What a file says.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Config {
    /// Where it listens, who may use it, and what it logs.
    pub listen: Listen,
    /// The scopes, in the file's order.
    pub scopes: Vec<Scope>,
    /// What does not make the file wrong, but may not be as it was meant, such as a program that is not
    /// there yet.
    pub warnings: Vec<Diagnostic>,
    at_once: usize,
}

/// A scope and its handlers.
#[derive(Debug, Clone)]
pub struct Scope {
    name: String,
    /// By handler and component, in the file's order.
    entries: Vec<(String, String, Arc<Entry>)>,
}

impl Scope {
    /// Its name, as `/robot`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Gives it another name.
    pub fn rename(&mut self, name: &str) {
        name.clone_into(&mut self.name);
    }

    /// How many components there are in it.
    #[must_use]
    pub fn components(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn entries(&self) -> impl Iterator<Item = (&str, &str, &Arc<Entry>)> {
        let entries = self.entries.iter();
        entries.map(|(handler, component, entry)| (handler.as_str(), component.as_str(), entry))
    }
}

impl Config {
    /// Reads a file. Paths in it are relative to its directory.
    ///
    /// # Errors
    /// All that is wrong with it, each with its place.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        let document = ztl_std::files::load_yaml(path)?;
        let base = path.parent().unwrap_or(Path::new(""));
        // Programs run elsewhere.
        let base = std::path::absolute(base.join(".")).unwrap_or_else(|_| base.to_owned());
        Self::read(&document, &base)
    }

    /// Takes the configuration out of a document; paths are relative to `base`.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn read(document: &Document, base: &Path) -> Result<Self, Diagnostics> {
        let mut source = Source {
            document,
            base,
            reading: document.reading(),
            warnings: Vec::new(),
        };
        let config = source.config(document.root());
        let Source {
            reading, warnings, ..
        } = source;
        let mut config = reading.finish(config)?;
        config.warnings = warnings;
        Ok(config)
    }

    /// The handlers of each scope, ready to be registered. The groups of what they start are in `groups`.
    ///
    /// # Errors
    /// When the system gives no more threads or files.
    pub fn programs(&self, groups: &Groups) -> io::Result<Vec<(String, Programs)>> {
        let room = Room::new(self.at_once);
        let scopes = self.scopes.iter();
        scopes
            .map(|scope| {
                let programs = Programs::new(scope, room.clone(), groups.clone())?;
                Ok((scope.name.clone(), programs))
            })
            .collect()
    }
}

/// A file on its way to a configuration.
struct Source<'d> {
    document: &'d Document,
    base: &'d Path,
    reading: Reading<'d>,
    warnings: Vec<Diagnostic>,
}

/// What a client may choose by itself, since a `*` stands for it.
#[derive(Debug, Clone, Copy)]
struct Wild(bool);

impl<'d> Source<'d> {
    fn config(&mut self, root: &'d Node) -> Option<Config> {
        let mut fields = self.reading.fields(root, "port, scopes")?;
        let listen = Listen::read(&mut self.reading, &mut fields, self.base);
        let at_once = fields.optional("at-once");
        let at_once = at_once.and_then(|node| self.count(node, MOST));
        let mut scopes = Vec::new();
        let example = "scopes: {/robot: {tts: {say: [espeak-ng, '{goal}']}}}";
        if let Some(node) = fields.required("scopes", example) {
            for (name, node) in self.some(node, "scopes, as /robot") {
                scopes.extend(self.scope(name, node));
            }
        }
        fields.finish(&mut self.reading);
        Some(Config {
            listen,
            scopes,
            warnings: Vec::new(),
            at_once: at_once.unwrap_or(AT_ONCE),
        })
    }

    fn scope(&mut self, name: &'d Node, node: &'d Node) -> Option<Scope> {
        let known = self.reading.parsed(name, "a scope, as /robot", |text| {
            scope::cannot_be_served(text).map_or_else(|| Ok(text.to_owned()), Err)
        });
        let mut entries = Vec::new();
        for (handler, node) in self.some(node, "its handlers") {
            let handler = self.name(handler, "a handler");
            for (component, node) in self.some(node, "the handler's components") {
                let component = self.name(component, "a component");
                let wild = [&handler, &component].map(|name| name.as_deref() == Some(WILD));
                let entry = self.entry(node, Wild(wild.contains(&true)));
                if let (Some(handler), Some(component), Some(entry)) = (&handler, component, entry)
                {
                    entries.push((handler.clone(), component, Arc::new(entry)));
                }
            }
        }
        Some(Scope {
            name: known?,
            entries,
        })
    }

    /// What a mapping has in it; with nothing in it, nothing would be served.
    fn some(&mut self, node: &'d Node, what: &str) -> &'d [(Node, Node)] {
        let pairs = self.reading.pairs(node, what);
        if pairs.is_some_and(<[_]>::is_empty) {
            let message = format!("there is nothing in it; wanted are {what}");
            self.reading.wrong(node, message);
        }
        pairs.unwrap_or_default()
    }

    /// What clients say between two `:`.
    fn name(&mut self, node: &'d Node, what: &str) -> Option<String> {
        self.reading.parsed(node, what, |text| {
            let fits = !text.is_empty() && !text.contains(':') && !text.contains(char::is_control);
            match fits {
                true => Ok(text.to_owned()),
                false => Err(format!(
                    "'{text}' is no name for {what}: no client can say it"
                )),
            }
        })
    }

    /// How many of something.
    fn count(&mut self, node: &'d Node, most: usize) -> Option<usize> {
        let what = format!("a whole number from 1 to {most}");
        self.reading.parsed(node, &what, |text| {
            let number = text
                .parse()
                .ok()
                .filter(|number| (1..=most).contains(number));
            number.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }

    /// What does the tasks of a component.
    fn entry(&mut self, node: &'d Node, wild: Wild) -> Option<Entry> {
        let what = "run: [PROGRAM, ARGUMENT, …], shell, forward, or one of: echo, sleep, print";
        match &node.value {
            NodeValue::List(_) => {
                let run = self.plain_program(node, wild)?;
                Some(entry(Work::Program(Arc::new(run)), Rule::Any))
            }
            NodeValue::Scalar { .. } if !node.is_null() => {
                self.built_in(node).map(|(work, rule)| entry(work, rule))
            }
            _ => {
                let fields = self.reading.fields(node, what)?;
                self.entry_of(node, fields, wild)
            }
        }
    }

    fn built_in(&mut self, node: &'d Node) -> Option<(Work, Rule)> {
        let seconds = Rule::Number {
            whole: false,
            least: Some(0.0),
            most: None,
        };
        let known: [(&str, usize); 3] = [("echo", 0), ("sleep", 1), ("print", 2)];
        Some(match self.reading.one_of(node, &known)? {
            0 => (Work::Echo, Rule::Any),
            1 => (Work::Sleep, seconds),
            _ => (Work::Print, Rule::Any),
        })
    }

    fn entry_of(&mut self, node: &'d Node, mut fields: Fields<'d>, wild: Wild) -> Option<Entry> {
        let rule = fields.optional("goal").map(|node| self.rule(node));
        let rule = rule.map_or(Some(None), |rule| rule.map(Some));
        let at_once = fields.optional("at-once");
        let at_once_given = at_once.and_then(|node| self.count(node, MOST));
        let busy_node = fields.optional("busy");
        let busy = busy_node.and_then(|node| self.busy(node));
        let needs_client = fields.optional("needs-client");
        let silence = needs_client.and_then(|node| self.silence(node));
        let run = fields.optional("run");
        let shell = fields.optional("shell");
        let built_in = fields.optional("built-in");
        let forward = fields.optional("forward");
        let given = [run, shell, built_in, forward];
        let given: Vec<&Node> = given.into_iter().flatten().collect();
        if let [_, second, ..] = given.as_slice() {
            let message = "only one of run, shell, built-in and forward can do a task";
            self.reading.wrong(second, message);
        }
        // A rule that is wrong takes every goal, so that nothing else is said about it.
        let known = rule.clone().flatten();
        let mut implied = None;
        let work = match (run.or(shell), built_in, forward) {
            (Some(_), _, _) => {
                let checked = known.clone().unwrap_or_default();
                let program = self.program(&mut fields, (run, shell), &checked, wild);
                program.map(|program| Work::Program(Arc::new(program)))
            }
            (_, Some(node), _) => self.built_in(node).map(|(work, rule)| {
                implied = Some(rule);
                work
            }),
            (_, _, Some(node)) => self
                .forward(node)
                .map(|forward| Work::Forward(Arc::new(forward))),
            _ => {
                let message = "nothing does this task; write run: [PROGRAM, ARGUMENT]";
                self.reading.wrong(node, message);
                None
            }
        };
        fields.finish(&mut self.reading);
        if let (Some(Work::Program(program)), Some(Busy::Replace), Some(node)) =
            (&work, busy, busy_node)
            && !program.abort.allowed
        {
            let message = "what cannot be aborted cannot be replaced; leave out abort: no";
            self.reading.wrong(node, message);
        }
        if let (Some(Work::Program(program)), Some(node)) = (&work, needs_client)
            && !program.abort.allowed
        {
            let message = "what cannot be aborted cannot need its client; leave out abort: no";
            self.reading.wrong(node, message);
        }
        let work = work?;
        let mut entry = entry(work, rule?.or(implied).unwrap_or_default());
        entry.at_once = at_once_given.unwrap_or(entry.at_once);
        entry.busy = busy.unwrap_or(entry.busy);
        entry.needs_client = silence;
        Some(entry)
    }

    fn busy(&mut self, node: &'d Node) -> Option<Busy> {
        let what = "refuse, replace, or queue with how many may wait, as queue 3";
        self.reading.parsed(node, what, |text| {
            let mut words = text.split_whitespace();
            let number = |word: &str| word.parse().ok().filter(|most| (1..=MOST).contains(most));
            match (words.next(), words.next().map(number), words.next()) {
                (Some("refuse"), None, None) => Ok(Busy::Refuse),
                (Some("replace"), None, None) => Ok(Busy::Replace),
                (Some("queue"), Some(Some(most)), None) => Ok(Busy::Queue(most)),
                _ => Err(format!("'{text}' is not {what}")),
            }
        })
    }

    /// How long a client may be silent that waits: it asks every second.
    fn silence(&mut self, node: &'d Node) -> Option<Duration> {
        let silence = self.time(node, Duration::MAX)?;
        if silence < Duration::from_secs(1) {
            let message =
                "this must be at least 1s, and should be 5s: a client that waits asks every second";
            self.reading.wrong(node, message);
            return None;
        }
        Some(silence)
    }

    /// What may be otherwise than it was meant.
    fn warn(&mut self, node: &'d Node, message: String) {
        let warning = self
            .document
            .mistake(node.span, format!("warning: {message}"));
        self.warnings.push(warning);
    }
}

/// An entry with its kind's own limits.
fn entry(work: Work, rule: Rule) -> Entry {
    let wants_fields = match &work {
        Work::Program(program) => wants_fields(program),
        _ => false,
    };
    Entry {
        at_once: match &work {
            Work::Program(_) => 1,
            _ => WITHOUT_PROGRAM,
        },
        work,
        rule,
        wants_fields,
        busy: Busy::Refuse,
        needs_client: None,
    }
}

fn wants_fields(program: &Program) -> bool {
    let abort = match &program.abort.by {
        super::program::AbortBy::Program(run) => run.arguments.as_slice(),
        super::program::AbortBy::Signal(..) => &[],
    };
    let mut arguments = program.run.arguments.iter().chain(abort);
    arguments.any(|argument| argument.template.has_fields())
}

#[cfg(test)]
mod tests;
