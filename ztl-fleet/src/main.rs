//! The command `ztl-fleet`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod demo;
mod look;
mod panics;
mod signals;
mod watch;

use std::io::{ErrorKind, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::channel;
use std::time::Duration;

use clap::{Parser, Subcommand};
use tracing::warn;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use zenoh::Wait as _;
use ztl_fleet::config::{AgentConfig, EndpointConfig, Links};
use ztl_fleet::join::Joined;
use ztl_fleet::serve::Serving;
use ztl_fleet::{routers, session};
use ztl_std::terminal::flat;
use ztl_yaml::Diagnostics;

/// Robots of many rooms and buildings behind one ZTL endpoint, over Eclipse Zenoh
#[derive(Debug, Parser)]
#[command(name = "ztl-fleet", version, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: FleetCommand,
}

#[derive(Debug, Subcommand)]
enum FleetCommand {
    /// Join a fleet beside a robot's server
    Join(File),
    /// Serve the robots of a fleet to ZTL clients: /NAME/scope
    Endpoint {
        #[command(flatten)]
        file: File,
        /// Port to serve at, instead of the file's
        #[arg(short, long)]
        port: Option<u16>,
        /// Port to publish the robots' streams and events of tasks at, instead of the file's
        #[arg(long, value_name = "PORT")]
        publish: Option<u16>,
    },
    /// Route between agents and endpoints
    Router(File),
    /// Show which robots are there
    Ls(look::Select),
    /// Show which tasks run
    Ps(look::Select),
    /// Show who comes and goes, and which tasks start and end, until a signal
    Watch(look::Select),
    /// Abort a task of a robot
    Abort {
        #[command(flatten)]
        select: look::Select,
        /// The robot's scope, as arm-1/lab
        #[arg(value_name = "NAME/SCOPE")]
        scope: String,
        /// The task's id
        id: ztl_std::RemoteId,
    },
    /// Run a demo: five robots in two rooms, a router, and a scene across all, with one robot cut off meanwhile
    Demo(demo::Demo),
    /// Stop all tasks of all robots, and name those that did not confirm it
    StopAll(look::Select),
}

#[derive(Debug, clap::Args)]
struct File {
    /// Configuration in YAML (docs/fleet.md)
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// Only check the file
    #[arg(long)]
    check: bool,
}

/// The exit code of a command, or an error to print.
type Done = Result<ExitCode, Box<dyn std::error::Error + Send + Sync>>;

/// A mistake in the configuration, after which a restart does not help.
const MISCONFIGURED: u8 = 2;

/// How often an agent looks whether a signal came.
const LOOK: Duration = Duration::from_millis(100);

fn main() -> ExitCode {
    panics::end_process();
    let command = Cli::parse().command;
    let level = match &command {
        FleetCommand::Demo(demo) => demo.level(),
        FleetCommand::Join(_) | FleetCommand::Endpoint { .. } | FleetCommand::Router(_) => {
            LevelFilter::INFO
        }
        _ => LevelFilter::WARN,
    };
    let mut shown = Targets::new()
        .with_default(level)
        // What it warns of, this program tells in its own words.
        .with_target("zenoh", LevelFilter::ERROR.min(level));
    let more = std::env::var("RUST_LOG").map(|text| text.parse::<Targets>());
    if let Ok(Ok(more)) = &more {
        shown = shown.with_default(more.default_level().unwrap_or(level));
        shown.extend(more.iter());
    }
    tracing_subscriber::fmt()
        .with_max_level(LevelFilter::TRACE)
        .with_writer(std::io::stderr)
        .with_ansi(false)
        // A log that cannot be written ends nothing.
        .log_internal_errors(false)
        .finish()
        .with(shown)
        .init();
    if let Ok(Err(error)) = more {
        warn!(target: "fleet", "RUST_LOG is ignored: {error}; expected a level, or targets with levels, as fleet=info,zenoh=debug.");
    }
    let done = run(command);
    panics::forget();
    match done {
        Ok(code) => code,
        Err(error) => {
            let mut stderr = std::io::stderr();
            // Whoever read the output has enough, as `head`.
            let is_unread = |error: &std::io::Error| error.kind() == ErrorKind::BrokenPipe;
            if error.downcast_ref().is_some_and(is_unread) {
                return ExitCode::FAILURE;
            }
            if error.is::<Diagnostics>() {
                // Editors expect the place first in the line.
                let _ = write!(stderr, "{error}");
                return ExitCode::from(MISCONFIGURED);
            }
            let error = error.to_string();
            let _ = writeln!(stderr, "ztl-fleet: {}", flat(&error));
            ExitCode::FAILURE
        }
    }
}

