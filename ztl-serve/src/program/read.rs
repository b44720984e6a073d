//! Reads a program's settings from the file.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use nix::unistd::User;
use rustix::process::Signal;
use ztl_std::listen::one_or_more;
use ztl_std::server::bytes;
use ztl_yaml::{Fields, Node, NodeValue};

use super::launch::{Account, Argument, Invocation, SIGNALS, find, program_path};
use super::settings::{Abort, AbortBy, Program, ResultKind};
use super::template::Template;
use crate::kind::Kind;
use crate::reader::{ComponentContext, ConfigReader};

/// How long a program has to end once it is stopped.
const GRACE: Duration = Duration::from_secs(2);
/// Longest grace: a server that stops waits for it.
const LONGEST_GRACE: Duration = Duration::from_secs(60);
/// How long a program may take to reject its goal.
const DECIDE: Duration = Duration::from_millis(300);
/// By then, the server answers an INIT in any case.
const LONGEST_DECIDE: Duration = Duration::from_millis(1500);
/// Bytes of output that are kept.
const OUTPUT: usize = 64 * 1024;
/// Most that fit into a message.
const MOST_OUTPUT: usize = 1000 * 1024;

/// What the command and the abort command of a component or stream have in common.
struct ProgramReader<'r, 'd, 'c> {
    reader: &'r mut ConfigReader<'d>,
    /// `None` for a stream, whose command has no placeholders.
    context: Option<ComponentContext<'c>>,
    directory: PathBuf,
    environment: Vec<(String, String)>,
    user: Option<Account>,
    /// Whether an argument may begin with `-` where a client chooses it.
    dashes: bool,
}

/// Reads `run`: a list of the program and its arguments.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    ProgramReader::new(reader, Some(context)).program(fields, |reader| reader.invocation(node))
}

/// Reads `shell`: a command for `/bin/sh`.
pub(crate) fn read_shell<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    ProgramReader::new(reader, Some(context)).program(fields, |reader| reader.shell(node))
}

/// Reads the program of a stream: `run` or `shell`, where it runs and how it is stopped.
pub(crate) fn read_stream<'d>(
    reader: &mut ConfigReader<'d>,
    fields: &mut Fields<'d>,
) -> Option<Program> {
    let (run, shell) = (fields.optional("run"), fields.optional("shell"));
    let mut reader = ProgramReader::new(reader, None);
    reader.account(fields);
    let command = match (run, shell) {
        (Some(_), Some(second)) => {
            reader.wrong(second, "give only one of: run, shell");
            None
        }
        (Some(node), None) => reader.invocation(node),
        (None, Some(node)) => reader.shell(node),
        (None, None) => {
            let keys = [
                "run",
                "shell",
                "ros1-topic",
                "naoqi-event",
                "naoqi-signal",
                "http-event",
            ];
            fields.lacks_one_of(
                keys,
                "nothing writes this stream",
                "run: [PROGRAM, ARGUMENT]",
            );
            None
        }
    };
    let abort = reader.abort_of(fields);
    Some(Program {
        abort: abort?,
        result: ResultKind::Stream,
        ..program(command?)
    })
}

impl<'r, 'd, 'c> ProgramReader<'r, 'd, 'c> {
    fn new(reader: &'r mut ConfigReader<'d>, context: Option<ComponentContext<'c>>) -> Self {
        Self {
            directory: reader.base.to_owned(),
            environment: Vec::new(),
            user: None,
            context,
            dashes: false,
            reader,
        }
    }

    fn program(
        mut self,
        fields: Option<&mut Fields<'d>>,
        run: impl FnOnce(&mut Self) -> Option<Invocation>,
    ) -> Option<Arc<dyn Kind>> {
        let Some(fields) = fields else {
            return Some(Arc::new(program(run(&mut self)?)));
        };
        self.account(fields);
        if let Some(node) = fields.optional("dashes") {
            let known = [("allowed", true), ("rejected", false)];
            self.dashes = self.one_of(node, &known).unwrap_or_default();
        }
        let run = run(&mut self);
        let abort = self.abort_of(fields);
        // Without a command, the other keys are still checked.
        let is_complete = run.is_some();
        let mut program = program(run.unwrap_or_default());
        self.settings(fields, &mut program);
        program.abort = abort?;
        is_complete.then(|| -> Arc<dyn Kind> { Arc::new(program) })
    }

