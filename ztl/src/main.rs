//! The `ztl` command: server, client, gateway and simulated device in one program.
//!
//! If its name is one of the original's (`ztl_task_client`, `task_client.py`, …), it behaves as that tool.

// Text for people goes through `terminal`, which escapes control sequences.
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod abort;
mod called;
mod check;
mod chosen_publisher;
mod client;
mod columns;
mod complete_goal;
mod completions;
mod config_file;
mod connect_options;
mod data_format;
mod demo;
mod describe;
mod device;
mod devices;
#[cfg(target_os = "linux")]
mod doctor;
mod exit;
#[cfg(feature = "firmware")]
mod firmware;
mod gateway;

mod journal_options;
#[cfg(target_os = "linux")]
mod kernel;
mod key_press;
mod keyboard;
mod keys;
mod line;
mod listen_options;
#[cfg(unix)]
mod live;
mod log;
mod man;
mod option_values;
mod original;
mod param;
mod ps;
mod publish;
#[cfg(feature = "record")]
mod record;
#[cfg(feature = "record")]
mod recorder;
mod remote_task;
mod remotes_options;
#[cfg(feature = "record")]
mod replay;
mod report;
mod run_script;
#[cfg(unix)]
mod serve;
mod server_address;
mod server_connection;
mod server_query;
mod signals;
mod simple_client;
mod simple_publisher;
mod simple_server;
mod simple_subscriber;
mod subscribe;
mod systemd;
mod task_client;
mod task_server;
mod terminal;
#[cfg(unix)]
mod terminal_mode;
mod tools;
mod version;
#[cfg(feature = "web")]
mod web;

use std::ffi::OsString;
use std::io::Write as _;
use std::process::ExitCode;

use clap::CommandFactory as _;
use clap::error::{ContextKind, ContextValue};
use clap::{Parser, Subcommand};

use exit::{MISUSED, exit};
use terminal::error_part;

/// Control robots and smart actuators by tasks over ZeroMQ
#[derive(Debug, Parser)]
#[command(
    name = "ztl",
    version,
    long_version = version::text(),
    infer_long_args = true,
    arg_required_else_help = true
)]
struct Cli {
    #[command(subcommand)]
    command: ZtlCommand,
}

#[derive(Debug, Subcommand)]
enum ZtlCommand {
    /// Run a demo: two simulated devices, a gateway and a scene
    Demo(demo::Demo),
    /// Serve microcontrollers as handlers of a task server
    Gateway(gateway::Gateway),
    /// Serve the scripts and command-line tools of a robot as handlers of a task server
    #[cfg(unix)]
    Serve(serve::Serve),
    /// Run a simulated device
    Device(device::Device),
    /// Simulate a bad cable between a gateway and its device: lose, alter, repeat or delay bytes
    Line(line::Line),
    /// Show the devices of a gateway: components, tasks and links
    Devices(devices::Devices),
    /// Show, set and save the parameters of a gateway's devices
    Param(param::Param),
    /// Show what a server offers: scopes, handlers and components
    Describe(describe::Describe),
    /// Show the tasks of a server
    Ps(ps::Ps),
    /// Abort tasks of a server
    Abort(abort::Abort),
    /// Check a robot for problems: clock, ports, permissions, network, a server
    #[cfg(target_os = "linux")]
    Doctor(doctor::Doctor),
    /// Show what a publisher publishes: values, sound, images
    Subscribe(subscribe::Subscribe),
    /// Publish values
    Publish(publish::Publish),
    /// Serve a page on which people watch, start and stop the tasks of all robots
    #[cfg(feature = "web")]
    Web(web::Web),
    /// Record streams and tasks into an MCAP file
    #[cfg(feature = "record")]
    Record(record::Record),
    /// Publish a recording again; with --tasks, send its tasks to the robots
    #[cfg(feature = "record")]
    Replay(replay::Replay),
    /// Create a key pair for encrypted connections
    Keys(keys::Keys),
    /// Sign images of firmware, for updates over the link
    #[cfg(feature = "firmware")]
    Firmware(firmware::Firmware),
    /// Create a page and tables from recorded runs of scripts, or a page from a recording
    Report(report::Report),
    /// Check a script for mistakes
    Check(check::Check),
    /// Print a script that completes this command in a shell
    Completions(completions::Completions),
    /// Write the man pages of this command and its subcommands
    Man(man::Man),
    #[command(flatten)]
    Tool(tools::Tool),
}

