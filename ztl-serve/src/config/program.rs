//! Programs: what is run, in what surroundings, with what limits.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use nix::unistd::User;

use super::super::program::{
    Abort, AbortBy, Account, Argument, Invocation, Program, ResultKind, SIGNALS, find, program_path,
};
use super::super::rule::Rule;
use super::super::template::Template;
use super::{Source, Wild};
use ztl_std::listen::one_or_more;
use ztl_std::server::bytes;
use ztl_yaml::{Fields, Node, NodeValue};

/// How long a program has to end after it was asked to.
const GRACE: Duration = Duration::from_secs(2);
/// The longest that a file may say: a server that stops waits for it.
const LONGEST_GRACE: Duration = Duration::from_secs(60);
/// How long a program may think about its goal.
const DECIDE: Duration = Duration::from_millis(300);
/// An INIT is answered by then in any case.
const LONGEST_DECIDE: Duration = Duration::from_millis(1500);
/// Bytes of output that are kept.
const OUTPUT: usize = 64 * 1024;
/// Most that fit a message.
const MOST_OUTPUT: usize = 1000 * 1024;

/// The signal that asks a program to end, unless the file says otherwise.
const TERM: (&str, rustix::process::Signal) = ("TERM", rustix::process::Signal::TERM);

/// What the programs of an entry have in common.
struct Surroundings<'a> {
    directory: PathBuf,
    environment: Vec<(String, String)>,
    user: Option<Account>,
    rule: &'a Rule,
    wild: Wild,
    dashes: bool,
}

impl<'d> Source<'d> {
    /// A list that stands for itself.
    pub(super) fn plain_program(&mut self, node: &'d Node, wild: Wild) -> Option<Program> {
        let rule = Rule::Any;
        let surroundings = self.surroundings(&rule, wild);
        let run = self.invocation(node, &surroundings)?;
        Some(program(run))
    }