    /// Where and as whom the program runs.
    fn account(&mut self, fields: &mut Fields<'d>) {
        if let Some(node) = fields.optional("directory") {
            self.directory(node);
        }
        if let Some(node) = fields.optional("environment") {
            self.environment(node);
        }
        if let Some(node) = fields.optional("user") {
            self.user = self.user(node);
        }
    }

    /// How the program is stopped.
    fn abort_of(&mut self, fields: &mut Fields<'d>) -> Option<Abort> {
        let Some(node) = fields.optional("abort") else {
            return Some(default_abort());
        };
        let abort = self.abort(node)?;
        if self.context.is_none() && !abort.allowed {
            self.wrong(node, "no client can abort a stream; leave this out");
        }
        Some(abort)
    }

    /// The keys that say how the program is treated once it runs.
    fn settings(&mut self, fields: &mut Fields<'d>, settings: &mut Program) {
        let limit = fields.optional("limit");
        settings.limit = limit.and_then(|node| self.reader.time(node, Duration::MAX));
        if let Some(size) = fields.optional("output").and_then(|node| self.size(node)) {
            settings.output = size;
        }
        let marker = fields.optional("progress");
        let what = "what such a line begins with";
        let marker = marker.and_then(|node| self.reader.yaml.text(node, what));
        settings.marker = marker.map(str::to_owned);
        if let Some(node) = fields.optional("result") {
            let known = [
                ("last", ResultKind::LastLine),
                ("all", ResultKind::All),
                ("json", ResultKind::Json),
                ("nothing", ResultKind::Nothing),
            ];
            settings.result = self.one_of(node, &known).unwrap_or(settings.result);
        }
        let codes = fields.optional("rejected-by");
        for node in codes.map(one_or_more).unwrap_or_default() {
            let what = "an exit code from 1 to 255, or a list of them";
            let code = self.reader.yaml.parsed(node, what, |text| {
                let code = text.parse().ok().filter(|code: &u8| *code > 0);
                code.ok_or_else(|| format!("'{text}' is not {what}"))
            });
            settings.rejected_by.extend(code);
        }
        let decide = fields.optional("decide");
        if let (Some(node), None) = (decide, codes) {
            self.wrong(
                node,
                "decide needs exit codes that reject: rejected-by: [2]",
            );
        }
        let decide = decide.and_then(|node| self.reader.time(node, LONGEST_DECIDE));
        settings.decide = decide.unwrap_or(settings.decide);
        if let Some(node) = fields.optional("left-behind") {
            let known = [("kill", true), ("leave", false)];
            settings.kills_left_behind = self.one_of(node, &known).unwrap_or(true);
        }
    }