fn main() -> ExitCode {
    terminal::checked(run())
}

/// Runs the command of the command line.
fn run() -> ExitCode {
    #[cfg(target_os = "linux")]
    if let Some(mistake) = kernel::is_too_old() {
        terminal::error_line(format_args!("ztl: {mistake}"));
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
    if let Some(code) = complete_goal::run(&args) {
        return code;
    }
    let command = match Cli::try_parse_from(args) {
        Ok(cli) => cli.command,
        Err(error) if error.use_stderr() => {
            error_part(misuse(&error));
            return ExitCode::from(MISUSED);
        }
        // `--help` and `--version` are no mistakes.
        Err(text) => {
            terminal::printed(text.print().and_then(|()| std::io::stdout().flush()));
            return ExitCode::SUCCESS;
        }
    };
    let done = match command {
        ZtlCommand::Demo(demo) => demo.run(),
        ZtlCommand::Gateway(gateway) => gateway.run(),
        #[cfg(unix)]
        ZtlCommand::Serve(serve) => serve.run(),
        ZtlCommand::Device(device) => device.run(),
        ZtlCommand::Line(line) => line.run(),
        ZtlCommand::Devices(devices) => devices.run(),
        #[cfg(target_os = "linux")]
        ZtlCommand::Doctor(doctor) => doctor.run(),
        ZtlCommand::Keys(keys) => keys.run(),
        #[cfg(feature = "firmware")]
        ZtlCommand::Firmware(firmware) => firmware.run(),
        ZtlCommand::Describe(describe) => describe.run(),
        ZtlCommand::Param(param) => param.run(),
        ZtlCommand::Ps(ps) => ps.run(),
        ZtlCommand::Abort(abort) => abort.run(),
        ZtlCommand::Subscribe(subscribe) => subscribe.run(),
        ZtlCommand::Publish(publish) => publish.run(),
        #[cfg(feature = "web")]
        ZtlCommand::Web(web) => web.run(),
        #[cfg(feature = "record")]
        ZtlCommand::Record(record) => record.run(),
        #[cfg(feature = "record")]
        ZtlCommand::Replay(replay) => replay.run(),
        ZtlCommand::Report(report) => report.run(),
        ZtlCommand::Check(check) => check.run(),
        ZtlCommand::Completions(completions) => completions.run(&mut Cli::command()),
        ZtlCommand::Man(man) => man.run(Cli::command()),
        ZtlCommand::Tool(tool) => return tool.run(),
    };
    exit("ztl", done)
}

/// The commands that a build may leave out.
const MAY_BE_LEFT_OUT: [&str; 4] = ["firmware", "record", "replay", "web"];

/// The message for a wrong command line.
fn misuse(error: &clap::Error) -> String {
    if let Some(ContextValue::String(name)) = error.get(ContextKind::InvalidSubcommand)
        && MAY_BE_LEFT_OUT.contains(&name.as_str())
    {
        return format!(
            "error: this ztl has no '{name}', as the static files for 32-bit processors; run another ztl beside the robot\n"
        );
    }
    let text = error.render().to_string();
    match error.get(ContextKind::SuggestedArg) {
        Some(ContextValue::String(meant)) => text.replace(
            &format!("tip: a similar argument exists: '{meant}'"),
            &format!("did you mean {meant}?"),
        ),
        _ => text,
    }
}
