//! The original's eight command-line tools: their names, and their rules for options.
//!
//! Python's argparse lets long options be shortened, takes the last of a repeated one, and, as the
//! original uses it, ignores what it does not know; ours says on stderr what was ignored (wire
//! specification 7).

use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{CommandFactory, Parser, Subcommand};
use ztl_core::integer::Integer;
use ztl_core::repr::put_quoted;
use ztl_std::TaskSpec;

use crate::{
    Done, remote_task, run_script, simple_client, simple_server, task_client, task_server, terminal,
};

/// The original's tools by the names of this command.
#[derive(Debug, Subcommand)]
pub(crate) enum Tool {
    /// The original's test server: handler `test` with echo, print and sleep
    #[command(args_override_self = true)]
    TaskServer(task_server::TaskServer),
    /// Run a task on a server and wait for it
    #[command(args_override_self = true)]
    TaskClient(task_client::TaskClient),
    /// Run a task of the configured remote servers and wait for it
    #[command(args_override_self = true)]
    RemoteTask(remote_task::RemoteTask),
    /// The original's simplest server: a task lasts as many seconds as it is asked to
    SimpleServer(simple_server::SimpleServer),
    /// Ask for a task with a payload as it is, and wait 5 s for it
    SimpleClient(simple_client::SimpleClient),
    #[command(hide = true)]
    SimplePublisher(NotYet),
    #[command(hide = true)]
    SimpleSubscriber(NotYet),
    /// Play the scenes of a script, one key each
    #[command(args_override_self = true)]
    RunScript(run_script::RunScript),
}

/// A tool that is still to come; takes any arguments, to say so.
#[derive(Debug, clap::Args)]
#[command(disable_help_flag = true)]
pub(crate) struct NotYet {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    _ignored: Vec<OsString>,
}

const NAMES: [&str; 8] = [
    "task-server",
    "task-client",
    "simple-server",
    "simple-client",
    "simple-publisher",
    "simple-subscriber",
    "remote-task",
    "run-script",
];

#[derive(Debug, Parser)]
#[command(name = "ztl", version, infer_long_args = true)]
struct ToolOnly {
    #[command(subcommand)]
    tool: Tool,
}

impl Tool {
    /// Runs it; `called` is the name under which it was called.
    pub(crate) fn run(self, called: &str) -> Done {
        match self {
            Self::TaskServer(server) => server.run(),
            Self::TaskClient(client) => client.run(called),
            Self::RemoteTask(client) => client.run(called),
            Self::SimpleServer(server) => server.run(),
            Self::SimpleClient(client) => client.run(),
            Self::RunScript(script) => script.run(called),
            _ => Err("this tool is not there yet; the original's works with this server and gateway: pip install ztl".into()),
        }
    }
}

/// A whole number as Python's `int()` reads it, for options of the original.
fn whole<N: TryFrom<i64>>(text: &str) -> Option<N> {
    let number = Integer::parse(text).ok()?.value()?;
    N::try_from(number).ok()
}

/// The INIT's payload for a task that a person has written as `handler:component:goal`, or the exit
/// code when it is none.
pub(crate) fn specification(payload: &str, called: &str, tool: &str) -> Result<String, ExitCode> {
    let Ok(spec) = TaskSpec::split(payload) else {
        terminal::line(
            "Error: Invalid task specification. Payload needs to specify handler, component and goal separated by ':', e.g. 'handler:component:goal'",
        );
        eprintln!("{}", help(called, tool));
        return Err(ExitCode::from(255));
    };
    let mut request = vec![0; spec.encoded_len()];
    Ok(spec
        .encode_into(&mut request)
        .unwrap_or_default()
        .to_owned())
}

/// What Python says of a text that is no whole number.
pub(crate) fn no_number(text: &str) -> String {
    let mut literal = Vec::new();
    put_quoted(text, &mut |bytes: &[u8]| literal.extend_from_slice(bytes));
    let literal = String::from_utf8_lossy(&literal);
    format!("invalid literal for int() with base 10: {literal}")
}

/// A port.
pub(crate) fn port(text: &str) -> Result<u16, &'static str> {
    whole(text).ok_or("a port is a whole number from 0 to 65535")
}

