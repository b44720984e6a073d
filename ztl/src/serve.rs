//! `ztl serve`: serves scripts and command-line tools as handlers of a task server.

mod robots;

use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use tracing::{Level, warn};
use ztl_serve::{Config, ProcessRegistry, Streams};
use ztl_std::listen::{LOG_FORMATS, LogFormat};

use crate::config_file::{ConfigError, ConfigFile};
use crate::exit::Done;
use crate::listen_options::{ListenOptions, ListenPlace, MISCONFIGURED, log_format, verdict};
use crate::option_values::scope_to_serve;
use crate::systemd::Service;
use crate::terminal::{error_line, error_part, line, part};
use crate::{log, signals};

#[derive(Debug, clap::Args)]
#[command(after_help = "An option overrides FILE.")]
pub(crate) struct Serve {
    /// Configuration in YAML: which program does which task (docs/serve.md)
    #[arg(value_name = "FILE", required_unless_present = "init")]
    file: Option<PathBuf>,

    /// Scope to serve, such as /robot, instead of the file's only one
    #[arg(short, long, value_parser = scope_to_serve)]
    scope: Option<String>,

    #[command(flatten)]
    listen: ListenOptions,

    /// Only check the file
    #[arg(long)]
    check: bool,

    /// Only print a file to begin with: ztl serve --init nao > robot.yaml
    #[arg(long, value_name = "ROBOT", value_parser = robots::names(), exclusive = true)]
    init: Option<String>,
}

/// The watchdog's subcommand.
const WATCHDOG: &str = "serve-watchdog";

/// The watchdog process of a `ztl serve`.
pub(crate) struct Watchdog {
    format: LogFormat,
}

impl Watchdog {
    /// Parses the arguments of [`command`](Self::command). Avoids clap, which would take memory for as long as the
    /// server runs.
    pub(crate) fn of(args: &[OsString]) -> Option<Self> {
        let [_, name, format] = args else {
            return None;
        };
        let format = log_format(format.to_str()?).ok()?;
        (name == WATCHDOG).then_some(Self { format })
    }

    pub(crate) fn run(self) -> Done {
        log::init_as(Level::INFO, self.format);
        ztl_serve::watchdog();
        Ok(ExitCode::SUCCESS)
    }

    /// The command that starts a watchdog: this program, even if its file was moved.
    fn command(format: LogFormat) -> io::Result<Command> {
        // The watchdog needs /proc. An emulator may fake `/proc/self`.
        if cfg!(target_os = "linux") && std::fs::read_dir("/proc")?.next().is_none() {
            return Err(io::Error::new(io::ErrorKind::NotFound, "there is no /proc"));
        }
        let own = Path::new("/proc/self/exe");
        let program = match own.exists() {
            true => own.to_owned(),
            false => std::env::current_exe()?,
        };
        let mut command = Command::new(program);
        let known = LOG_FORMATS.iter().find(|(_, known)| *known == format);
        let format = known.map_or("text", |(word, _)| *word);
        command.arg0("ztl").args([WATCHDOG, format]);
        Ok(command)
    }
}

impl Serve {
    pub(crate) fn run(self) -> Done {
        if let Some(robot) = &self.init {
            part(robots::file(robot));
            return Ok(ExitCode::SUCCESS);
        }
        let check = self.check;
        let (mut config, place, file) = match self.plan() {
            Ok(plan) => plan,
            Err(unfit) => {
                error_line(unfit);
                return Ok(ExitCode::from(MISCONFIGURED));
            }
        };
        if check {
            let missing = config.missing_names();
            config.warnings.extend(missing);
        }
        for warning in &config.warnings {
            error_part(warning);
        }
        let warnings = place.warnings(&config.scope_names());
        for warning in &warnings {
            error_line(format_args!("ztl: warning: {warning}"));
        }
        if check {
            let verdict = verdict(config.warnings.len() + warnings.len());
            let (bind, port) = (&place.bind, place.port);
            let served = served(&config);
            let right = format!("{verdict}: {served}, at {bind}:{port}.");
            return place.check().tell(file, right);
        }
        log::init_as(place.log, place.log_format);
        signals::catch()?;
        serve(&config, place)
    }

    /// Combines the file and the options.
    fn plan(self) -> Result<(Config, ListenPlace, ConfigFile), ConfigError> {
        // Without a file there is `--init`.
        let path = self.file.unwrap_or_default();
        let mut file = ConfigFile::load(Some(&path));
        let config = match file.document().map(Config::of).transpose() {
            Ok(config) => config,
            Err(mistakes) => {
                file.add(mistakes);
                None
            }
        };
        let Some(mut config) = config else {
            return Err(file.finish().err().unwrap_or_default());
        };
        if let Some(name) = &self.scope {
            match config.scope_names().len() {
                1 => {
                    if let Err(mistake) = config.rename_scopes(name) {
                        file.wrong(None, format!("--scope: {mistake}"));
                    }
                }
                many => {
                    let path = path.display();
                    let mistake = format!(
                        "--scope names the only scope of a file, and {path} has {many}; name them there"
                    );
                    file.wrong(None, mistake);
                }
            }
        }
        let place = self
            .listen
            .with(std::mem::take(&mut config.listen), &mut file);
        if place.publish.is_none() {
            file.add(config.unpublished.take());
        }
        file.finish()?;
        Ok((config, place, file))
    }
}

/// Describes what is served.
fn served(config: &Config) -> String {
    let some = |count, what, scope: &str| match count {
        1 => format!("1 {what} at {scope}"),
        many => format!("{many} {what}s at {scope}"),
    };
    let scopes = config.scopes.iter();
    let components = scopes.map(|scope| some(scope.components(), "component", scope.name()));
    let streams = config.streams().into_iter();
    let streams = streams.map(|(scope, count)| some(count, "stream", scope));
    components.chain(streams).collect::<Vec<_>>().join(", ")
}

fn serve(config: &Config, place: ListenPlace) -> Done {
    let who = place.reachable();
    let watchdog = Watchdog::command(place.log_format);
    let mut server = place.listen()?;
    let processes = match watchdog {
        Ok(command) => ProcessRegistry::watched(command)?,
        Err(error) => {
            warn!(target: "serve", "Cannot start a watchdog: {error}. If this server is killed, its programs run on.");
            ProcessRegistry::default()
        }
    };
    for (scope, handler) in config.handlers(&processes)? {
        server.register_handler(&scope, handler);
    }
    let mut streams = None;
    if let Some(endpoint) = place.publish_endpoint() {
        let publisher = server.publish_events(&endpoint)?;
        streams = config.start_streams(&processes, &publisher)?;
        let what = match streams {
            Some(_) => "streams and events of tasks",
            None => "events of tasks",
        };
        line(format_args!(
            "Publishing {what} at {}.",
            publisher.endpoint()
        ));
    }
    line(format_args!(
        "Serving {} at {}. Reachable for {who}.",
        served(config),
        server.endpoint()
    ));
    let handle = server.handle();
    signals::leave_at_the_second_after(processes.killer());
    let served = served(config);
    let stop_streams = streams.as_ref().map(Streams::stopper);
    Service::ready(handle.clone(), move || served.clone())?.stops(move || {
        if let Some(stop) = &stop_streams {
            stop();
        }
        handle.stop();
    });
    server.listen()?;
    drop(streams);
    line("Stopped.");
    Ok(signals::exit_code_or(ExitCode::SUCCESS))
}
