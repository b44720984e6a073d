//! The `ztl` command: one file that is server, client, gateway and simulated device.
//!
//! Called by one of the original's names (`ztl_task_client`, `task_client.py`, …) it is that tool.

// Text for people goes through `terminal`, which keeps what comes from elsewhere from commanding a terminal.
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod abort;
mod about;
mod address;
mod ask;
mod check;
#[cfg(feature = "pages")]
mod completions;
mod conversation;
mod demo;
mod describe;
mod device;
mod devices;
#[cfg(target_os = "linux")]
mod doctor;
mod gateway;
mod journal;
#[cfg(target_os = "linux")]
mod kernel;
mod key_name;
mod keyboard;
mod keys;
mod line;
#[cfg(unix)]
mod live;
mod log;
#[cfg(feature = "pages")]
mod man;
mod original;
mod ps;
mod reach;
mod remote_task;
mod report;
mod run_script;
mod scene;
#[cfg(unix)]
mod serve;
mod service;
mod signals;
mod simple_client;
mod simple_server;
mod task_client;
mod task_server;
mod terminal;
mod tool;

use std::ffi::OsString;
use std::fmt;
use std::process::ExitCode;

#[cfg(feature = "pages")]
use clap::CommandFactory as _;
use clap::error::{ContextKind, ContextValue};
use clap::{Parser, Subcommand};

use terminal::{error_line, error_part};

/// Robots and smart actuators as tasks over ZeroMQ.
#[derive(Debug, Parser)]
#[command(
    name = "ztl",
    version,
    long_version = about::version(),
    infer_long_args = true,
    arg_required_else_help = true
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show the main job: two simulated devices, a gateway, and a scene played on them
    Demo(demo::Demo),
    /// Serve microcontrollers as handlers of a task server
    Gateway(gateway::Gateway),
    /// Serve the scripts and command-line tools of a robot as handlers of a task server
    #[cfg(unix)]
    Serve(serve::Serve),
    /// Run a simulated device by itself, for whoever has no hardware
    Device(device::Device),
    /// Put a bad cable between a gateway and its device: bytes lost, altered, repeated, held back
    Line(line::Line),
    /// Show a gateway's devices: components, tasks, and how the links do
    Devices(devices::Devices),
    /// Show what a server offers: scopes, handlers and components
    Describe(describe::Describe),
    /// Show the tasks of a server
    Ps(ps::Ps),
    /// Stop tasks of a server, whoever started them
    Abort(abort::Abort),
    /// Tell what matters on a strange robot, and what is wrong there: clock, ports, permissions, a server
    #[cfg(target_os = "linux")]
    Doctor(doctor::Doctor),
    /// Make a pair of keys for encrypted connections
    Keys(keys::Keys),
    /// Make a page of what happened in recorded runs of scripts, and tables for statistics
    Report(report::Report),
    /// Find the mistakes in a script before the show
    Check(check::Check),
    /// Print a script that completes this command in a shell
    #[cfg(feature = "pages")]
    Completions(completions::Completions),
    /// Write the man pages of this command and its subcommands
    #[cfg(feature = "pages")]
    Man(man::Man),
    #[command(flatten)]
    Tool(tool::Tool),
}

fn main() -> ExitCode {
    #[cfg(target_os = "linux")]
    if let Some(mistake) = kernel::is_too_old() {
        error_line(format_args!("ztl: {mistake}"));
        return ExitCode::FAILURE;
    }
    let args: Vec<OsString> = std::env::args_os().collect();
    if let Some(code) = original::run(&args) {
        return code;
    }
    #[cfg(unix)]
    if let Some(watchdog) = serve::Watchdog::of(&args) {
        return exit("ztl", watchdog.run());
    }
    let command = match Cli::try_parse_from(args) {
        Ok(cli) => cli.command,
        Err(error) if error.use_stderr() => {
            error_part(misuse(&error));
            return ExitCode::from(MISUSED);
        }
        // Help, which somebody asked for.
        Err(error) => error.exit(),
    };
    let done = match command {
        Command::Demo(demo) => demo.run(),
        Command::Gateway(gateway) => gateway.run(),
        #[cfg(unix)]
        Command::Serve(serve) => serve.run(),
        Command::Device(device) => device.run(),
        Command::Line(line) => line.run(),
        Command::Devices(devices) => devices.run(),
        #[cfg(target_os = "linux")]
        Command::Doctor(doctor) => doctor.run(),
        Command::Keys(keys) => keys.run(),
        Command::Describe(describe) => describe.run(),
        Command::Ps(ps) => ps.run(),
        Command::Abort(abort) => abort.run(),
        Command::Report(report) => report.run(),
        Command::Check(check) => check.run(),
        #[cfg(feature = "pages")]
        Command::Completions(completions) => completions.run(&mut Cli::command()),
        #[cfg(feature = "pages")]
        Command::Man(man) => man.run(Cli::command()),
        Command::Tool(tool) => return tool.run(),
    };
    exit("ztl", done)
}

/// What is wrong with the command line.
fn misuse(error: &clap::Error) -> String {
    let text = error.render().to_string();
    match error.get(ContextKind::SuggestedArg) {
        Some(ContextValue::String(meant)) => text.replace(
            &format!("tip: a similar argument exists: '{meant}'"),
            &format!("did you mean {meant}?"),
        ),
        _ => text,
    }
}

/// How it ended, for the system and for the person who called it by this name.
fn exit(called: impl fmt::Display, done: Done) -> ExitCode {
    match done {
        Ok(code) => code,
        Err(error) => {
            error_line(format_args!("{called}: {error}"));
            match error.is::<Misuse>() {
                true => ExitCode::from(MISUSED),
                false => ExitCode::FAILURE,
            }
        }
    }
}

/// Exit code for a command line that says nothing that could be done.
const MISUSED: u8 = 2;

/// What is wrong with the command line or the environment.
#[derive(Debug)]
struct Misuse(String);

impl fmt::Display for Misuse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.trim_end())
    }
}

impl std::error::Error for Misuse {}

/// What every command returns: its exit code, or one line for the person who called it.
type Done = Result<ExitCode, Box<dyn std::error::Error>>;