/// A time in seconds.
pub(crate) fn seconds(text: &str) -> Result<i64, &'static str> {
    whole(text).ok_or("a whole number of seconds is needed")
}

/// Runs a tool, when one is called for by the program's name or by the first argument.
pub(crate) fn run(args: &[OsString]) -> Option<ExitCode> {
    let (program, rest) = args.split_first()?;
    let (called, tool, rest) = match by_link(program) {
        Some((called, tool)) => (called, tool, rest),
        None => {
            let (first, rest) = rest.split_first()?;
            let tool = NAMES.into_iter().find(|name| first == OsStr::new(name))?;
            (format!("ztl {tool}"), tool, rest)
        }
    };
    Some(match parse(&called, tool, rest) {
        Ok(tool) => tool.run(&called).unwrap_or_else(|error| {
            eprintln!("{called}: {error}");
            ExitCode::FAILURE
        }),
        Err(code) => code,
    })
}

/// The tool that the program is named after: `ztl_task_client`, `task_client.py`.
fn by_link(program: &OsStr) -> Option<(String, &'static str)> {
    let called = Path::new(program).file_name()?.to_str()?;
    let stem = called.strip_suffix(".py").unwrap_or(called);
    let plain = stem.strip_prefix("ztl_").unwrap_or(stem).replace('_', "-");
    let tool = NAMES.into_iter().find(|name| *name == plain)?;
    Some((called.to_owned(), tool))
}

/// Parses, leaving out what is not known, with a word about it.
fn parse(called: &str, tool: &str, rest: &[OsString]) -> Result<Tool, ExitCode> {
    let mut args: Vec<OsString> = vec!["ztl".into(), tool.into()];
    args.extend_from_slice(rest);
    loop {
        let error = match ToolOnly::try_parse_from(&args) {
            Ok(parsed) => return Ok(parsed.tool),
            Err(error) => error,
        };
        if let Some(place) = unknown(&error, &args) {
            let ignored = args.remove(place);
            eprintln!("{called}: warning: ignored {}", ignored.to_string_lossy());
            continue;
        }
        if !error.use_stderr() {
            terminal::line(help(called, tool).trim_end());
            return Err(ExitCode::SUCCESS);
        }
        let text = error.render().to_string();
        // In argparse's order: how it is used, then what was wrong.
        let usage = usage(called, tool);
        let wrong: Vec<&str> = text
            .lines()
            .take_while(|line| !line.starts_with("Usage: ") && !line.starts_with("For more"))
            .map(|line| line.trim_start_matches("error: ").trim())
            .filter(|line| !line.is_empty())
            .collect();
        eprintln!("{usage}\n{called}: error: {}", wrong.join(" "));
        // These two of the original's take no options, and die of what is missing.
        let without_options = matches!(tool, "simple-server" | "simple-client");
        return Err(ExitCode::from(if without_options { 1 } else { 2 }));
    }
}

/// What a tool's `--help` says, under the name by which it was called.
fn help(called: &str, tool: &str) -> String {
    let mut command = ToolOnly::command();
    let tool = command.find_subcommand_mut(tool);
    let help = tool.map(|tool| tool.clone().bin_name(called).render_long_help().to_string());
    help.unwrap_or_default()
}

fn usage(called: &str, tool: &str) -> String {
    let mut command = ToolOnly::command();
    let tool = command.find_subcommand_mut(tool);
    let usage = tool.map(|tool| tool.clone().bin_name(called).render_usage().to_string());
    usage.unwrap_or_default().replacen("Usage:", "usage:", 1)
}

/// Where the argument stands that is not known.
fn unknown(error: &clap::Error, args: &[OsString]) -> Option<usize> {
    if error.kind() != ErrorKind::UnknownArgument {
        return None;
    }
    let Some(ContextValue::String(unknown)) = error.get(ContextKind::InvalidArg) else {
        return None;
    };
    let matches = |arg: &OsString| {
        let arg = arg.to_string_lossy();
        arg == *unknown || arg.split_once('=').is_some_and(|(name, _)| name == unknown)
            // A cluster of short options: -xy is reported as -x.
            || (!arg.starts_with("--") && unknown.len() == 2 && arg.starts_with(unknown.as_str()))
    };
    // After the program's and the tool's name.
    args.iter().skip(2).position(matches).map(|place| place + 2)
}
