//! The original's eight command-line tools, as subcommands of this one. Called by the original's names
//! they have the original's rules for options: see [`crate::original`].

use std::ffi::OsString;
use std::fmt;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use ztl_core::integer::Integer;
use ztl_core::repr::put_quoted;
use ztl_std::TaskSpec;

use crate::exit::Done;
use crate::terminal::{error_line, line};
use crate::{
    original, remote_task, run_script, simple_client, simple_server, task_client, task_server,
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

/// Nothing but a tool.
#[derive(Debug, Parser)]
#[command(name = "ztl")]
pub(crate) struct ToolOnly {
    #[command(subcommand)]
    pub(crate) tool: Tool,
}

/// The name under which a tool was called.
#[derive(Debug, Clone)]
pub(crate) struct Called {
    name: String,
    original: bool,
}

impl Called {
    /// As a subcommand: `ztl task-client`.
    fn ours(tool: &str) -> Self {
        Self {
            name: format!("ztl {tool}"),
            original: false,
        }
    }

    /// By one of the original's names: `ztl_task_client`.
    pub(crate) fn original(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            original: true,
        }
    }

    /// Whether it is one of the original's names, so that the tool behaves as the original's.
    pub(crate) const fn is_original(&self) -> bool {
        self.original
    }
}

impl fmt::Display for Called {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

impl Tool {
    /// Runs it as a subcommand.
    pub(crate) fn run(self) -> ExitCode {
        let called = Called::ours(self.name());
        self.run_as(&called)
    }

    /// Runs it under the name by which it was called.
    pub(crate) fn run_as(self, called: &Called) -> ExitCode {
        let done: Done = match self {
            Self::TaskServer(server) => server.run(),
            Self::TaskClient(client) => client.run(called),
            Self::RemoteTask(client) => client.run(called),
            Self::SimpleServer(server) => server.run(),
            Self::SimpleClient(client) => client.run(called),
            Self::RunScript(script) => script.run(called),
            Self::SimplePublisher(_) | Self::SimpleSubscriber(_) => Err(
                "this tool is not there yet; the original's works with this server and gateway: pip install ztl".into(),
            ),
        };
        crate::exit::exit(called, done)
    }

    const fn name(&self) -> &'static str {
        match self {
            Self::TaskServer(_) => "task-server",
            Self::TaskClient(_) => "task-client",
            Self::RemoteTask(_) => "remote-task",
            Self::SimpleServer(_) => "simple-server",
            Self::SimpleClient(_) => "simple-client",
            Self::SimplePublisher(_) => "simple-publisher",
            Self::SimpleSubscriber(_) => "simple-subscriber",
            Self::RunScript(_) => "run-script",
        }
    }
}

/// A whole number as Python's `int()` reads it, for options of the original.
pub(crate) fn whole<N: TryFrom<i64>>(text: &str) -> Option<N> {
    let number = Integer::parse(text).ok()?.value()?;
    N::try_from(number).ok()
}

/// The INIT's payload for a task that a person has written as `handler:component:goal`, or the exit
/// code when it is none.
pub(crate) fn specification(
    payload: &str,
    called: &Called,
    tool: &str,
) -> Result<String, ExitCode> {
    let Ok(spec) = TaskSpec::split(payload) else {
        line(
            "Error: Invalid task specification. Payload needs to specify handler, component and goal separated by ':', e.g. 'handler:component:goal'",
        );
        error_line(help(called, tool));
        return Err(ExitCode::from(255));
    };
    let mut request = vec![0; spec.encoded_len()];
    Ok(spec
        .encode_into(&mut request)
        .unwrap_or_default()
        .to_owned())
}

/// What a tool's `--help` says, under the name by which it was called.
pub(crate) fn help(called: &Called, tool: &str) -> String {
    let mut command = match called.is_original() {
        true => original::command(tool),
        false => ToolOnly::command(),
    };
    let tool = command.find_subcommand_mut(tool);
    let help = tool.map(|tool| tool.clone().bin_name(called.to_string()).render_long_help());
    help.map(|help| help.to_string()).unwrap_or_default()
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

/// The port of a server to connect to: a wider type, since the original's tools take any number.
pub(crate) fn port_to_reach(text: &str) -> Result<i64, &'static str> {
    port(text).map(i64::from)
}

/// A time in seconds.
pub(crate) fn seconds(text: &str) -> Result<i64, &'static str> {
    whole(text).ok_or("a whole number of seconds is needed")
}