    /// A list of the program and its arguments.
    fn invocation(&mut self, node: &'d Node) -> Option<Invocation> {
        let what = "the program and each of its arguments, as [espeak-ng, '{goal}']";
        let nodes = self.reader.yaml.list(node, what)?;
        let mut arguments = Vec::new();
        for (index, node) in nodes.iter().enumerate() {
            let text = self.argument(node)?;
            let program = program_path(text, self.reader.base);
            let text = if index == 0 { program.as_str() } else { text };
            let template = match Template::parse(text) {
                Ok(template) => template,
                Err(message) => {
                    self.wrong(node, message);
                    continue;
                }
            };
            if index == 0 {
                if !template.is_fixed() {
                    let message = "no client may choose the program; use an argument";
                    self.wrong(node, message);
                } else if find(text, &self.environment).is_none() {
                    let message = format!("{text} does not exist; install it or correct the path");
                    self.reader.warn(node, message);
                }
            }
            let Some(ComponentContext { rule, wildcard }) = self.context else {
                if !template.is_fixed() {
                    let message = format!("a stream has no task, so nothing stands for '{text}'");
                    self.wrong(node, message);
                }
                arguments.push(Argument {
                    template,
                    guarded: false,
                });
                continue;
            };
            if let Some(part) = template.lacks(rule) {
                self.wrong(node, format!("no goal has '{part}': it is {rule}"));
            }
            if runs_in_shell(&arguments) && template.takes_text(rule, wildcard) {
                let message = "a shell executes what a client writes here; use \"$ZTL_GOAL\"";
                self.reader.warn(node, message.to_owned());
            }
            let guarded = !self.dashes && template.is_open(rule, wildcard);
            arguments.push(Argument { template, guarded });
        }
        if nodes.is_empty() {
            self.wrong(node, "there is no program in this list");
        }
        Some(self.with_arguments(node, arguments))
    }

