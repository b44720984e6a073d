//! The original's eight command-line tools, as subcommands of this one. `original` parses their options when they
//! are called by the original's names.

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

use crate::called::Called;
use crate::client::task::ReportOptions;
use crate::exit::{Done, MISUSED, exit};
use crate::option_values::{InvalidTask, whole};
use crate::terminal::{error_line, line};
use crate::{
    remote_task, run_script, simple_client, simple_publisher, simple_server, simple_subscriber,
    task_client, task_server,
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
    /// The original's simplest server: a task takes as many seconds as its payload says
    SimpleServer(simple_server::SimpleServer),
    /// Start a task with any payload, and wait 5 s for it
    SimpleClient(simple_client::SimpleClient),
    /// The original's test publisher: a counter, once a second
    #[command(args_override_self = true)]
    SimplePublisher(simple_publisher::SimplePublisher),
    /// The original's test subscriber: shows what a publisher publishes
    #[command(args_override_self = true)]
    SimpleSubscriber(simple_subscriber::SimpleSubscriber),
    /// Play the scenes of a script, one key each
    #[command(args_override_self = true)]
    RunScript(run_script::RunScript),
}

/// The command line with only the tools.
#[derive(Debug, Parser)]
#[command(name = "ztl")]
pub(crate) struct ToolOnly {
    #[command(subcommand)]
    pub(crate) tool: Tool,
}

impl Tool {
    /// Runs the tool as a subcommand.
    pub(crate) fn run(self) -> ExitCode {
        let called = Called::ours(self.name());
        self.run_as(&called)
    }

    /// Runs the tool by the name it was called.
    pub(crate) fn run_as(self, called: &Called) -> ExitCode {
        let name = self.name();
        // The original ends with 1 after any exception. With our `--exit-status` that would mean that the task was rejected.
        let (exit_status, json) = self
            .report()
            .map_or((false, false), |report| (report.exit_status, report.json));
        let ends_as_original = called.is_original() && !exit_status;
        let done: Done = match self {
            Self::TaskServer(server) => server.run(),
            Self::TaskClient(client) => client.run(called),
            Self::RemoteTask(client) => client.run(called),
            Self::SimpleServer(server) => server.run(),
            Self::SimpleClient(client) => client.run(called),
            Self::RunScript(script) => script.run(called),
            Self::SimplePublisher(publisher) => publisher.run(),
            Self::SimpleSubscriber(subscriber) => subscriber.run(),
        };
        match done {
            Err(error) if error.is::<InvalidTask>() => {
                // With `--json`, stdout is for events.
                match json {
                    true => error_line(error),
                    false => line(error),
                }
                error_line(help(called, name));
                ExitCode::from(if exit_status { MISUSED } else { 255 })
            }
            Err(error) if ends_as_original => exit(called, Err(error.to_string().into())),
            done => exit(called, done),
        }
    }

    const fn report(&self) -> Option<&ReportOptions> {
        match self {
            Self::TaskClient(client) => Some(&client.report),
            Self::RemoteTask(client) => Some(&client.report),
            Self::SimpleClient(client) => Some(&client.report),
            _ => None,
        }
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

/// The help of a tool for the name it was called.
pub(crate) fn help(called: &Called, tool: &str) -> String {
    let mut command = match called.is_original() {
        true => original_command(tool),
        false => ToolOnly::command(),
    };
    let tool = command.find_subcommand_mut(tool);
    let help = tool.map(|tool| tool.clone().bin_name(called.to_string()).render_long_help());
    help.map(|help| help.to_string()).unwrap_or_default()
}

/// The parser for a tool under the original's name.
pub(crate) fn original_command(tool: &str) -> clap::Command {
    ToolOnly::command().mut_subcommand(tool, as_original)
}

/// Under the original's name, the client requires the options that ours takes from elsewhere, and accepts any number
/// as a port. Hidden options are unknown.
fn as_original(tool: clap::Command) -> clap::Command {
    if tool.get_name() == "task-client" {
        ["remote", "port", "scope"]
            .into_iter()
            .fold(tool, |tool, name| {
                tool.mut_arg(name, |arg| arg.required(true))
            })
            .mut_arg("port", |arg| any_port(arg).help("Port of the server"))
            .mut_arg("scope", |arg| {
                arg.help("The scope that the server is listening to")
            })
            .mut_arg("remote", |arg| {
                arg.value_name("REMOTE").help("Host of the server")
            })
            .mut_arg("config", |arg| arg.hide(true))
    } else if tool.get_name() == "simple-client" {
        tool.mut_arg("port", any_port)
    } else {
        tool
    }
}

fn any_port(arg: clap::Arg) -> clap::Arg {
    let number = |text: &str| whole::<i64>(text).ok_or("a port is a whole number");
    arg.value_parser(number)
}
