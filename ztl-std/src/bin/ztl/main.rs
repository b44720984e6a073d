//! The `ztl` command: one file that is server, client, gateway and simulated device.
//!
//! Called by one of the original's names (`ztl_task_client`, `task_client.py`, …) it is that tool.

mod abort;
mod about;
mod ask;
mod check;
mod conversation;
mod demo;
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
use std::process::ExitCode;

use clap::{Parser, Subcommand};

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
    #[command(flatten)]
    Tool(tool::Tool),
}

fn main() -> ExitCode {
    #[cfg(target_os = "linux")]
    if let Some(mistake) = kernel::is_too_old() {
        eprintln!("ztl: {mistake}");
        return ExitCode::FAILURE;
    }
    let args: Vec<OsString> = std::env::args_os().collect();
    // The original's tools, by link or as `ztl task-client`, share its rules for options.
    if let Some(code) = tool::run(&args) {
        return code;
    }
    #[cfg(unix)]
    if let Some(guard) = serve::Guard::of(&args) {
        return exit(guard.run());
    }
    exit(match Cli::parse_from(args).command {
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
        Command::Ps(ps) => ps.run(),
        Command::Abort(abort) => abort.run(),
        Command::Report(report) => report.run(),
        Command::Check(check) => check.run(),
        Command::Tool(tool) => tool.run("ztl"),
    })
}

/// How it ended, for the system and for the person who called it.
fn exit(done: Done) -> ExitCode {
    match done {
        Ok(code) => code,
        Err(error) => {
            eprintln!("ztl: {error}");
            ExitCode::FAILURE
        }
    }
}

/// What every command returns: its exit code, or one line for the person who called it.
type Done = Result<ExitCode, Box<dyn std::error::Error>>;