fn run(command: FleetCommand) -> Done {
    match command {
        FleetCommand::Join(File { file, check }) => {
            let config = AgentConfig::load(&file)?;
            if check {
                return fine(&file, &config.links);
            }
            let signals = signals::catch()?;
            let joined = Joined::join(config)?;
            let signals = signals.awaited();
            loop {
                if let Some(end) = joined.wait(LOOK) {
                    return Err(end.into());
                }
                if let Ok(signal) = signals.try_recv() {
                    return Ok(signals::code(signal));
                }
            }
        }
        FleetCommand::Endpoint {
            file: File { file, check },
            port,
            publish,
        } => {
            let mut config = EndpointConfig::load(&file)?;
            config.access.as_ref().map_err(Clone::clone)?;
            config.listen.port = port.or(config.listen.port);
            config.listen.publish = publish.or(config.listen.publish);
            if let Some(port) = config.listen.port.filter(|port| *port != 0)
                && config.listen.publish == Some(port)
            {
                return Err(format!("port {port} is for tasks; publish at another port").into());
            }
            if check {
                return fine(&file, &config.links);
            }
            let signals = signals::catch()?;
            let serving = Serving::bind(&config)?;
            let signals = signals.awaited();
            let (endpoint, who) = (serving.endpoint(), serving.reachable());
            line(format_args!("Serving {endpoint}. Reachable for {who}."))?;
            if let Some(endpoint) = serving.publishes() {
                line(format_args!("Publishing {endpoint}"))?;
            }
            let stopper = serving.stopper();
            let (told, signal) = channel();
            let thread = std::thread::Builder::new().name("ztl-fleet-end".to_owned());
            thread.spawn(move || {
                if let Ok(signal) = signals.recv() {
                    // The receiver waits for the end of the endpoint.
                    let _ = told.send(signal);
                    stopper.stop();
                }
            })?;
            serving.run()?;
            Ok(signal.try_recv().map_or(ExitCode::SUCCESS, signals::code))
        }
        FleetCommand::Router(File { file, check }) => {
            let links = Links::load_router(&file)?;
            if check {
                return fine(&file, &links);
            }
            let signals = signals::catch()?;
            let session = session::open_router(&links)?;
            routers::watch_each(&session, &links)?;
            let signals = signals.awaited();
            line(format_args!("Routing at {}", links.listen.join(", ")))?;
            let signal = signals.recv()?;
            session.close().wait()?;
            Ok(signals::code(signal))
        }
        FleetCommand::Ls(select) => select.ls(),
        FleetCommand::Ps(select) => select.ps(),
        FleetCommand::Demo(demo) => demo.run(),
        FleetCommand::Watch(select) => select.watch(),
        FleetCommand::Abort { select, scope, id } => select.abort(&scope, &id),
        FleetCommand::StopAll(select) => select.stop_all(),
    }
}

/// The end of `--check`, where a wrong date is a mistake, too.
fn fine(file: &std::path::Path, links: &Links) -> Done {
    if let Some(mistake) = links.misdated.clone() {
        return Err(Diagnostics::from(mistake).into());
    }
    line(format_args!("{}: no mistakes", file.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Prints a line without what could command a terminal.
fn line(text: impl std::fmt::Display) -> std::io::Result<()> {
    let text = text.to_string();
    writeln!(std::io::stdout(), "{}", flat(&text))
}