    fn surroundings<'a>(&self, rule: &'a Rule, wild: Wild) -> Surroundings<'a> {
        Surroundings {
            directory: self.base.to_owned(),
            environment: Vec::new(),
            user: None,
            rule,
            wild,
            dashes: false,
        }
    }

    /// The program of an entry with keys.
    pub(super) fn program(
        &mut self,
        fields: &mut Fields<'d>,
        (run, shell): (Option<&'d Node>, Option<&'d Node>),
        rule: &Rule,
        wild: Wild,
    ) -> Option<Program> {
        let mut around = self.surroundings(rule, wild);
        if let Some(node) = fields.optional("directory") {
            self.directory(node, &mut around);
        }
        if let Some(node) = fields.optional("environment") {
            self.environment(node, &mut around);
        }
        if let Some(node) = fields.optional("user") {
            around.user = self.user(node);
        }
        if let Some(node) = fields.optional("dashes") {
            let known = [("allowed", true), ("refused", false)];
            around.dashes = self.reading.one_of(node, &known).unwrap_or_default();
        }
        let run = match (run, shell) {
            (Some(node), _) => self.invocation(node, &around),
            (None, Some(node)) => self.shell(node, &around),
            (None, None) => None,
        };
        let limit = fields.optional("limit");
        let limit = limit.and_then(|node| self.time(node, Duration::MAX));
        let output = fields.optional("output").and_then(|node| self.size(node));
        let marker = fields.optional("progress");
        let marker =
            marker.and_then(|node| self.reading.text(node, "what such a line begins with"));
        let result = fields.optional("result").and_then(|node| {
            let known = [
                ("last", ResultKind::Last),
                ("all", ResultKind::All),
                ("json", ResultKind::Json),
                ("nothing", ResultKind::Nothing),
            ];
            self.reading.one_of(node, &known)
        });
        let mut refused_by = Vec::new();
        let codes = fields.optional("refused-by");
        for node in codes.map(one_or_more).unwrap_or_default() {
            let what = "an exit code from 1 to 255, or a list of them";
            refused_by.extend(self.reading.parsed(node, what, |text| {
                let code = text.parse().ok().filter(|code: &u8| *code > 0);
                code.ok_or_else(|| format!("'{text}' is not {what}"))
            }));
        }
        let decide = fields.optional("decide");
        if let (Some(node), None) = (decide, codes) {
            let message = "it decides only where an exit code refuses; write refused-by: [2]";
            self.reading.wrong(node, message);
        }
        let decide = decide.and_then(|node| self.time(node, LONGEST_DECIDE));
        let abort = fields.optional("abort");
        let abort = abort.map_or(Some(default_abort()), |node| self.abort(node, &around));
        let left = fields.optional("left-behind").and_then(|node| {
            let known = [("kill", true), ("leave", false)];
            self.reading.one_of(node, &known)
        });
        let mut program = program(run?);
        program.limit = limit;
        program.output = output.unwrap_or(program.output);
        program.marker = marker.map(str::to_owned);
        program.result = result.unwrap_or(program.result);
        program.refused_by = refused_by;
        program.decide = decide.unwrap_or(program.decide);
        program.abort = abort?;
        program.tidy = left.unwrap_or(program.tidy);
        Some(program)
    }

    /// An argument list.
    fn invocation(&mut self, node: &'d Node, around: &Surroundings<'_>) -> Option<Invocation> {
        let nodes = self.reading.list(
            node,
            "the program and each of its arguments, as [espeak-ng, '{goal}']",
        )?;
        let mut arguments = Vec::new();
        for (place, node) in nodes.iter().enumerate() {
            let text = self.argument(node)?;
            let program = program_path(text, self.base);
            let text = if place == 0 { program.as_str() } else { text };
            let template = match Template::parse(text) {
                Ok(template) => template,
                Err(message) => {
                    self.reading.wrong(node, message);
                    continue;
                }
            };
            if place == 0 {
                if !template.is_fixed() {
                    let message = "no client may choose the program; put that into an argument";
                    self.reading.wrong(node, message);
                } else if find(text, &around.environment).is_none() {
                    self.warn(
                        node,
                        format!("{text} is not there; install it or correct the path"),
                    );
                }
            }
            if let Some(part) = template.lacks(around.rule) {
                let message = format!("no goal has '{part}': it is {}", around.rule);
                self.reading.wrong(node, message);
            }
            if runs_in_shell(&arguments) && template.takes_text(around.rule, around.wild.0) {
                let message =
                    "a shell executes what a client writes here; write \"$ZTL_GOAL\" in its place";
                self.warn(node, message.to_owned());
            }
            let guarded = !around.dashes && template.is_open(around.rule, around.wild.0);
            arguments.push(Argument { template, guarded });
        }
        if nodes.is_empty() {
            self.reading.wrong(node, "there is no program in this list");
        }
        Some(self.made(node, arguments, around))
    }

    /// Also an empty one.
    fn argument(&mut self, node: &'d Node) -> Option<&'d str> {
        match &node.value {
            NodeValue::Scalar { text, plain: false } => Some(text),
            _ => self.reading.text(node, "an argument"),
        }
    }

    fn shell(&mut self, node: &'d Node, around: &Surroundings<'_>) -> Option<Invocation> {
        let text = self.reading.text(node, "a command for the shell")?;
        for word in ["goal", "handler", "component", "id", "scope"] {
            let starts = [format!("{{{word}}}"), format!("{{{word}.")];
            let pasted = |start: &String| {
                let before = text.find(start.as_str()).map(|at| text.get(..at));
                before
                    .flatten()
                    .is_some_and(|before| !before.ends_with('$'))
            };
            if starts.iter().any(pasted) {
                let name = word.to_uppercase();
                let message = format!(
                    "nothing is put into a shell's command, for it would be executed; write \"$ZTL_{name}\", or use run"
                );
                self.reading.wrong(node, message);
            }
        }
        let arguments = ["/bin/sh", "-c", text].map(|text| Argument {
            template: Template::fixed(text),
            guarded: false,
        });
        Some(self.made(node, arguments.to_vec(), around))
    }

    fn made(&self, node: &Node, arguments: Vec<Argument>, around: &Surroundings<'_>) -> Invocation {
        Invocation {
            arguments,
            directory: around.directory.clone(),
            environment: around.environment.clone(),
            user: around.user.clone(),
            place: format!("{}:{}", self.document.name(), node.span.start.line),
        }
    }

    fn directory(&mut self, node: &'d Node, around: &mut Surroundings<'_>) {
        let Some(text) = self.reading.text(node, "a directory") else {
            return;
        };
        around.directory = self.base.join(text);
        if !around.directory.is_dir() {
            let message = format!("there is no directory {}", around.directory.display());
            self.warn(node, message);
        }
    }

    fn environment(&mut self, node: &'d Node, around: &mut Surroundings<'_>) {
        let pairs = self.reading.pairs(node, "variables, as {LANG: C}");
        for (name, node) in pairs.unwrap_or_default() {
            let name = self.reading.parsed(name, "the name of a variable", |text| {
                match text.is_empty() || text.contains(['=', '\0']) {
                    true => Err(format!("'{text}' is no name for a variable")),
                    false => Ok(text.to_owned()),
                }
            });
            let value = match node.is_null() {
                true => Some(""),
                false => self.argument(node),
            };
            if let (Some(name), Some(value)) = (name, value) {
                around.environment.push((name, value.to_owned()));
            }
        }
    }

    fn user(&mut self, node: &'d Node) -> Option<Account> {
        let user =
            self.reading.parsed(node, "the name of a user", |name| {
                match User::from_name(name) {
                    Ok(Some(user)) => Ok(user),
                    Ok(None) => Err(format!("there is no user '{name}' on this machine")),
                    Err(error) => Err(format!("users cannot be looked up: {error}")),
                }
            })?;
        let own = nix::unistd::geteuid();
        if !own.is_root() && own != user.uid {
            let message = format!("only root can run programs as '{}'", user.name);
            self.warn(node, message);
        }
        Some(Account {
            name: user.name,
            uid: user.uid.as_raw(),
            gid: user.gid.as_raw(),
            home: user.dir,
        })
    }

    fn abort(&mut self, node: &'d Node, around: &Surroundings<'_>) -> Option<Abort> {
        let default = default_abort();
        if let NodeValue::Scalar { text, .. } = &node.value {
            return Some(match text.as_str() {
                "no" | "never" | "false" => Abort {
                    allowed: false,
                    ..default
                },
                _ => Abort {
                    by: self.signal(node)?,
                    ..default
                },
            });
        }
        let mut fields = self
            .reading
            .fields(node, "signal: INT, or run: [PROGRAM]; grace: 2 s")?;
        let signal = fields.optional("signal");
        let run = fields.optional("run");
        let grace = fields.optional("grace");
        fields.finish(&mut self.reading);
        let grace = grace.map(|node| self.time(node, LONGEST_GRACE));
        if let (Some(_), Some(node)) = (signal, run) {
            self.reading
                .wrong(node, "only one of signal and run can abort a task");
        }
        let by = match (signal, run) {
            (Some(node), _) => self.signal(node)?,
            (None, Some(node)) => AbortBy::Program(Arc::new(self.invocation(node, around)?)),
            (None, None) => default.by,
        };
        Some(Abort {
            allowed: true,
            by,
            grace: grace.unwrap_or(Some(default.grace))?,
        })
    }

    fn signal(&mut self, node: &'d Node) -> Option<AbortBy> {
        let text = self.reading.text(node, "a signal, as INT")?;
        let short = text.strip_prefix("SIG").unwrap_or(text);
        if let Some((name, signal)) = SIGNALS.iter().find(|(name, _)| *name == short) {
            return Some(AbortBy::Signal(name, *signal));
        }
        // With what was probably meant.
        self.reading.one_of(node, &SIGNALS)?;
        None
    }

    pub(super) fn time(&mut self, node: &'d Node, most: Duration) -> Option<Duration> {
        let what = "a time, as 30 s, 300 ms or 5 min";
        let time = self.reading.parsed(node, what, |text| {
            let time = humantime::parse_duration(text);
            time.map_err(|_| format!("'{text}' is not {what}"))
        })?;
        if time > most || time.is_zero() {
            let mut message = "this must be more than nothing".to_owned();
            if most < Duration::MAX {
                let most = humantime::format_duration(most);
                message.push_str(&format!(" and at most {most}"));
            }
            self.reading.wrong(node, message);
            return None;
        }
        Some(time)
    }

    fn size(&mut self, node: &'d Node) -> Option<usize> {
        let what = "a size from 1 byte to 1000 KiB, as 64 KiB";
        self.reading.parsed(node, what, |text| {
            let size = bytes(text);
            let size = size.filter(|size| (1..=MOST_OUTPUT).contains(size));
            size.ok_or_else(|| format!("'{text}' is not {what}"))
        })
    }
}

/// Whether the argument behind these is a shell's command, as in `sh -c`.
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

/// A program with the limits that it has when nothing else is said.
fn program(run: Invocation) -> Program {
    Program {
        run: Arc::new(run),
        marker: None,
        result: ResultKind::Last,
        output: OUTPUT,
        refused_by: Vec::new(),
        decide: DECIDE,
        limit: None,
        abort: default_abort(),
        tidy: true,
    }
}

fn default_abort() -> Abort {
    let (name, signal) = TERM;
    Abort {
        allowed: true,
        by: AbortBy::Signal(name, signal),
        grace: GRACE,
    }
}