    /// An argument, which may be empty.
    fn argument(&mut self, node: &'d Node) -> Option<&'d str> {
        match &node.value {
            NodeValue::Scalar { text, plain: false } => Some(text),
            _ => self.reader.yaml.text(node, "an argument"),
        }
    }

    fn shell(&mut self, node: &'d Node) -> Option<Invocation> {
        let text = self.reader.yaml.text(node, "a command for the shell")?;
        let of_tasks: &[&str] = match self.context {
            Some(_) => &["goal", "handler", "component", "id", "scope"],
            None => &[],
        };
        for word in of_tasks {
            let is_placeholder = |start: String| {
                let before = text.split_once(&start).map(|(before, _)| before);
                before.is_some_and(|before| !before.ends_with('$'))
            };
            if is_placeholder(format!("{{{word}}}")) || is_placeholder(format!("{{{word}.")) {
                let name = word.to_uppercase();
                let message = format!(
                    "a shell would execute what '{{{word}}}' stands for; write \"$ZTL_{name}\", or use run"
                );
                self.wrong(node, message);
            }
        }
        let arguments = ["/bin/sh", "-c", text].map(|text| Argument {
            template: Template::fixed(text),
            guarded: false,
        });
        Some(self.with_arguments(node, arguments.to_vec()))
    }

    fn with_arguments(&self, node: &Node, arguments: Vec<Argument>) -> Invocation {
        let line = node.span.start.line;
        Invocation {
            arguments,
            directory: self.directory.clone(),
            environment: self.environment.clone(),
            user: self.user.clone(),
            place: format!("{}:{line}", self.reader.document.name()),
        }
    }

    fn directory(&mut self, node: &'d Node) {
        let Some(text) = self.reader.yaml.text(node, "a directory") else {
            return;
        };
        self.directory = self.reader.base.join(text);
        if !self.directory.is_dir() {
            let message = format!("there is no directory {}", self.directory.display());
            self.reader.warn(node, message);
        }
    }

    fn environment(&mut self, node: &'d Node) {
        let pairs = self.reader.yaml.pairs(node, "variables, as {LANG: C}");
        for (name, node) in pairs.unwrap_or_default() {
            let what = "the name of a variable";
            let name = self.reader.yaml.parsed(name, what, |text| {
                match text.is_empty() || text.contains(['=', '\0']) {
                    true => Err(format!("invalid name '{text}' for a variable")),
                    false => Ok(text.to_owned()),
                }
            });
            let value = match node.is_null() {
                true => Some(""),
                false => self.argument(node),
            };
            if let (Some(name), Some(value)) = (name, value) {
                self.environment.push((name, value.to_owned()));
            }
        }
    }

    fn user(&mut self, node: &'d Node) -> Option<Account> {
        let what = "the name of a user";
        let user = self.reader.yaml.parsed(node, what, |name| {
            let user = User::from_name(name);
            let user = user.map_err(|error| format!("cannot look up users: {error}"))?;
            user.ok_or_else(|| format!("there is no user '{name}' on this machine"))
        })?;
        let own = nix::unistd::geteuid();
        if !own.is_root() && own != user.uid {
            let message = format!("only root can run programs as '{}'", user.name);
            self.reader.warn(node, message);
        }
        Some(Account {
            name: user.name,
            uid: user.uid.as_raw(),
            gid: user.gid.as_raw(),
            home: user.dir,
        })
    }

    fn abort(&mut self, node: &'d Node) -> Option<Abort> {
        let default = default_abort();
        if let NodeValue::Scalar { text, .. } = &node.value {
            let allowed = !matches!(text.as_str(), "no" | "never" | "false");
            let by = match allowed {
                true => self.signal(node)?,
                false => default.by,
            };
            return Some(Abort {
                allowed,
                by,
                ..default
            });
        }
        let what = "signal: INT, or run: [PROGRAM]; grace: 2 s";
        let mut fields = self.reader.yaml.fields(node, what)?;
        let signal = fields.optional("signal");
        let run = fields.optional("run");
        let grace = fields.optional("grace");
        fields.finish(&mut self.reader.yaml);
        let grace = grace.map(|node| self.reader.time(node, LONGEST_GRACE));
        if let (Some(_), Some(node)) = (signal, run) {
            self.wrong(node, "give only one of signal and run");
        }
        let by = match (signal, run) {
            (Some(node), _) => self.signal(node)?,
            (None, Some(node)) => AbortBy::Program(Arc::new(self.invocation(node)?)),
            (None, None) => default.by,
        };
        Some(Abort {
            by,
            grace: grace.unwrap_or(Some(default.grace))?,
            ..default
        })
    }

    fn signal(&mut self, node: &'d Node) -> Option<AbortBy> {
        let text = self.reader.yaml.text(node, "a signal, as INT")?;
        let short = text.strip_prefix("SIG").unwrap_or(text);
        if let Some((name, signal)) = SIGNALS.iter().find(|(name, _)| *name == short) {
            return Some(AbortBy::Signal(name, *signal));
        }
        // Suggests the name that was probably meant.
        self.one_of(node, &SIGNALS)?;
        None
    }

    fn size(&mut self, node: &'d Node) -> Option<usize> {
        let what = "a size from 1 byte to 1000 KiB, as 64 KiB";
        self.reader.yaml.parsed(node, what, |text| {
            let size = bytes(text).filter(|size| (1..=MOST_OUTPUT).contains(size));
            size.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }

    fn one_of<T: Copy>(&mut self, node: &'d Node, known: &[(&str, T)]) -> Option<T> {
        self.reader.yaml.one_of(node, known)
    }

    fn wrong(&mut self, node: &Node, message: impl Into<String>) {
        self.reader.yaml.wrong(node, message);
    }
}

/// Whether the argument after these is a shell's command, as in `sh -c`.
fn runs_in_shell(before: &[Argument]) -> bool {
    const SHELLS: [&str; 6] = ["sh", "bash", "dash", "ash", "ksh", "zsh"];
    let [program, options @ ..] = before else {
        return false;
    };
    let program = program.template.beginning();
    let name = program.rsplit('/').next().unwrap_or_default();
    let is_option = |option: &Argument| option.template.beginning().starts_with('-');
    let last = options.last().map(|option| option.template.beginning());
    SHELLS.contains(&name)
        && options.iter().all(is_option)
        && last.is_some_and(|last| !last.starts_with("--") && last.ends_with('c'))
}

/// A program with default settings.
fn program(run: Invocation) -> Program {
    Program {
        run: Arc::new(run),
        marker: None,
        result: ResultKind::LastLine,
        output: OUTPUT,
        rejected_by: Vec::new(),
        decide: DECIDE,
        limit: None,
        abort: default_abort(),
        kills_left_behind: true,
    }
}

fn default_abort() -> Abort {
    Abort {
        allowed: true,
        by: AbortBy::Signal("TERM", Signal::TERM),
        grace: GRACE,
    }
}
